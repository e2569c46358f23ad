"""Part of the panel: nodes and files besides volume and photograph: region, tissue labels, body, tissue of the reference."""

from __future__ import annotations

import os

import slicer
import vtk
from slicer.i18n import tr as _

from . import labels, reference_masks, scene, view_fit

# Field of the parameter node -> its selector; of several classes or of a class that may not be loaded yet, so tied by hand.
_SELECTORS = {
    "roi": "roiSelector",
    "labels": "labelsSelector",
    "bodyNode": "bodySelector",
    "referenceMaskNode": "referenceMaskSelector",
}
FILES = ("files", "recommended")  # kinds of reference whose mask is a file, too


class NodesPart:
    """Ties the selectors to the parameter node, and turns them into arguments of the logic."""

    def __init__(self, panel) -> None:
        self.panel, self.ui = panel, panel.ui
        for field, name in _SELECTORS.items():
            selector = getattr(self.ui, name)
            selector.currentNodeChanged.connect(
                lambda *_, field=field, selector=selector: self._onNode(field, selector)
            )
        self.ui.roiSelector.nodeAddedByUser.connect(self._onNewRegion)
        self.ui.referenceMaskLineEdit.currentPathChanged.connect(self._onMaskPath)

    def update(self) -> None:
        """Selectors and rows in line with the parameter node."""
        p, ui = self.panel.parameters, self.ui
        for field, name in _SELECTORS.items():
            selector, node = getattr(ui, name), getattr(p, field)
            if selector.currentNode() is not node:
                selector.setCurrentNode(node)
        if ui.referenceMaskLineEdit.currentPath != p.referenceMaskPath:
            ui.referenceMaskLineEdit.currentPath = p.referenceMaskPath
        ui.referenceMaskLabel.visible = p.referenceSource != "sample"
        ui.referenceMaskSelector.visible = p.referenceSource == "node"
        ui.referenceMaskLineEdit.visible = p.referenceSource in FILES
        ui.bodySelector.visible = p.body == "node"
        ui.exposureGainSlider.visible = p.exposure == "gain"
        ui.groupLabelsCheckBox.enabled = self._segmented()

    def nodes(self) -> list:
        """What the panel looks at; None among them."""
        return [getattr(self.panel.parameters, field) for field in _SELECTORS]

    def state(self) -> tuple:
        """What changes whenever one of the nodes does; for a plan that need not be asked for again."""
        p = self.panel.parameters
        marks = [scene.region_state(p.roi), p.referenceNode.GetMTime() if p.referenceNode else 0]
        drawn = (p.referenceMaskNode, p.labels, p.bodyNode if p.body == "node" else None)
        return (*marks, *(labels.state_of(node) for node in drawn))

    def problem(self) -> str:
        """Why nothing can be coloured with these, as a sentence; empty if it can."""
        p = self.panel.parameters
        if p.body == "node" and p.bodyNode is None:
            return _("Select the label map or segmentation that is the body, or let it be found (Advanced, Body).")
        problem = labels.labels_problem(p.labels) or (labels.labels_problem(p.bodyNode) if p.body == "node" else "")
        if not problem and p.referenceSource == "node":
            problem = reference_masks.mask_problem(p.referenceMaskNode, p.referenceNode)
        if (
            not problem
            and p.referenceSource in FILES
            and p.referenceMaskPath
            and not os.path.exists(p.referenceMaskPath)
        ):
            problem = _("There is no file or folder {path}; choose the mask of the reference again.").format(
                path=p.referenceMaskPath
            )
        return problem

    def arguments(self) -> dict:
        """Keywords of `MedColorLogic.process`."""
        p = self.panel.parameters
        mask = p.referenceMaskNode if p.referenceSource == "node" else None
        if p.referenceSource in FILES:
            mask = p.referenceMaskPath or None
        return {
            "roi": p.roi,
            "labels": p.labels,
            "labelGroups": labels.BY_TISSUE if self._segmented() and p.groupLabels else None,
            "body": p.bodyNode if p.body == "node" else None,
            "referenceMasks": None if mask is None else [mask],
        }

    def _segmented(self) -> bool:
        chosen = self.panel.parameters.labels
        return bool(chosen and chosen.IsA("vtkMRMLSegmentationNode"))  # VTK says 1

    def _onNode(self, field: str, selector) -> None:
        p, chosen = self.panel.parameters, selector.currentNode()
        if p and getattr(p, field) is not chosen:
            setattr(p, field, chosen)

    def _onMaskPath(self, path) -> None:
        p = self.panel.parameters
        if p and p.referenceMaskPath != path:
            p.referenceMaskPath = path

    def _onNewRegion(self, node) -> None:
        """A box that was just made encloses the volume, and has handles in the views."""
        p = self.panel.parameters
        if node is None or p is None:
            return
        node.SetName(slicer.mrmlScene.GenerateUniqueName(_("Region to colour")))
        node.CreateDefaultDisplayNodes()
        if p.inputVolume is not None and p.inputVolume.GetImageData() is not None:
            place_around(node, p.outputVolume, p.inputVolume)


def place_around(roi, color_node, grey_node) -> None:
    """Put a markups ROI around the coloured body where there is one, else around the whole volume."""
    bounds = None
    if color_node is not None and color_node.GetImageData() is not None:
        bounds = view_fit.body_bounds(color_node)
    if bounds is None:
        bounds = [0.0] * 6
        grey_node.GetRASBounds(bounds)
    with slicer.util.NodeModify(roi):
        roi.SetAndObserveObjectToNodeMatrix(vtk.vtkMatrix4x4())
        roi.SetCenter(*((bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)))
        roi.SetSize(*(bounds[2 * axis + 1] - bounds[2 * axis] for axis in range(3)))
