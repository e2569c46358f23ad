"""Part of the panel: one coloured slice in seconds, shown over the slice views."""

from __future__ import annotations

import slicer
import vtk
from slicer.i18n import tr as _

from . import comparison, scene
from .parameters import settings_from

PARALLEL_COSINE = 0.9998  # of the angle between slice and view up to which they count as parallel: about 1 degree


class PreviewPart:
    """Owns the preview node: not saved, removed when the panel is left or the whole volume is coloured."""

    def __init__(self, panel) -> None:
        self.panel = panel
        self._node = None
        self._earlier = None  # (slice view, its matrix) before it was turned to a tilted volume
        panel.ui.previewButton.clicked.connect(self._onPreview)

    def remove(self) -> None:
        """Take the preview out of the scene."""
        node, self._node = self._node, None
        if node is not None and slicer.mrmlScene.IsNodePresent(node):
            scene.remove(node)
        if self._earlier:
            view, matrix = self._earlier
            self._earlier = None
            if slicer.mrmlScene.IsNodePresent(view):
                view.GetSliceToRAS().DeepCopy(matrix)
                view.UpdateMatrices()

    @property
    def shown(self) -> bool:
        """Whether a preview lies over the slices."""
        return self._node is not None

    def forget(self) -> None:
        """The scene removes the node itself."""
        self._node, self._earlier = None, None

    def onNodeRemoved(self, node) -> None:
        """The user removed the preview."""
        if node is self._node:
            self._node = None

    def _onPreview(self, _checked=False) -> None:
        self.panel.live.stop()
        self.panel.runJob(self._preview, volume=self.panel.parameters.inputVolume)

    def _preview(self, job) -> str:
        p = self.panel.parameters
        grey = p.inputVolume
        index = current_slice(grey)
        self._node = self.panel.logic.preview(
            grey,
            self.panel.inputs.references(),
            index,
            settings_from(p),
            job.cancelled,
            run=self.panel.runResponsive,
            previous=self._node,
            **self.panel.nodes.arguments(),
        )
        comparison.overlay(slicer.mrmlScene, grey, self._node, 1.0)
        text = _("Preview of slice {index}, at draft quality.").format(index=index)
        return " ".join(part for part in (text, self._turned_to(grey)) if part)

    def _turned_to(self, grey) -> str:
        """Turn the red view to the slices of a tilted volume, which it would cut to a stripe; what was done, or why not."""
        transform = grey.GetParentTransformNode()
        if transform is not None and not transform.IsTransformToWorldLinear():
            return _(
                "The volume is under a non-linear transform: slice views cut the bent slice where they meet it. Harden the "
                "transform to preview what they show."
            )
        view = slicer.mrmlScene.GetNodeByID(_RED)
        if view is None or _parallel(view, grey):
            return ""
        if self._earlier is None:
            earlier = vtk.vtkMatrix4x4()
            earlier.DeepCopy(view.GetSliceToRAS())
            self._earlier = (view, earlier)
        view.RotateToVolumePlane(grey)
        return _("The volume is tilted: the red view was turned to its slices, until you leave the module or apply.")


_RED = "vtkMRMLSliceNodeRed"


def _parallel(view, node) -> bool:
    """Whether a slice view shows whole slices of a volume."""
    import numpy as np

    order, _count = scene.stack_of(node)
    axes = scene.ijk_to_world(node)[:3, :3]
    rows, columns = (axes[:, 2 - axis] for axis in order.axes[1:])
    normal = np.cross(rows, columns)
    to_ras = view.GetSliceToRAS()
    shown = [to_ras.GetElement(axis, 2) for axis in range(3)]
    return abs(normal @ shown) >= PARALLEL_COSINE * np.linalg.norm(normal)


def current_slice(node) -> int:
    """Number of the slice of `node` at the centre of the red slice view; the middle one without such a view."""
    view = slicer.mrmlScene.GetNodeByID(_RED)
    if view is None:
        return scene.stack_of(node)[1] // 2
    to_ras = view.GetSliceToRAS()
    return scene.slice_index_at(node, [to_ras.GetElement(axis, 3) for axis in range(3)])
