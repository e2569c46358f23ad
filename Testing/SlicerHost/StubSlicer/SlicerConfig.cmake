# Stands in for Slicer's CMake package, so that the extension's packaging can be checked without building Slicer.
# It knows the few macros MedColor uses, checks their arguments as strictly as Slicer does, and installs into the same
# places: lib/Slicer-0.0/qt-scripted-modules, sub-folders kept.
set(Slicer_FOUND TRUE)
set(Slicer_USE_FILE "${CMAKE_CURRENT_LIST_DIR}/UseStub.cmake")
set(Slicer_EXTENSION_GENERATE_CONFIG "${CMAKE_CURRENT_LIST_DIR}/GenerateConfigStub.cmake")
set(Slicer_EXTENSION_CPACK "${CMAKE_CURRENT_LIST_DIR}/CPackStub.cmake")
set(Slicer_INSTALL_QTSCRIPTEDMODULES_LIB_DIR "lib/Slicer-0.0/qt-scripted-modules")
