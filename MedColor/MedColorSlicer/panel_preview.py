"""Part of the panel: one coloured slice in seconds, shown over the slice views."""

from __future__ import annotations

import slicer
from slicer.i18n import tr as _

from . import comparison, scene
from .parameters import settings_from


class PreviewPart:
    """Owns the preview node: not saved, removed when the panel is left or the whole volume is coloured."""

    def __init__(self, panel) -> None:
        self.panel = panel
        self._node = None
        panel.ui.previewButton.clicked.connect(self._onPreview)

    def remove(self) -> None:
        """Take the preview out of the scene."""
        node, self._node = self._node, None
        if node is not None and slicer.mrmlScene.IsNodePresent(node):
            scene.remove(node)

    def forget(self) -> None:
        """The scene removes the node itself."""
        self._node = None

    def onNodeRemoved(self, node) -> None:
        """The user removed the preview."""
        if node is self._node:
            self._node = None

    def _onPreview(self, _checked=False) -> None:
        self.panel.runJob(self._preview)

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
            labels=p.labels,
        )
        comparison.overlay(slicer.mrmlScene, grey, self._node, 1.0)
        return _("Preview of slice {index}, at draft quality.").format(index=index)


def current_slice(node) -> int:
    """Number of the slice of `node` at the centre of the red slice view; the middle one without such a view."""
    view = slicer.mrmlScene.GetNodeByID("vtkMRMLSliceNodeRed")
    if view is None:
        return scene.stack_of(node)[1] // 2
    to_ras = view.GetSliceToRAS()
    return scene.slice_index_at(node, [to_ras.GetElement(axis, 3) for axis in range(3)])
