"""Slicer's 3-D views. Every part of the module that needs one asks here.

The layout manager keeps the views of all layouts that were ever chosen, the hidden ones too, in no order at all: the first
may be one that is not drawn.
"""

from __future__ import annotations

import slicer


def all_views() -> list:
    """Every qMRMLThreeDView, also those that the present layout hides, in the order of their names; [] without a window."""
    manager = slicer.app.layoutManager()
    widgets = [manager.threeDWidget(index) for index in range(manager.threeDViewCount if manager else 0)]
    found = [widget.threeDView() for widget in widgets if widget]
    return sorted((view for view in found if view and view.mrmlViewNode()), key=_rank)


def shown_views() -> list:
    """The views that the user sees, in the order of their names: "1" is the first one.

    Until Slicer has processed the events of a new layout, none is seen; then it is those that the layout has.
    """
    views = all_views()
    return [view for view in views if view.visible] or [
        view for view in views if view.mrmlViewNode().IsMappedInLayout()
    ]


def camera_of(scene, view):
    """The camera node of a view; the first one of the scene without a view or where it has none."""
    name, kind = view.mrmlViewNode().GetLayoutName() if view else None, "vtkMRMLCameraNode"
    cameras = [scene.GetNthNodeByClass(n, kind) for n in range(scene.GetNumberOfNodesByClass(kind))]
    own = [camera for camera in cameras if camera.GetLayoutName() == name]
    return next(iter(own or cameras), None)


def boxes_around_what_is_shown() -> None:
    """The box and the letters of every view where Slicer's own centring puts them; it turns the camera, too.

    A view draws them anew for nothing else: they would stay where an earlier volume was, or the origin.
    """
    for view in all_views():
        view.resetFocalPoint()


def render_again() -> None:
    """Draw every view anew: those that were hidden meanwhile do not notice what changed."""
    for view in all_views():
        view.scheduleRender()


def _rank(view) -> tuple:
    name = view.mrmlViewNode().GetLayoutName() or ""
    return len(name), name  # "2" before "10"
