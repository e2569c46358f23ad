"""The scan: a volume as a stack of transverse slices with a body, a window and a common raster."""
