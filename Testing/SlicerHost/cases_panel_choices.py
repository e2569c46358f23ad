"""The panel: exposure, body, tissue of the reference, groups, region; several volumes and time points; kept with the scene."""

from __future__ import annotations

import numpy as np
import pytest
import slicer
from host_fixtures import color_node, grey_node, label_node
from panel_fixtures import PICTURE, shown, ui_settled

from MedColorLib.errors import InputError


def last(library):
    return library.calls[-1][2]


# --- exposure, lightness, body ---------------------------------------------------------------------------------------


def test_exposure_reaches_the_library(ready, library):
    ui = ready.ui
    assert not shown(ui.exposureGainSlider)
    for index, wanted in ((0, "auto"), (1, "off"), (2, 2.5)):
        ui.exposureComboBox.currentIndex = index
        ui.exposureGainSlider.value = 2.5
        assert shown(ui.exposureGainSlider) is (index == 2)
        ui.applyButton.click()
        assert last(library).exposure == wanted


def test_lightness_reaches_the_library_with_natural_luminance_alone(ready, library):
    ui = ready.ui
    ui.lightnessSlider.value = 0.35
    ui.applyButton.click()
    assert last(library).lightness == 0.35
    assert ui.lightnessSlider.enabled
    ui.luminanceComboBox.currentIndex = 1
    assert not ui.lightnessSlider.enabled


def test_body_reaches_the_library(ready, library):
    ui = ready.ui
    for index, wanted in ((1, "all"), (0, "auto")):
        ui.bodyComboBox.currentIndex = index
        assert not shown(ui.bodySelector)
        ui.applyButton.click()
        assert last(library).body == wanted
    ui.bodyComboBox.currentIndex = 2
    assert shown(ui.bodySelector)
    assert not ui.applyButton.enabled
    assert "that is the body" in ui.applyButton.toolTip
    ui.bodySelector.setCurrentNode(label_node(name="torso"))
    for button in (ui.applyButton, ui.previewButton):
        button.click()
        body = last(library).body
        assert body.placed and body.labels.name == "torso"
        assert body.labels.array.shape == (6, 8, 10)


# --- tissue of the reference -----------------------------------------------------------------------------------------


def mask_voxels():
    voxels = np.zeros((1, 16, 16), np.uint8)
    voxels[0, 4:12, 3:9] = 1
    return voxels


@pytest.mark.parametrize("kind", ["label map", "grey picture", "colour picture"])
def test_mask_of_a_reference_in_the_scene(ready, library, kind):
    ui, voxels = ready.ui, mask_voxels()
    if kind == "label map":
        mask = label_node(voxels, "drawn")
    elif kind == "grey picture":
        mask = slicer.util.addVolumeFromArray(200 * voxels, name="drawn")
    else:
        mask = color_node(np.stack([200 * voxels] * 3, -1), "drawn")
    ui.referenceMaskSelector.setCurrentNode(mask)
    ui.applyButton.click()
    (picture,) = library.calls[-1][1]
    assert picture.shape == (16, 16, 4)
    np.testing.assert_array_equal(picture[..., 3] == 255, voxels[0] > 0)
    np.testing.assert_array_equal(picture[..., :3], PICTURE[0])
    assert last(library).reference_masks is None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda panel: label_node(np.ones((1, 4, 5), np.uint8), "small"), "small has 5 x 4 pixels"),
        (lambda panel: panel.parameters.referenceNode, "is the reference itself"),
        (lambda panel: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "bare"), "bare has no voxels"),
        (lambda panel: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "bare"), "bare has no segments"),
    ],
)
def test_masks_that_cannot_be_used(ready, make, words):
    ready.ui.referenceMaskSelector.setCurrentNode(make(ready))
    assert not ready.ui.applyButton.enabled
    assert words in ready.ui.applyButton.toolTip


def test_mask_that_marks_nothing_is_said(ready, library):
    ready.ui.referenceMaskSelector.setCurrentNode(label_node(np.zeros((1, 16, 16), np.uint8), "empty"))
    ready.ui.applyButton.click()
    assert "empty marks no tissue" in ready.ui.statusLabel.text
    assert not library.calls


