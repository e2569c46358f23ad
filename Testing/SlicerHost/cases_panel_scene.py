"""The panel stays in line with a scene that changes while it is open, in every way that a scene can change."""

from __future__ import annotations

import numpy as np
import pytest
import slicer
from host_fixtures import color_node, grey_node, node_ids, two_colors
from panel_fixtures import shown, ui_settled, warp


def run_while(panel, library, action, delay_ms=80):
    import qt

    library.pause_seconds = 0.2
    qt.QTimer.singleShot(delay_ms, action)
    panel.ui.applyButton.click()


# --- scenes and volumes that come ---------------------------------------------------------------------------------------


def saved_scene(ready, tmp_path):
    """A bundle with a volume, its picture, its result shown in 3-D, and the choices of the panel."""
    ready.ui.applyButton.click()
    assert ready.ui.show3DCheckBox.checked
    path = str(tmp_path / "scene.mrb")
    assert slicer.mrmlScene.WriteToMRB(path)
    return path


@pytest.mark.parametrize("closed_first", [True, False], ids=["loaded", "imported"])
def test_scene_read_while_the_panel_is_open(ready, tmp_path, closed_first):
    path = saved_scene(ready, tmp_path)
    slicer.mrmlScene.Clear(0)
    ui_settled()
    assert not ready.ui.applyButton.enabled
    if closed_first:
        slicer.mrmlScene.SetURL(path)
    assert slicer.mrmlScene.ReadFromMRB(path)
    ui_settled()
    assert ready.parameters.inputVolume.GetName() == "head"
    assert ready.ui.inputSelector.currentNode() is ready.parameters.inputVolume
    assert ready.parameters.outputVolume.GetName() == "head coloured"
    assert ready.ui.applyButton.enabled
    assert ready.ui.show3DCheckBox.checked


def test_scene_restored_from_a_view_of_it(ready):
    """Scene views replace nodes' contents in place."""
    volume = ready.parameters.inputVolume
    for event in (slicer.mrmlScene.StartRestoreEvent, slicer.mrmlScene.EndRestoreEvent):
        slicer.mrmlScene.InvokeEvent(event)
    ui_settled()
    assert ready.parameters.inputVolume is volume
    assert ready.ui.applyButton.enabled


def test_volume_added_while_the_panel_is_open_is_chosen(panel):
    assert panel.parameters.inputVolume is None
    first = grey_node("first")
    ui_settled()
    assert panel.parameters.inputVolume is first
    grey_node("second")
    ui_settled()
    assert panel.parameters.inputVolume is first, "a choice is kept"


def test_volume_whose_voxels_come_later_is_chosen(panel):
    node = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "late")
    ui_settled()
    assert panel.parameters.inputVolume is None
    slicer.util.updateVolumeFromArray(node, np.arange(60, dtype=np.int16).reshape(3, 4, 5))
    ui_settled()
    assert panel.parameters.inputVolume is node


def test_confidence_is_never_chosen_by_itself(ready):
    ready.ui.confidenceCheckBox.click()
    ready.ui.applyButton.click()
    slicer.mrmlScene.RemoveNode(ready.parameters.inputVolume)
    ui_settled()
    ready.exit()
    ready.enter()
    assert ready.parameters.inputVolume is None


# --- nodes that change ---------------------------------------------------------------------------------------------------


def coloured(node):
    node.SetAndObserveImageData(color_node(two_colors(8, 3)).GetImageData())


def emptied(node):
    node.SetAndObserveImageData(None)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (emptied, "no voxels"),
        (coloured, "3 values per voxel"),
        (lambda node: node.GetScene().RemoveNode(node), "Select a volume"),
    ],
)
def test_input_that_cannot_be_coloured_any_more(ready, change, words):
    ui_settled()
    assert ready.ui.applyButton.enabled
    change(ready.parameters.inputVolume)
    ui_settled()
    assert not ready.ui.applyButton.enabled
    assert words in ready.ui.applyButton.toolTip


def test_reference_that_loses_its_colour(ready):
    slicer.util.updateVolumeFromArray(ready.parameters.referenceNode, np.zeros((1, 4, 4), np.uint8))
    ui_settled()
    assert "no 8-bit colour" in ready.ui.applyButton.toolTip


def test_new_voxels_ask_for_a_new_plan(ready):
    asked = []
    ready.plan.changed = lambda: asked.append(True)
    ui_settled()
    asked.clear()
    slicer.util.updateVolumeFromArray(ready.parameters.inputVolume, np.ones((6, 8, 10), np.int16))
    ui_settled()
    assert asked


def test_renamed_volume_is_named_so_in_messages(ready):
    ready.parameters.inputVolume.SetName("new name")
    emptied(ready.parameters.inputVolume)
    ui_settled()
    assert "new name has no voxels" in ready.ui.applyButton.toolTip


# --- one result for each volume -------------------------------------------------------------------------------------------


def test_another_volume_gets_a_result_of_its_own(ready):
    first_grey, second_grey = ready.parameters.inputVolume, grey_node("knee")
    ready.ui.applyButton.click()
    first = ready.parameters.outputVolume
    ready.parameters.inputVolume = second_grey
    assert ready.parameters.outputVolume is None, "create a new volume"
    ready.ui.applyButton.click()
    second = ready.parameters.outputVolume
    assert (first.GetName(), second.GetName()) == ("head coloured", "knee coloured")
    ready.parameters.inputVolume = first_grey
    assert ready.parameters.outputVolume is first
    ready.ui.applyButton.click()
    assert ready.parameters.outputVolume is first, "the same volume again fills its result again"


