"""The panel's live preview, with the library itself: it follows slices and sliders, and leaves the views as they were."""

from __future__ import annotations

import numpy as np
import pytest
import slicer
import vtk
from host_fixtures import color_node, grey_node, label_node, node_ids
from panel_fixtures import turned, ui_settled, wait_for

pytest.importorskip("torch", reason="the library needs torch")

# Normal and direction to the right of the views, RAS, as Slicer has them.
ORIENTATIONS = {
    "Red": ((0, 0, 1), (-1, 0, 0)),
    "Yellow": ((1, 0, 0), (0, -1, 0)),
    "Green": ((0, 1, 0), (-1, 0, 0)),
}


@pytest.fixture
def views(ready, small_raster):
    """{name: (slice node, composite)} of the three slice views, through the middle of a small phantom that is chosen."""
    from MedColorLib.phantom import sample

    volume, picture = sample()
    every = np.s_[::2, ::2, ::2]
    matrix = volume.ijk_to_ras @ np.diag([2.0, 2.0, 2.0, 1.0])
    grey = slicer.util.addVolumeFromArray(np.ascontiguousarray(volume.array[every]), matrix, "phantom")
    ready.parameters.referenceNode = color_node(picture[None], "section")
    ready.parameters.inputVolume = grey
    bounds = [0.0] * 6
    grey.GetRASBounds(bounds)
    found = {}
    middle = [(bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)]
    for name, (normal, right) in ORIENTATIONS.items():
        view, composite = slicer.vtkMRMLSliceNode(), slicer.vtkMRMLSliceCompositeNode()
        for node in (view, composite):
            node.SetName(name)
            node.SetLayoutName(name)
            node.SetSingletonTag(name)
            slicer.mrmlScene.AddNode(node)
        view.SetSliceToRASByNTP(*normal, *right, *middle, 0)
        found[name] = (view, composite)
    yield found
    ready.exit()
    for pair in found.values():
        for node in pair:
            slicer.mrmlScene.RemoveNode(node)


@pytest.fixture
def sessions(monkeypatch):
    """How many times the volume was looked at as a whole, and every slice that was asked for."""
    from MedColorLib.run import live

    class Counted(live.LiveSlices):
        made, planes = [], []

        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            self.made.append(self)

        def plane(self, axis, index, look=None):
            self.planes.append((axis, index, look))
            return super().plane(axis, index, look)

    Counted.made.clear()
    Counted.planes.clear()
    monkeypatch.setattr(live, "LiveSlices", Counted)
    return Counted


def settled(panel):
    """What is asked for is shown."""
    ui_settled()
    wait_for(lambda: panel.live.idle)
    ui_settled()


def picture(views, name):
    """(k, j, i, 3) voxels of what lies in front in a view."""
    node = slicer.mrmlScene.GetNodeByID(views[name][1].GetForegroundVolumeID())
    return slicer.util.arrayFromVolume(node).copy()


def test_follows_slices_and_sliders_with_one_look_at_the_volume(ready, views, sessions):
    ready.ui.followCheckBox.click()
    settled(ready)
    shapes = {name: picture(views, name).shape for name in views}
    assert shapes == {"Red": (3, 64, 56, 3), "Yellow": (24, 64, 3, 3), "Green": (24, 3, 56, 3)}
    assert len(sessions.planes) == 3
    for name in views:
        voxels = picture(views, name)
        assert np.ptp(voxels.astype(int), axis=-1).max() > 30, "in colour"
    red = picture(views, "Red")
    assert (red[0] == red[1]).all() and (red[2] == red[1]).all()
    views["Red"][0].SetSliceOffset(views["Red"][0].GetSliceOffset() + 12)
    settled(ready)
    assert len(sessions.planes) == 4, "the other two views did not change"
    assert (picture(views, "Red") != red).any()
    before = {name: picture(views, name) for name in views}
    ready.ui.lightnessSlider.value = 0.2
    settled(ready)
    assert all((picture(views, name) != before[name]).any() for name in views)
    ready.ui.exposureComboBox.currentIndex = 2
    ready.ui.exposureGainSlider.value = 0.4
    settled(ready)
    assert sessions.planes[-1][2].exposure == 0.4
    assert len(sessions.made) == 1
    ready.ui.fadeSlider.value = 0.3
    assert views["Green"][1].GetForegroundOpacity() == pytest.approx(0.3)


def test_picture_lies_where_the_slice_is(ready, views):
    ready.ui.followCheckBox.click()
    settled(ready)
    for name, (view, composite) in views.items():
        bounds = [0.0] * 6
        slicer.mrmlScene.GetNodeByID(composite.GetForegroundVolumeID()).GetRASBounds(bounds)
        axis = int(np.argmin(np.subtract(bounds[1::2], bounds[::2])))
        assert axis == {"Red": 2, "Yellow": 0, "Green": 1}[name]
        at = view.GetSliceToRAS().GetElement(axis, 3)
        middle = (bounds[2 * axis] + bounds[2 * axis + 1]) / 2
        assert abs(at - middle) <= (bounds[2 * axis + 1] - bounds[2 * axis]) / 6 + 1e-6, "within its middle voxel"


def end_by_hand(panel):
    panel.ui.followCheckBox.click()


