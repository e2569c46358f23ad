"""Slice views and cameras fitted to the body: not to the box of air around it, nor to whatever else is in the scene."""

from __future__ import annotations

import math

import slicer

from . import three_d_views
from .scene import ijk_to_world

_MARGIN = 1.08
# Name: (from the body to the viewer, up), RAS.
DIRECTIONS = {
    "front": ((-0.35, 0.9, 0.2), (0.0, 0.0, 1.0)),
    "half": ((-0.92, 0.34, 0.16), (0.0, 0.0, 1.0)),
    "open": ((-0.25, 0.6, 0.75), (0.0, 0.0, 1.0)),
}


def body_bounds(color_node):
    """[x0, x1, y0, y1, z0, z1] mm RAS of what is not black in a coloured volume; None where all is."""
    import numpy as np

    from MedColorLib.rendering.grid import tissue_box

    box = tissue_box(slicer.util.arrayFromVolume(color_node))
    if box is None:
        return None
    ends = [(part.start - 0.5, part.stop - 0.5) for part in box[::-1]]
    corners = np.array([[i, j, k, 1.0] for i in ends[0] for j in ends[1] for k in ends[2]])
    ras = (ijk_to_world(color_node) @ corners.T)[:3]
    return [float(edge) for axis in ras for edge in (axis.min(), axis.max())]


def fit_slices(scene, bounds) -> None:
    """Every slice view shows the whole body, through its own slice where that meets the body."""
    import numpy as np

    corners = np.array([[x, y, z, 1.0] for x in bounds[:2] for y in bounds[2:4] for z in bounds[4:]])
    centre = [(bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)]
    for n in range(scene.GetNumberOfNodesByClass("vtkMRMLSliceNode")):
        view = scene.GetNthNodeByClass(n, "vtkMRMLSliceNode")
        to_slice = np.linalg.inv(slicer.util.arrayFromVTKMatrix(view.GetSliceToRAS()))
        low, high = (to_slice @ corners.T)[:3].min(axis=1), (to_slice @ corners.T)[:3].max(axis=1)
        target = list(centre)
        if low[2] <= 0.0 <= high[2]:  # the slice stays; only the middle of the view moves
            middle = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0.0, 1.0]
            target = list((np.linalg.inv(to_slice) @ middle)[:3])
        columns, rows = view.GetDimensions()[:2]
        height = _MARGIN * max(high[1] - low[1], (high[0] - low[0]) * rows / max(columns, 1))
        view.JumpSliceByCentering(*target)
        view.SetFieldOfView(height * columns / max(rows, 1), height, view.GetFieldOfView()[2])


def look(scene, bounds, direction: str = "front") -> None:
    """The cameras of all 3-D views at a body, from one of `DIRECTIONS`."""
    three_d_views.boxes_around_what_is_shown()
    towards, up = DIRECTIONS[direction]
    length = math.sqrt(sum(part * part for part in towards))
    centre = [(bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)]
    radius = 0.5 * math.dist(bounds[::2], bounds[1::2])
    for n in range(scene.GetNumberOfNodesByClass("vtkMRMLCameraNode")):
        camera = scene.GetNthNodeByClass(n, "vtkMRMLCameraNode")
        # the ball around the body is larger than the body: at 0.8 of its radius nothing is cut off
        distance = 0.8 * radius / math.sin(math.radians(camera.GetViewAngle()) / 2)
        camera.SetFocalPoint(*centre)
        camera.SetPosition(*(c + distance * t / length for c, t in zip(centre, towards)))
        camera.SetViewUp(*up)
        camera.SetParallelScale(0.8 * radius)
        camera.ResetClippingRange()
    three_d_views.render_again()