def test_an_edited_segmentation_is_another_mask_of_the_reference(ready, library):
    """For the plan and the live preview; the node itself is not modified by that."""
    from MedColorSlicer.panel_live import LivePart
    from MedColorSlicer.parameters import settings_from

    p, module_logic = ready.parameters, slicer.vtkSlicerSegmentationsModuleLogic()
    module_logic.SetMRMLScene(slicer.mrmlScene)
    drawn = label_node(mask_voxels(), "drawn")
    p.referenceMaskNode = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "mask")
    assert module_logic.ImportLabelmapToSegmentationNode(drawn, p.referenceMaskNode)
    ui_settled()

    def states():
        return p.referenceMaskNode.GetMTime(), ready.nodes.state(), LivePart._question(p, settings_from(p))

    before = states()
    assert states() == before
    segmentation = p.referenceMaskNode.GetSegmentation()
    painted = slicer.vtkOrientedImageData()
    painted.DeepCopy(segmentation.GetNthSegment(0).GetRepresentation("Binary labelmap"))
    painted.GetPointData().GetScalars().Fill(1)
    edit = module_logic.SetBinaryLabelmapToSegment  # as the Segment Editor does
    assert edit(painted, p.referenceMaskNode, segmentation.GetNthSegmentID(0), module_logic.MODE_REPLACE)
    after = states()
    assert after[0] == before[0]
    assert after[1] != before[1]
    assert after[2] != before[2]
    module_logic.SetMRMLScene(None)


def test_mask_of_a_file_is_a_file(ready, library, tmp_path):
    ui, picture, mask = ready.ui, tmp_path / "section.png", tmp_path / "mask.png"
    for path in (picture, mask):
        path.write_bytes(b"as good as a picture for what is tested here")
    ready.parameters.referenceSource = "files"
    ready.parameters.referencePath = str(picture)
    assert shown(ui.referenceMaskLineEdit)
    assert not shown(ui.referenceMaskSelector)
    ui.referenceMaskLineEdit.currentPath = str(tmp_path / "absent.png")
    assert "absent.png; choose the mask" in ui.applyButton.toolTip
    ui.referenceMaskLineEdit.currentPath = str(mask)
    ui.applyButton.click()
    assert library.calls[-1][1] == [str(picture)]
    assert last(library).reference_masks == (str(mask),)
    with pytest.raises(InputError, match=r"section\.png is a file"):
        ready.logic.process(ready.parameters.inputVolume, [str(picture)], referenceMasks=[label_node(mask_voxels())])


# --- region ----------------------------------------------------------------------------------------------------------


def test_a_new_region_encloses_the_volume_and_is_coloured_alone(ready, library):
    ready.ui.roiSelector.addNode()
    roi = ready.parameters.roi
    assert roi.GetDisplayNode() is not None, "handles to drag"
    ready.ui.applyButton.click()
    assert last(library).region == ((0, 6), (0, 8), (0, 10)), "all of it"
    roi.SetSize(4.0, 4.0, 2.0)
    ready.ui.applyButton.click()
    (k0, k1), (j0, j1), (i0, i1) = last(library).region
    assert (k1 - k0, j1 - j0, i1 - i0) == (2, 4, 4)


def test_the_crop_box_of_the_3d_view_can_be_the_region(ready, library):
    from MedColorSlicer import cut

    ready.ui.applyButton.click()
    cut.set_cut(ready.parameters.outputVolume, "box")
    ui_settled()
    (box,) = ready.ui.roiSelector.nodes()
    ready.ui.roiSelector.setCurrentNode(box)
    ready.ui.applyButton.click()
    assert last(library).region is not None


# --- several volumes -------------------------------------------------------------------------------------------------


def item_of(panel, name):
    items = panel.ui.otherVolumesList
    (found,) = [items.item(n) for n in range(items.count) if items.item(n).text() == name]
    return found


def mark(panel, name, on=True):
    import qt

    item_of(panel, name).setCheckState(qt.Qt.Checked if on else qt.Qt.Unchecked)


@pytest.fixture
def three(ready):
    """The panel with two volumes beside the chosen one."""
    assert not shown(ready.ui.otherVolumesList)
    for name in ("knee", "hand"):
        grey_node(name)
    ui_settled()
    assert shown(ready.ui.otherVolumesList)
    return ready


def names_of_results():
    nodes = slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")
    return sorted(node.GetName() for node in nodes if node.GetName().endswith("coloured"))


def test_marked_volumes_are_coloured_too(three, library):
    mark(three, "knee")
    seen = []
    library.in_the_middle = lambda: seen.append(three.job.state())
    three.ui.applyButton.click()
    assert names_of_results() == ["head coloured", "knee coloured"]
    assert "head coloured, knee coloured" in three.ui.statusLabel.text
    assert three.parameters.outputVolume.GetName() == "head coloured", "the chosen one is shown"
    assert [text.partition(":")[0] for _fraction, text, _left in seen] == ["head, 1 of 2", "knee, 2 of 2"]
    assert seen[0][0] < 0.5 < seen[1][0]
    three.ui.applyButton.click()
    assert names_of_results() == ["head coloured", "knee coloured"], "the same results filled again"
    mark(three, "knee", on=False)
    mark(three, "hand")
    assert [node.GetName() for node in three.volumes.marked()] == ["hand"]