@pytest.mark.parametrize("end", [end_by_hand, lambda panel: panel.exit(), lambda panel: panel.ui.previewButton.click()])
def test_leaves_the_views_as_they_were(ready, views, end):
    other = color_node(np.zeros((2, 2, 2, 3), np.uint8), "other")
    views["Red"][1].SetForegroundVolumeID(other.GetID())
    views["Red"][1].SetForegroundOpacity(0.25)
    beneath = grey_node("beneath")
    views["Red"][1].SetBackgroundVolumeID(beneath.GetID())
    before = node_ids(slicer.mrmlScene)
    ready.ui.followCheckBox.click()
    settled(ready)
    assert len(node_ids(slicer.mrmlScene)) > len(before)
    end(ready)
    assert not ready.ui.followCheckBox.checked
    assert not [name for name in node_ids(slicer.mrmlScene) if "live" in slicer.mrmlScene.GetNodeByID(name).GetName()]
    if end is end_by_hand:
        assert views["Red"][1].GetForegroundVolumeID() == other.GetID()
        assert views["Red"][1].GetForegroundOpacity() == 0.25
        assert views["Red"][1].GetBackgroundVolumeID() == beneath.GetID()
        assert node_ids(slicer.mrmlScene) == before


def test_apply_ends_it_and_shows_the_result(ready, views, library):
    ready.ui.followCheckBox.click()
    ready.ui.applyButton.click()
    assert not ready.ui.followCheckBox.checked
    assert views["Red"][1].GetForegroundVolumeID() == ready.parameters.outputVolume.GetID()


def test_scene_closed_and_pictures_removed_by_hand(ready, views):
    ready.ui.followCheckBox.click()
    settled(ready)
    picture_node = slicer.mrmlScene.GetNodeByID(views["Red"][1].GetForegroundVolumeID())
    slicer.mrmlScene.RemoveNode(picture_node)
    settled(ready)
    assert picture(views, "Red").any(), "made again"
    views["Green"][0].SetSliceOffset(views["Green"][0].GetSliceOffset() + 6)
    slicer.mrmlScene.Clear(0)
    ui_settled()
    assert not ready.ui.followCheckBox.checked
    assert not ready.ui.followCheckBox.enabled


def test_another_volume_is_looked_at_anew_and_what_is_missing_is_said(ready, views, sessions):
    ready.ui.followCheckBox.click()
    settled(ready)
    grey = ready.parameters.inputVolume
    slicer.util.updateVolumeFromArray(grey, slicer.util.arrayFromVolume(grey)[:, :, ::-1].copy())
    settled(ready)
    assert len(sessions.made) == 2
    ready.parameters.referenceNode = None
    settled(ready)
    assert "Select a colour volume" in ready.ui.statusLabel.text
    assert ready.ui.followCheckBox.enabled, "to unmark it"


def test_choices_that_it_does_not_use_change_nothing(ready, views, sessions):
    p = ready.parameters
    ready.ui.followCheckBox.click()
    settled(ready)
    p.features, p.preset, p.confidence = "embedded", "full", True
    settled(ready)
    p.firstSlice, p.lastSlice, p.allSlices = 0, 1, False
    settled(ready)
    assert len(sessions.made) == 1
    assert len(sessions.planes) == 3
    ready.ui.roiSelector.addNode()
    p.roi.SetSize(*(2 * [500.0]), 12.0)  # meets none of those slices
    settled(ready)
    assert len(sessions.made) == 2
    assert not ready.ui.statusLabel.text


def test_errors_and_limits_are_said(ready, views):
    ready.parameters.referenceNode = color_node(np.full((1, 64, 64, 3), 90, np.uint8), "grey picture")
    ready.ui.followCheckBox.click()
    settled(ready)
    assert "no colour" in ready.ui.statusLabel.text
    ready.ui.followCheckBox.click()
    assert "no colour" not in ready.ui.statusLabel.text


def test_tissue_labels_are_kept_apart(ready, views, sessions):
    """The upper half of the head is another tissue by the labels: it can take no colour from below."""
    grey = ready.parameters.inputVolume
    ready.ui.followCheckBox.click()
    settled(ready)
    before = {name: picture(views, name) for name in views}
    voxels = np.zeros(slicer.util.arrayFromVolume(grey).shape, np.uint8)
    voxels[12:] = 1
    voxels[:, 20:40] += 2
    labels = label_node(voxels)
    matrix = vtk.vtkMatrix4x4()
    grey.GetIJKToRASMatrix(matrix)
    labels.SetIJKToRASMatrix(matrix)
    ready.ui.labelsSelector.setCurrentNode(labels)
    settled(ready)
    assert [session._prepared.groups is not None for session in sessions.made] == [False, True]
    assert all((picture(views, name) != before[name]).any() for name in views)
    assert not ready.ui.statusLabel.text
    ready.parameters.lightness = 0.5
    settled(ready)
    assert len(sessions.made) == 2
    voxels = slicer.util.arrayFromVolume(labels)
    voxels[voxels == 1] = 0
    slicer.util.arrayFromVolumeModified(labels)
    ready.ui.lightnessSlider.value = 0.6
    settled(ready)
    assert len(sessions.made) == 3, "the labels were painted on"


def test_tilted_views_are_said(ready, views):
    ready.parameters.inputVolume.SetAndObserveTransformNodeID(turned(slicer.mrmlScene, 30).GetID())
    ready.ui.followCheckBox.click()
    settled(ready)
    text = ready.ui.statusLabel.text
    assert "Tilted against the volume, without live preview: Red, Green" in text


def test_missing_packages_are_said(ready, views, monkeypatch):
    from MedColorSlicer import dependencies

    monkeypatch.setattr(dependencies, "missing", lambda: ["scipy"])
    ready.ui.followCheckBox.click()
    assert not ready.ui.followCheckBox.checked
    assert "Python packages are missing" in ready.ui.statusLabel.text


def test_self_test_of_the_live_preview_passes_here_too(ready, views):
    """Slicer's own views in place of these."""
    import MedColor

    MedColor.MedColorTest("test_panel_live_preview_follows_the_slices").debug()
