"""What is cut away in 3-D: everything beyond the red slice, or outside a box that the user drags; and three views.

Both are a region of interest that crops the rendering, which every Slicer since 5.0 can do. For the red slice it is a
large box with one face on the slice, turned as the slice is turned, that follows the slice.
"""

from __future__ import annotations

import slicer
import vtk
from slicer.util import VTKObservationMixin

from . import rendering, three_d_views, view_fit

CUTS = ["none", "slice", "box"]
_RED = "vtkMRMLSliceNodeRed"
_ATTRIBUTE = "MedColor.Cut"  # on the region: which kind of cut it is
ROLE = "MedColorCut"  # on the display node: its region


def cut_of(volume_node) -> str:
    """Which of `CUTS` a volume is shown with."""
    display = rendering.display_node_of(volume_node) if volume_node else None
    roi = display.GetNodeReference(ROLE) if display else None
    if roi is None or not display.GetCroppingEnabled():
        return "none"
    return roi.GetAttribute(_ATTRIBUTE) or "box"


def set_cut(volume_node, kind: str, from_viewer: bool = True) -> None:
    """Cut the rendering of a volume open; `kind` is one of `CUTS`. Without a display nothing happens.

    Args:
        from_viewer: the side of the slice that faces the first 3-D view is taken away; else the side it points to.
    """
    display = rendering.display_node_of(volume_node)
    if display is None:
        return
    if kind == "none":
        display.SetCroppingEnabled(False)
        _show_handles(display.GetNodeReference(ROLE), False)
        return
    bounds = view_fit.body_bounds(volume_node)
    if bounds is None:
        return
    roi = _region(volume_node, display)
    before = roi.GetAttribute(_ATTRIBUTE)
    roi.SetAttribute(_ATTRIBUTE, kind)
    if kind == "box":
        if before != "box":
            _place_box(roi, bounds)
    else:
        view = volume_node.GetScene().GetNodeByID(_RED)
        matrix = slice_matrix(view, bounds)
        side = _side_of_viewer(volume_node.GetScene(), matrix) if from_viewer else 1.0
        roi.SetAttribute("MedColor.Side", str(side))
        place_on_slice(roi, matrix, bounds, side)
    _show_handles(roi, kind == "box")
    display.SetAndObserveROINodeID(roi.GetID())
    display.SetCroppingEnabled(True)


def slice_matrix(view, bounds):
    """(4, 4) slice to RAS of a slice view; a transverse slice through the middle of the body where there is none."""
    import numpy as np

    if view is not None:
        return slicer.util.arrayFromVTKMatrix(view.GetSliceToRAS()).copy()
    matrix = np.diag([-1.0, 1.0, 1.0, 1.0])
    matrix[:3, 3] = [(bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)]
    return matrix


def place_on_slice(roi, matrix, bounds, side: float) -> None:
    """Keep what lies on the side of the slice that is not `side` (1: where the slice's normal points, -1: the other)."""
    import numpy as np

    size = 4.0 * max(bounds[2 * axis + 1] - bounds[2 * axis] for axis in range(3))
    centre = np.array([(bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)])
    normal = matrix[:3, 2]
    on_plane = centre - ((centre - matrix[:3, 3]) @ normal) * normal
    placed = np.array(matrix)
    placed[:3, 3] = on_plane - side * size / 2 * normal
    with slicer.util.NodeModify(roi):
        roi.SetSize(size, size, size)
        roi.SetCenter(0.0, 0.0, 0.0)
        roi.SetAndObserveObjectToNodeMatrix(slicer.util.vtkMatrixFromArray(placed))


def _place_box(roi, bounds) -> None:
    """The front upper part is outside the box at first, so that the body is seen to be open."""
    low, high = list(bounds[::2]), list(bounds[1::2])
    high[2] -= 0.3 * (high[2] - low[2])
    with slicer.util.NodeModify(roi):
        roi.SetAndObserveObjectToNodeMatrix(vtk.vtkMatrix4x4())
        roi.SetCenter(*((a + b) / 2 for a, b in zip(low, high)))
        roi.SetSize(*(b - a for a, b in zip(low, high)))


