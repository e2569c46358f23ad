"""Nodes, a stand-in for the library and pictures of views, for the self test."""

from __future__ import annotations

import time
import unittest.mock

import slicer
import vtk

LEFT, RIGHT = (200, 120, 60), (60, 120, 200)


class StandIn:
    """In place of MedColorLib.colorize and of the package check: quick, cancellable, and able to fail half way."""

    def __init__(self, seconds):
        self.seconds, self.in_the_middle, self.guards = seconds, lambda: None, []

    def __enter__(self):
        import MedColorLib
        from MedColorSlicer import dependencies

        self._patches = [
            unittest.mock.patch.object(MedColorLib, "colorize", self),
            unittest.mock.patch.object(MedColorLib, "colorize_time_points", self.time_points),
            unittest.mock.patch.object(dependencies, "ensure", lambda: None),
        ]
        for patch in self._patches:
            patch.start()
        return self

    def __exit__(self, *_exception):
        for patch in self._patches:
            patch.stop()

    def time_points(self, volumes, references, settings, progress, cancelled, guard):
        for volume in volumes:
            yield self(volume, references, settings, progress, cancelled, guard)

    def __call__(self, volume, references, settings=None, progress=None, cancelled=None, guard=None):
        import numpy as np

        from MedColorLib.errors import Cancelled
        from MedColorLib.volume import ColorVolume

        self.guards.append(guard)
        for step in range(10):
            if progress:
                progress(step / 10, "stand-in")
            if step == 5:
                self.in_the_middle()
            time.sleep(self.seconds / 10)
            if cancelled and cancelled():
                raise Cancelled
        rgb = np.zeros((*volume.array.shape, 3), np.uint8)
        rgb[volume.array > 0] = LEFT
        confidence = (volume.array > 0).astype(np.uint8) * 75 if settings.confidence else None
        return ColorVolume(rgb, volume.ijk_to_ras, {"settings": settings.to_dict()}, confidence=confidence)


def logic():
    from MedColorSlicer.logic import MedColorLogic

    return MedColorLogic()


def open_panel():
    """The module's panel, opened as the user does it; without a window as Slicer's module manager would."""
    representation = slicer.modules.medcolor.widgetRepresentation()
    if slicer.util.mainWindow():
        slicer.util.selectModule("MedColor")
    elif not representation.isEntered:
        representation.enter()
    return representation.self()


def leave_panel():
    """As the user does it, by choosing another module."""
    representation = slicer.modules.medcolor.widgetRepresentation()
    if slicer.util.mainWindow():
        slicer.util.selectModule("Data")
    elif representation.isEntered:
        representation.exit()


def raise_value_error():
    raise ValueError("made by the test")


def grey_node(shape=(6, 8, 10)):
    import numpy as np

    voxels = np.arange(np.prod(shape)).reshape(shape).astype(np.int16)
    return slicer.util.addVolumeFromArray(voxels, name="grey")


def half_node(side, size=48, radius=18):
    """A grey ball of which one half is there: 0 the left one, 1 the right one."""
    import numpy as np

    shown = (_ball(size, radius) == (LEFT, RIGHT)[side]).all(axis=3)
    return slicer.util.addVolumeFromArray(np.where(shown, 100, 0).astype(np.int16), name=f"half {side}")


def picture_node():
    import numpy as np

    voxels = np.full((1, 16, 16, 3), (180, 90, 40), np.uint8)
    return slicer.util.addVolumeFromArray(voxels, name="picture", nodeClassName="vtkMRMLVectorVolumeNode")


def two_colors(size=48, radius=18):
    node = slicer.util.addVolumeFromArray(_ball(size, radius), name="ball", nodeClassName="vtkMRMLVectorVolumeNode")
    node.SetVoxelVectorType(node.VoxelVectorTypeColorRGB)
    return node


def _ball(size, radius):
    """(k, j, i, 3) uint8: `LEFT` where i is low, `RIGHT` where it is high."""
    import numpy as np

    center = (size - 1) / 2
    k, j, i = np.mgrid[:size, :size, :size]
    inside = (k - center) ** 2 + (j - center) ** 2 + (i - center) ** 2 < radius**2
    rgb = np.zeros((size, size, size, 3), np.uint8)
    rgb[inside & (i < center)] = LEFT
    rgb[inside & (i > center)] = RIGHT
    return rgb


def opacity_curve_of(display):
    function, values = display.GetVolumePropertyNode().GetScalarOpacity(), [0.0] * 4
    points = []
    for index in range(function.GetSize()):
        function.GetNodeValue(index, values)
        points.append((values[0], values[1]))
    return points


def picture_of(view, volume_node):
    """(height, width, 3) of a 3-D view on black, looking from the front at the volume."""
    node = view.mrmlViewNode()
    node.SetBackgroundColor(0, 0, 0)
    node.SetBackgroundColor2(0, 0, 0)
    node.SetBoxVisible(False)
    node.SetAxisLabelsVisible(False)
    window = view.renderWindow()
    bounds = [0.0] * 6
    volume_node.GetRASBounds(bounds)
    camera = window.GetRenderers().GetFirstRenderer().GetActiveCamera()
    middle = [(bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)]
    camera.SetFocalPoint(middle)
    camera.SetPosition(middle[0], middle[1] + 150, middle[2])
    camera.SetViewUp(0, 0, 1)
    window.GetRenderers().GetFirstRenderer().ResetCameraClippingRange()
    slicer.app.processEvents()  # a window that was just shown, or laid out anew, is not drawn before this
    return picture_now(view)


def settle(view, seconds=0.3):
    """Wait until a view has kept its size for a while: another module's panel may have widened the window."""
    size, since = None, time.monotonic()
    while time.monotonic() - since < seconds:
        slicer.app.processEvents()
        if (view.width, view.height) != size:
            size, since = (view.width, view.height), time.monotonic()
        time.sleep(0.01)


def picture_now(view):
    """(height, width, 3) of a 3-D view as it is."""
    from vtk.util.numpy_support import vtk_to_numpy

    view.forceRender()
    window = view.renderWindow()
    grab = vtk.vtkWindowToImageFilter()
    grab.SetInput(window)
    grab.ReadFrontBufferOff()
    grab.Update()
    width, height, _depth = grab.GetOutput().GetDimensions()
    return vtk_to_numpy(grab.GetOutput().GetPointData().GetScalars()).reshape(height, width, -1)[..., :3]
