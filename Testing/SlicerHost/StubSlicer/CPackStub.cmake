# Slicer configures its package archive here; a plain "cmake --install" is enough for the stub.
