"""Draws a small volume with one kind of render window and ends with status 0 if it is seen.

Run as a script in a process of its own, because a window without a working driver may end the process:
`python probe.py vtkEGLRenderWindow`. Needs nothing but VTK.
"""

from __future__ import annotations

import sys


def draws(window_name: str) -> bool:
    """Whether a white box comes out bright through GPU ray casting in a window of this VTK class."""
    from vtkmodules import vtkRenderingOpenGL2, vtkRenderingVolumeOpenGL2  # noqa: F401 - fills the object factory
    from vtkmodules.vtkCommonDataModel import vtkImageData, vtkPiecewiseFunction
    from vtkmodules.vtkRenderingCore import (
        vtkRenderer,
        vtkRenderWindow,
        vtkVolume,
        vtkVolumeProperty,
        vtkWindowToImageFilter,
    )
    from vtkmodules.vtkRenderingVolume import vtkGPUVolumeRayCastMapper

    window = getattr(vtkRenderingOpenGL2, window_name, vtkRenderWindow)()
    window.SetOffScreenRendering(1)
    window.SetShowWindow(False)
    window.SetMultiSamples(0)
    window.SetSize(16, 16)
    renderer = vtkRenderer()
    window.AddRenderer(renderer)

    image = vtkImageData()
    image.SetDimensions(8, 8, 8)
    image.AllocateScalars(3, 4)  # unsigned char
    image.GetPointData().GetScalars().Fill(255)
    opacity = vtkPiecewiseFunction()
    opacity.AddPoint(0.0, 1.0)
    opacity.AddPoint(255.0, 1.0)
    properties = vtkVolumeProperty()
    properties.IndependentComponentsOff()
    properties.SetScalarOpacity(opacity)
    mapper = vtkGPUVolumeRayCastMapper()
    mapper.SetInputData(image)
    volume = vtkVolume()
    volume.SetMapper(mapper)
    volume.SetProperty(properties)
    renderer.AddVolume(volume)
    renderer.ResetCamera()
    window.Render()
    if not mapper.IsRenderSupported(window, properties):
        return False

    picture = vtkWindowToImageFilter()
    picture.SetInput(window)
    picture.ReadFrontBufferOff()
    picture.Update()
    seen = picture.GetOutput().GetScalarComponentAsDouble(8, 8, 0, 0) > 128
    window.Finalize()
    return seen


if __name__ == "__main__":
    sys.exit(0 if draws(sys.argv[1]) else 1)