def test_one_that_fails_does_not_keep_the_others(three, library):
    mark(three, "knee")
    mark(three, "hand")

    def fail_on_knee():
        library.error = InputError("too dark; open the window") if library.calls[-1][0].name == "knee" else None

    library.in_the_middle = fail_on_knee
    three.ui.applyButton.click()
    assert names_of_results() == ["hand coloured", "head coloured"]
    assert "knee: too dark; open the window" in three.ui.statusLabel.text


def test_cancelled_between_volumes_keeps_what_is_done(three, library):
    mark(three, "knee")

    def cancel_second():
        if len(library.calls) == 2:
            three.job.cancel()

    library.in_the_middle = cancel_second
    three.ui.applyButton.click()
    assert names_of_results() == ["head coloured"]
    text = three.ui.statusLabel.text
    assert "Cancelled" in text and "Coloured before that: head coloured" in text


@pytest.mark.parametrize("done", [True, False])
def test_after_cancel_the_text_says_what_was_and_what_was_not_coloured(three, library, done):
    mark(three, "knee")
    mark(three, "hand")
    fails = 2 if done else 1

    def spoil():
        library.error = InputError("too dark; open the window") if len(library.calls) == fails else None
        if len(library.calls) == fails + 1:
            three.job.cancel()

    library.in_the_middle = spoil
    three.ui.applyButton.click()
    text = three.ui.statusLabel.text
    assert names_of_results() == (["head coloured"] if done else [])
    assert text.startswith("Cancelled")
    assert ("the scene is as it was" in text) is not done
    assert ("Coloured before that: head coloured." in text) is done
    assert ("knee" if done else "head") + ": too dark; open the window" in text


def test_failed_runs_do_not_speak_of_groups(three, library, monkeypatch):
    from MedColorSlicer import panel_run

    monkeypatch.setattr(panel_run, "grouped_by_name", lambda _node: True)
    mark(three, "knee")
    library.error = InputError("too dark; open the window")
    three.ui.applyButton.click()
    assert "too dark" in three.ui.statusLabel.text
    assert "grouped" not in three.ui.statusLabel.text
    library.error = None
    three.ui.applyButton.click()
    assert "grouped" in three.ui.statusLabel.text


def test_module_left_between_volumes(three, library):
    import qt

    mark(three, "knee")
    library.pause_seconds = 0.1
    qt.QTimer.singleShot(30, three.exit)
    three.ui.applyButton.click()
    assert names_of_results() == ["head coloured", "knee coloured"]
    assert three.ui.statusLabel.text.startswith("Done")


def test_a_marked_volume_that_goes_is_said_or_forgotten(three, library):
    import qt

    library.pause_seconds = 0.1
    mark(three, "knee")
    mark(three, "hand")
    knee = slicer.util.getNode("knee")
    qt.QTimer.singleShot(30, lambda: slicer.mrmlScene.RemoveNode(knee))
    three.ui.applyButton.click()
    assert names_of_results() == ["hand coloured", "head coloured"]
    assert "knee: The volume has been removed" in three.ui.statusLabel.text
    ui_settled()
    assert [node.GetName() for node in three.volumes.marked()] == ["hand"]
    slicer.util.getNode("hand").SetName("foot")
    ui_settled()
    assert item_of(three, "foot") is not None


# --- all time points -------------------------------------------------------------------------------------------------


@pytest.fixture
def beat(ready):
    """The panel with a volume that a sequence browser plays; (panel, sequence, browser)."""
    logic = slicer.vtkSlicerSequencesLogic()
    logic.SetMRMLScene(slicer.mrmlScene)
    slicer.modules.sequences = type("Sequences", (), {"logic": staticmethod(lambda: logic)})
    sequence = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceNode", "beat")
    for n in range(3):
        node = grey_node(f"phase {n}")
        sequence.SetDataNodeAtValue(node, str(100 * n))
        slicer.mrmlScene.RemoveNode(node)
    browser = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", "player")
    browser.SetAndObserveMasterSequenceNodeID(sequence.GetID())
    logic.UpdateProxyNodesFromSequences(browser)
    ready.parameters.inputVolume = browser.GetProxyNode(sequence)
    yield ready, sequence, browser
    ready.exit()
    del slicer.modules.sequences
    slicer.mrmlScene.Clear(0)
    logic.SetMRMLScene(None)