def test_a_volume_chosen_by_hand_is_filled(ready):
    chosen = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", "mine")
    ready.parameters.outputVolume = chosen
    ready.parameters.inputVolume = grey_node("knee")
    assert ready.parameters.outputVolume is chosen, "it holds no colours of another volume"


# --- transforms ------------------------------------------------------------------------------------------------------------


def test_non_linear_transform_is_said_below_the_buttons(ready):
    ready.ui.applyButton.click()
    result = ready.parameters.outputVolume
    assert "Done" in ready.ui.statusLabel.text
    assert "harden" not in ready.ui.statusLabel.text
    result.SetAndObserveTransformNodeID(warp(slicer.mrmlScene).GetID())
    ui_settled()
    assert "harden the transform" in ready.ui.statusLabel.text
    assert shown(ready.ui.statusLabel)
    ready.ui.show3DCheckBox.click()
    assert "harden" not in ready.ui.statusLabel.text, "nothing is shown, nothing is missing"
    ready.ui.show3DCheckBox.click()
    assert "harden the transform" in ready.ui.statusLabel.text
    result.HardenTransform()
    ui_settled()
    assert "harden" not in ready.ui.statusLabel.text


# --- runs that go on for nothing -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["output removed", "voxels replaced", "voxels replaced, same shape", "emptied"])
def test_run_ends_at_once_when_it_is_for_nothing(ready, library, what):
    ready.ui.applyButton.click()
    output, grey = ready.parameters.outputVolume, ready.parameters.inputVolume
    colours = slicer.util.arrayFromVolume(output).copy()
    action = {
        "output removed": lambda: slicer.mrmlScene.RemoveNode(output),
        "voxels replaced": lambda: slicer.util.updateVolumeFromArray(grey, np.ones((3, 3, 3), np.int16)),
        "voxels replaced, same shape": lambda: slicer.util.updateVolumeFromArray(grey, np.ones((6, 8, 10), np.int16)),
        "emptied": lambda: emptied(grey),
    }[what]
    library.steps, before = 100, len(library.calls)
    run_while(ready, library, action)
    assert len(library.calls) == before + 1
    assert library.finished == before, "it was stopped"
    text = ready.ui.statusLabel.text
    assert "head coloured was removed" in text if what == "output removed" else "changed while" in text
    if what != "output removed":
        assert (slicer.util.arrayFromVolume(output) == colours).all()


def test_other_nodes_may_go_during_a_run(ready, library):
    other, picture = grey_node("other"), ready.parameters.referenceNode
    run_while(ready, library, lambda: [slicer.mrmlScene.RemoveNode(node) for node in (other, picture)])
    assert "Done" in ready.ui.statusLabel.text


# --- times, marks, status -------------------------------------------------------------------------------------------------


def test_times_beside_the_presets_are_new_after_a_run(ready, library):
    ready.plan._slices = 5000
    ready.plan.showTimes()
    before = ready.ui.presetComboBox.itemText(1)
    library.report = {"plan": {"slices": [0]}}
    library.pause_seconds = 0.4
    ready.ui.applyButton.click()
    assert ready.ui.presetComboBox.itemText(1) != before


def test_status_goes_with_the_scene(ready):
    ready.ui.applyButton.click()
    assert ready.ui.statusLabel.text
    slicer.mrmlScene.Clear(0)
    ui_settled()
    assert ready.ui.statusLabel.text == ""


def test_mark_follows_what_is_hidden_elsewhere(ready):
    from MedColorSlicer import rendering

    ready.ui.applyButton.click()
    display = rendering.display_node_of(ready.parameters.outputVolume)
    for visible in (False, True):
        display.SetVisibility(visible)
        ui_settled()
        assert ready.ui.show3DCheckBox.checked is visible
        assert ready.ui.opacitySlider.enabled is visible
    slicer.mrmlScene.RemoveNode(display)
    ui_settled()
    assert not ready.ui.show3DCheckBox.checked


def test_layout_changed_while_comparing_ends_the_comparison(ready):
    layout = slicer.vtkMRMLLayoutNode()
    slicer.mrmlScene.AddNode(layout)
    layout.SetViewArrangement(layout.SlicerLayoutConventionalView)
    ready.ui.applyButton.click()
    ready.ui.compareCheckBox.click()
    assert layout.GetViewArrangement() == layout.SlicerLayoutDual3DView
    layout.SetViewArrangement(layout.SlicerLayoutFourUpView)
    ui_settled()
    assert not ready.ui.compareCheckBox.checked
    assert layout.GetViewArrangement() == layout.SlicerLayoutFourUpView
    ready.ui.compareCheckBox.click()
    ready.ui.compareCheckBox.click()
    assert layout.GetViewArrangement() == layout.SlicerLayoutFourUpView, "the one before the second comparison"


def test_comparison_ends_with_its_volumes(ready):
    ready.ui.applyButton.click()
    before = node_ids(slicer.mrmlScene)
    ready.ui.compareCheckBox.click()
    assert ready.ui.compareCheckBox.checked
    ready.ui.compareCheckBox.click()
    assert node_ids(slicer.mrmlScene) == before
    ready.ui.compareCheckBox.click()
    slicer.mrmlScene.RemoveNode(ready.parameters.inputVolume)
    ui_settled()
    assert not ready.ui.compareCheckBox.checked
