"""Whatever happens to the scene under an open panel, to any of its nodes: nothing trips, and the panel says how things stand."""

from __future__ import annotations

import random

import numpy as np
import pytest
import slicer
from host_fixtures import color_node, empty, grey_node, label_node
from panel_fixtures import PICTURE, turned, ui_settled, warp

KINDS = ["removed", "renamed", "emptied", "under a transform", "hardened", "reordered", "copied", "hidden", "modified"]


@pytest.fixture
def full(ready):
    """The panel with everything chosen that can be: result, 3-D, comparison, labels, body, region, mask, other volumes."""
    p, nodes = ready.parameters, slicer.mrmlScene
    layout = slicer.vtkMRMLLayoutNode()
    nodes.AddNode(layout)
    for name in ("vtkMRMLSliceCompositeNode", "vtkMRMLCameraNode", "vtkMRMLViewNode"):
        nodes.AddNewNodeByClass(name)
    grey_node("knee")
    p.inputVolume.SetAndObserveTransformNodeID(turned(nodes, 5).GetID())
    ready.ui.applyButton.click()
    ready.ui.compareCheckBox.click()
    ready.ui.cutComboBox.currentIndex = 2
    ready.ui.roiSelector.addNode()
    p.labels, p.body, p.bodyNode = label_node(), "node", label_node(name="torso")
    p.referenceMaskNode = label_node(np.ones((1, 16, 16), np.uint8), "drawn")
    p.parameterNode.AddNodeReferenceID("otherVolumes", slicer.util.getNode("knee").GetID())
    ui_settled()
    return ready


def everything():
    nodes = slicer.mrmlScene
    return [nodes.GetNthNode(n) for n in range(nodes.GetNumberOfNodes())]


def happens(kind, node):
    """One thing that may happen to a node."""
    nodes = slicer.mrmlScene
    transformable = node.IsA("vtkMRMLTransformableNode")
    if kind == "removed":
        nodes.RemoveNode(node)
    elif kind == "renamed":
        node.SetName("another name")
    elif kind == "emptied" and node.IsA("vtkMRMLVolumeNode"):
        node.SetAndObserveImageData(None)
    elif kind == "under a transform" and transformable and not node.IsA("vtkMRMLTransformNode"):
        node.SetAndObserveTransformNodeID(warp(nodes).GetID())
    elif kind == "hardened" and transformable:
        node.HardenTransform()
    elif kind == "reordered" and node.IsA("vtkMRMLVolumeNode") and node.GetImageData():
        slicer.util.updateVolumeFromArray(node, np.ascontiguousarray(slicer.util.arrayFromVolume(node)[:, ::-1]))
    elif kind == "copied" and node.IsA("vtkMRMLVolumeNode"):
        copy = nodes.CreateNodeByClass(node.GetClassName())
        copy.UnRegister(None)
        copy.Copy(node)
        nodes.AddNode(copy)
    elif kind == "hidden":
        node.SetHideFromEditors(True)
    elif kind == "modified":
        node.Modified()


def sound(panel):
    """The panel says how things stand, and can be left and entered."""
    ui_settled()
    for _turn in range(2):
        if panel.parameters is None:
            panel.enter()
        says_how_things_stand(panel)
        panel.exit()


def says_how_things_stand(panel):
    missing = panel.whatIsMissing()
    assert panel.ui.applyButton.enabled is (not missing)
    assert panel.ui.applyButton.toolTip == (missing or "Colour the volume.")


@pytest.mark.parametrize("kind", KINDS)
def test_anything_may_happen_to_any_node(full, kind):
    """One after the other, in an order that is different for each kind; after each the panel is sound."""
    order = everything()
    random.Random(kind).shuffle(order)
    for node in order:
        if slicer.mrmlScene.IsNodePresent(node):
            happens(kind, node)
            ui_settled()
            says_how_things_stand(full)
    sound(full)


@pytest.mark.parametrize("kind", ["removed", "emptied", "reordered", "hardened", "under a transform"])
def test_anything_may_happen_during_a_run(full, library, kind):
    import qt

    library.pause_seconds = 0.1
    p = full.parameters
    order = [node for node in everything() if node is not p.parameterNode]
    random.Random(kind).shuffle(order)

    def all_at_once():
        for node in order:
            if slicer.mrmlScene.IsNodePresent(node):
                happens(kind, node)

    qt.QTimer.singleShot(60, all_at_once)
    full.ui.applyButton.click()
    assert full.ui.statusLabel.text
    assert "Unexpected" not in full.ui.statusLabel.text
    sound(full)


def test_panel_outlives_its_parameter_node(full):
    slicer.mrmlScene.RemoveNode(full.parameters.parameterNode)
    ui_settled()
    assert slicer.mrmlScene.IsNodePresent(full.parameters.parameterNode), "a new one"
    full.parameters.referenceNode = color_node(PICTURE, "again")
    full.parameters.referenceSource = "node"
    assert full.ui.applyButton.enabled


def test_undo_brings_back_what_the_panel_had(ready):
    nodes = slicer.mrmlScene
    nodes.SetUndoOn()
    try:
        for node in everything():
            node.SetUndoEnabled(True)
        nodes.SaveStateForUndo()
        nodes.RemoveNode(ready.parameters.inputVolume)
        ui_settled()
        assert not ready.ui.applyButton.enabled
        nodes.Undo()
        ui_settled()
        assert ready.parameters.inputVolume.GetName() == "head"
        assert nodes.IsNodePresent(ready.parameters.inputVolume)
        assert ready.ui.applyButton.enabled
        nodes.Redo()
        ui_settled()
        sound(ready)
    finally:
        nodes.ClearUndoStack()
        nodes.ClearRedoStack()
        nodes.SetUndoOff()


def test_scenes_come_and_go_again_and_again(full, tmp_path):
    path = str(tmp_path / "scene.mrb")
    assert slicer.mrmlScene.WriteToMRB(path)
    for closed_first in (False, True, True):
        if closed_first:
            empty(slicer.mrmlScene)
            ui_settled()
            assert not full.ui.applyButton.enabled
        assert slicer.mrmlScene.ReadFromMRB(path)
        sound(full)
        full.enter()
        assert full.parameters.inputVolume is not None


def test_hardened_input_is_coloured_where_it_lies_now(ready, library):
    grey = ready.parameters.inputVolume
    grey.SetAndObserveTransformNodeID(turned(slicer.mrmlScene, 90).GetID())
    ready.ui.applyButton.click()
    before = library.calls[-1][0].ijk_to_ras
    grey.HardenTransform()
    ui_settled()
    ready.ui.applyButton.click()
    np.testing.assert_allclose(library.calls[-1][0].ijk_to_ras, before, atol=1e-9)
    result = ready.parameters.outputVolume
    assert result.GetTransformNodeID() is None
    np.testing.assert_allclose(
        slicer.util.arrayFromVTKMatrix(matrix_of(result)), slicer.util.arrayFromVTKMatrix(matrix_of(grey))
    )


def matrix_of(node):
    import vtk

    matrix = vtk.vtkMatrix4x4()
    node.GetIJKToRASMatrix(matrix)
    return matrix