def test_all_time_points_from_the_panel(beat, library):
    import qt

    panel, _sequence, browser = beat
    assert shown(panel.ui.allTimePointsCheckBox)
    panel.ui.allTimePointsCheckBox.click()
    library.pause_seconds = 0.1
    qt.QTimer.singleShot(30, lambda: browser.SetSelectedItemNumber(2))  # played meanwhile
    panel.ui.applyButton.click()
    assert len(library.calls) == 3
    (colored,) = [n for n in slicer.util.getNodesByClass("vtkMRMLSequenceNode") if n.GetName() == "beat coloured"]
    assert colored.GetNumberOfDataNodes() == 3
    player = panel.parameters.outputVolume
    assert player is browser.GetProxyNode(colored)
    assert "beat coloured" in panel.ui.statusLabel.text
    assert panel.ui.show3DCheckBox.checked
    panel.ui.allTimePointsCheckBox.click()
    panel.ui.applyButton.click()
    assert len(library.calls) == 4
    assert panel.parameters.outputVolume is not player, "one time point does not spoil the player of all"


def test_the_body_does_not_flicker_while_colours_are_played(beat, library):
    """The luminance range differs between time points, and with it VTK's alpha axis."""
    from MedColorSlicer import rendering

    panel, _sequence, browser = beat
    panel.ui.allTimePointsCheckBox.click()
    panel.ui.applyButton.click()
    player = panel.parameters.outputVolume
    display = rendering.display_node_of(player)
    colored = browser.GetSequenceNode(player)
    brighter = slicer.vtkMRMLVectorVolumeNode.SafeDownCast(colored.GetNthDataNode(1))
    slicer.util.updateVolumeFromArray(brighter, np.minimum(slicer.util.arrayFromVolume(brighter) + 100, 255))
    axes = []
    for n in (0, 1, 0):
        browser.SetSelectedItemNumber(n)
        slicer.modules.sequences.logic().UpdateProxyNodesFromSequences(browser)
        assert rendering._stored_axis(display) == rendering._measured(player)
        axes.append(rendering._stored_axis(display)["range"])
    assert axes[0] == axes[2] != axes[1]


def test_plan_counts_volumes_and_time_points(beat, library):
    panel, _sequence, _browser = beat
    panel.ui.allTimePointsCheckBox.click()
    assert panel.volumes.count() == 3
    mark(panel, "head")
    assert panel.volumes.count() == 4


def test_one_time_point_alone(beat, library):
    panel, _sequence, _browser = beat
    panel.ui.applyButton.click()
    assert len(library.calls) == 1
    panel.parameters.inputVolume = grey_node("plain")
    assert not shown(panel.ui.allTimePointsCheckBox)
    panel.parameters.allTimePoints = True
    panel.ui.applyButton.click()
    assert len(library.calls) == 2, "a volume that is in no sequence"


# --- kept with the scene ---------------------------------------------------------------------------------------------


def test_new_choices_are_kept_with_the_scene(three, tmp_path):
    p = three.parameters
    p.exposure, p.exposureGain, p.body, p.groupLabels, p.allTimePoints = "gain", 3.0, "node", True, True
    p.bodyNode, p.referenceMaskNode = label_node(name="torso"), label_node(mask_voxels(), "drawn")
    p.referenceMaskPath, p.lightness = "/pictures/mask.png", 0.25
    mark(three, "knee")
    path = str(tmp_path / "scene.mrb")
    assert slicer.mrmlScene.WriteToMRB(path)
    slicer.mrmlScene.Clear(0)
    ui_settled()
    assert slicer.mrmlScene.ReadFromMRB(path)
    ui_settled()
    p = three.parameters
    assert (p.exposure, p.exposureGain, p.body, p.groupLabels, p.allTimePoints) == ("gain", 3.0, "node", True, True)
    assert (p.bodyNode.GetName(), p.referenceMaskNode.GetName()) == ("torso", "drawn")
    assert (p.referenceMaskPath, p.lightness) == ("/pictures/mask.png", 0.25)
    assert three.ui.bodySelector.currentNode() is p.bodyNode
    assert three.ui.exposureGainSlider.value == 3.0
    import qt

    assert item_of(three, "knee").checkState() == qt.Qt.Checked
    assert item_of(three, "hand").checkState() == qt.Qt.Unchecked