def _side_of_viewer(scene, matrix) -> float:
    camera = three_d_views.camera_of(scene, next(iter(three_d_views.shown_views()), None))
    if camera is None:
        return 1.0
    position = camera.GetPosition()
    away = sum((position[axis] - matrix[axis, 3]) * matrix[axis, 2] for axis in range(3))
    return 1.0 if away >= 0 else -1.0


def _region(volume_node, display):
    roi = display.GetNodeReference(ROLE)
    if roi is None:
        roi = volume_node.GetScene().AddNewNodeByClass("vtkMRMLMarkupsROINode", f"{volume_node.GetName()} cut")
        roi.SetHideFromEditors(True)  # nobody takes it for the region to be coloured
        roi.CreateDefaultDisplayNodes()
        display.SetNodeReferenceID(ROLE, roi.GetID())
    return roi


def _show_handles(roi, shown: bool) -> None:
    display = roi.GetDisplayNode() if roi else None
    if display is not None:
        display.SetVisibility(shown)
        if hasattr(display, "SetFillVisibility"):
            display.SetFillVisibility(False)
        if hasattr(display, "SetHandlesInteractive"):
            display.SetHandlesInteractive(shown)


class SliceFollower(VTKObservationMixin):
    """Moves the cut of the volumes that are cut at the red slice as the user scrolls."""

    def __init__(self, scene) -> None:
        VTKObservationMixin.__init__(self)
        self._scene, self._view = scene, None

    def update(self) -> None:
        """Find the red slice view; it comes and goes with scenes."""
        view = self._scene.GetNodeByID(_RED)
        if view is not self._view:
            self.removeObservers()
            self._view = view
            if view is not None:
                self.addObserver(view, vtk.vtkCommand.ModifiedEvent, self.follow)

    def follow(self, *_arguments) -> None:
        """Bring every cut in line with the slice."""
        for n in range(self._scene.GetNumberOfNodesByClass(rendering.DISPLAY_CLASS)):
            display = self._scene.GetNthNodeByClass(n, rendering.DISPLAY_CLASS)
            roi, volume = display.GetNodeReference(ROLE), display.GetDisplayableNode()
            if roi is None or volume is None or roi.GetAttribute(_ATTRIBUTE) != "slice":
                continue
            if display.GetCroppingEnabled():
                bounds = [0.0] * 6
                volume.GetRASBounds(bounds)
                place_on_slice(
                    roi, slice_matrix(self._view, bounds), bounds, float(roi.GetAttribute("MedColor.Side") or 1)
                )


def show_view(volume_node, name: str) -> None:
    """One of three views: "front" uncut, "half" the left half taken away, "open" the upper part taken away.

    Cut faces are to be seen: with a haze before them the slider goes up to what pictures have.
    """
    bounds = view_fit.body_bounds(volume_node)
    display = rendering.display_node_of(volume_node)
    if bounds is None or display is None:
        return
    import numpy as np

    from MedColorLib.rendering import presets

    view_fit.look(volume_node.GetScene(), bounds, name)
    if name == "front":
        set_cut(volume_node, "none")
        return
    if rendering.opacity_of(volume_node) < presets.PICTURE_OPACITY:
        rendering.set_opacity(volume_node, presets.PICTURE_OPACITY)
    middle = [(bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)]
    low, high = list(bounds[::2]), list(bounds[1::2])
    if name == "half":
        low[0] = middle[0]  # RAS: the left half lies below the middle
    else:
        high[2] = low[2] + 0.55 * (high[2] - low[2])
    roi = _region(volume_node, display)
    set_cut(volume_node, "box")
    margin = 0.05 * np.ptp([low, high], axis=0)
    low = [edge if edge == middle[axis] else edge - margin[axis] for axis, edge in enumerate(low)]
    with slicer.util.NodeModify(roi):
        roi.SetAndObserveObjectToNodeMatrix(vtk.vtkMatrix4x4())
        roi.SetCenter(*((a + b) / 2 for a, b in zip(low, high)))
        roi.SetSize(*(b - a for a, b in zip(low, high)))
    _show_handles(roi, False)
