"""The panel, clicked, over real MRML: runs, progress, cancel, errors, scene close, packages, display."""

from __future__ import annotations

import time
import types

import pytest
import slicer
from host_fixtures import color_node, grey_node, label_node, layout_of, node_ids, two_colors, view_widget
from panel_fixtures import shown

# --- running ---------------------------------------------------------------------------------------------------------


def test_apply_colors_and_shows(ready, library):
    composite = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSliceCompositeNode")
    ready.parameters.preset = "draft"
    ready.parameters.seed = 5
    ready.ui.applyButton.click()
    result = ready.parameters.outputVolume
    assert result.GetName() == "head coloured"
    assert (library.calls[0][2].preset, library.calls[0][2].seed) == ("draft", 5)
    assert "Done" in ready.ui.statusLabel.text
    assert ready.ui.applyButton.text == "Apply"
    assert not shown(ready.ui.progressBar)
    assert composite.GetForegroundVolumeID() == result.GetID()
    ready.ui.applyButton.click()
    assert ready.parameters.outputVolume is result
    assert len(library.calls) == 2


def test_confidence_only_where_it_is_asked_for(ready, library):
    from MedColorSlicer import scene

    ready.ui.applyButton.click()
    result = ready.parameters.outputVolume
    assert result.GetNodeReference(scene.CONFIDENCE_ROLE) is None
    ready.ui.confidenceCheckBox.click()
    ready.ui.applyButton.click()
    assert library.calls[-1][2].confidence
    volume = result.GetNodeReference(scene.CONFIDENCE_ROLE)
    assert volume.GetName() == "head coloured confidence"
    assert ready.parameters.inputVolume is not volume
    ready.ui.previewButton.click()
    assert not library.calls[-1][2].confidence


def test_while_running_apply_is_cancel_and_the_window_lives(ready, library):
    import qt

    seen = []
    ticks = []
    timer = qt.QTimer()
    timer.setInterval(5)
    timer.timeout.connect(lambda: ticks.append(ready.ui.progressBar.value))
    timer.timeout.connect(
        lambda: seen.append((ready.ui.applyButton.text, shown(ready.ui.progressBar), ready.ui.previewButton.enabled))
    )
    library.pause_seconds = 0.15
    timer.start()
    ready.ui.applyButton.click()
    timer.stop()
    assert seen
    assert set(seen[2:-2]) == {("Cancel", True, False)}
    assert ticks == sorted(ticks)
    assert max(ticks) >= 500


def click_soon(button, delay_ms=60):
    import qt

    qt.QTimer.singleShot(delay_ms, button.click)


def test_cancel_in_the_middle(ready, library):
    library.pause_seconds = 0.2
    before = node_ids(slicer.mrmlScene)
    click_soon(ready.ui.applyButton)
    ready.ui.applyButton.click()
    assert "Cancelled" in ready.ui.statusLabel.text
    assert node_ids(slicer.mrmlScene) == before
    assert ready.ui.applyButton.enabled
    assert ready.parameters.outputVolume is None


@pytest.mark.parametrize("kind", ["MedColorError", "ValueError", "MemoryError"])
def test_error_in_the_middle(ready, library, kind):
    from MedColorLib import errors

    library.error = {
        "MedColorError": errors.MedColorError("the disk is full; make room"),
        "ValueError": ValueError("odd"),
        "MemoryError": MemoryError(),
    }[kind]
    before = node_ids(slicer.mrmlScene)
    ready.ui.applyButton.click()
    words = {"MedColorError": "make room", "ValueError": "error log", "MemoryError": "Not enough memory"}[kind]
    assert words in ready.ui.statusLabel.text
    assert node_ids(slicer.mrmlScene) == before
    assert ready.ui.applyButton.text == "Apply"
    assert ready.ui.applyButton.enabled
    library.error = None
    ready.ui.applyButton.click()
    assert "Done" in ready.ui.statusLabel.text


def run_while(ready, library, action, delay_ms=80):
    import qt

    library.pause_seconds = 0.2
    qt.QTimer.singleShot(delay_ms, action)
    ready.ui.applyButton.click()


def test_scene_closed_while_running(ready, library):
    run_while(ready, library, lambda: slicer.mrmlScene.Clear(0))
    assert not slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")
    assert ready.ui.statusLabel.text
    assert not ready.ui.applyButton.enabled
    assert "Select a volume" in ready.ui.applyButton.toolTip


def test_input_removed_while_running(ready, library):
    grey = ready.parameters.inputVolume
    run_while(ready, library, lambda: slicer.mrmlScene.RemoveNode(grey))
    assert len(slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")) == 1, "only the reference"
    assert ready.ui.statusLabel.text


def test_left_while_running(ready, library):
    run_while(ready, library, ready.exit)
    assert [n for n in slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode") if n.GetName() == "head coloured"]
    ready.enter()
    assert ready.ui.applyButton.enabled


def test_panel_closed_while_running(ready, library):
    run_while(ready, library, ready.cleanup)
    assert len(slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")) == 1, "only the reference"


def test_a_plan_that_is_being_made_ends_before_the_panel(ready, monkeypatch):
    import MedColorLib

    ended = []

    def slow(*_arguments, **_options):
        time.sleep(0.3)
        ended.append(True)
        return types.SimpleNamespace(text=lambda: "", slices=())

    monkeypatch.setattr(MedColorLib, "make_plan", slow)
    ready.plan.ask()
    assert not ended
    ready.cleanup()
    assert ended


def test_slicer_closed_while_running(ready, library):
    """The window is gone; Slicer quits once the run has ended."""
    library.steps = 100
    run_while(ready, library, lambda: slicer.app.emit("lastWindowClosed()"))
    assert "Cancelled" in ready.ui.statusLabel.text
    ready.cleanup()
    assert ready._onLastWindowClosed not in slicer.app.connected["lastWindowClosed()"]


def test_no_second_run_at_once(ready, library):
    run_while(ready, library, ready.ui.previewButton.click)
    assert len(library.calls) == 1


# --- packages --------------------------------------------------------------------------------------------------------


def test_missing_packages_are_a_message(ready, monkeypatch, library):
    from MedColorSlicer import dependencies

    def decline():
        raise dependencies.NotInstalled("Nothing was installed.")

    monkeypatch.setattr(dependencies, "ensure", decline)
    before = node_ids(slicer.mrmlScene)
    ready.ui.applyButton.click()
    assert ready.ui.statusLabel.text == "Nothing was installed."
    assert node_ids(slicer.mrmlScene) == before
    assert not library.calls


def test_weights_state_and_download(ready, monkeypatch, tmp_path):
    from MedColorLib.features import weights

    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(weights, "cache_folder", lambda: tmp_path)
    ready.parameters.features = "embedded"
    assert not ready.ui.downloadButton.enabled
    assert ready.ui.weightsStateLabel.text == "Not needed"
    ready.parameters.features = "vgg19"
    assert ready.ui.weightsStateLabel.text == "Not on this computer"
    assert ready.ui.downloadButton.enabled
    asked, fetched = [], []
    monkeypatch.setattr(slicer.util, "confirmOkCancelDisplay", lambda text: asked.append(text) or len(asked) > 1)
    monkeypatch.setattr(weights, "fetch_weights", lambda name, progress, cancelled: fetched.append(name))
    ready.ui.downloadButton.click()
    assert not fetched
    assert "575 MB" in asked[0]
    ready.ui.downloadButton.click()
    assert fetched == ["vgg19"]
    assert "on this computer" in ready.ui.statusLabel.text


# --- preview, recommendation, display --------------------------------------------------------------------------------


def test_preview_is_shown_over_the_slices_and_removed_by_apply(ready, library):
    composite = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSliceCompositeNode")
    before = node_ids(slicer.mrmlScene)
    ready.ui.previewButton.click()
    (node,) = [n for n in slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode") if "preview" in n.GetName()]
    assert library.calls[0][2].slices == (3, 4)
    assert composite.GetForegroundVolumeID() == node.GetID()
    assert composite.GetForegroundOpacity() == 1.0
    assert "slice 3" in ready.ui.statusLabel.text
    ready.ui.previewButton.click()
    assert len([n for n in slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode") if "preview" in n.GetName()]) == 1
    ready.exit()
    assert node_ids(slicer.mrmlScene) == before


def test_preview_follows_the_red_slice(ready, library):
    view = slicer.vtkMRMLSliceNode()
    view.SetName("Red")
    view.SetLayoutName("Red")
    view.SetSingletonTag("Red")
    slicer.mrmlScene.AddNode(view)
    assert view.GetID() == "vtkMRMLSliceNodeRed"
    view.SetOrientationToAxial()
    view.SetSliceOffset(1.2)
    ready.ui.previewButton.click()
    assert library.calls[0][2].slices == (1, 2)


def test_recommended_pictures_are_shown_and_picked(ready, library, monkeypatch, tmp_path):
    from PySide6.QtGui import QColor, QPixmap

    paths = []
    for name in ("a.png", "b.png", "c.png", "d.png"):
        paths.append(str(tmp_path / name))
        pixmap = QPixmap(20, 20)
        pixmap.fill(QColor("red"))
        pixmap.save(paths[-1])
    ready.parameters.referenceSource = "recommended"
    assert not ready.ui.recommendButton.enabled
    ready.parameters.referencePath = str(tmp_path)
    assert ready.ui.recommendButton.enabled
    scores = [(paths[2], 0.91), (paths[0], 0.5), (paths[3], 0.125)]
    monkeypatch.setattr(type(ready.logic), "recommend", lambda *_arguments, **_options: scores)
    ready.ui.recommendButton.click()
    items = ready.ui.recommendedList
    assert [items.item(n).text() for n in range(items.count)] == ["0.91  c.png", "0.50  a.png", "0.12  d.png"]
    assert not items.item(0).icon().isNull()
    assert not ready.ui.applyButton.enabled
    items.setCurrentRow(1)
    assert ready.parameters.pickedReference == paths[0]
    assert ready.ui.applyButton.enabled
    ready.ui.applyButton.click()
    assert library.calls[0][1] == [paths[0]]


def test_display_controls(ready):
    from MedColorSlicer import rendering

    ui = ready.ui
    assert ui.show3DCheckBox.checked, "what Apply will do"
    assert not ui.compareCheckBox.enabled
    assert "first" in ui.compareCheckBox.toolTip
    result = color_node(two_colors(16, 6), "result")
    ready.parameters.outputVolume = result
    assert not ui.show3DCheckBox.checked
    assert rendering.display_node_of(result) is None
    ui.show3DCheckBox.click()
    display = rendering.display_node_of(result)
    assert display.GetVisibility()
    ui.opacitySlider.value = 0.35
    assert rendering.opacity_of(result) == pytest.approx(0.35)
    display.GetVolumePropertyNode().GetVolumeProperty().SetAmbient(0.01)
    ui.resetRenderingButton.click()
    assert display.GetVolumePropertyNode().GetVolumeProperty().GetAmbient() > 0.1
    assert rendering.opacity_of(result) == pytest.approx(0.35)
    ui.show3DCheckBox.click()
    assert not display.GetVisibility()
    assert not ui.opacitySlider.enabled


@pytest.mark.parametrize(
    ("views", "words"),
    [((), "no 3-D view"), (({"visible": False},), "no 3-D view"), (({"visible": False}, {"name": "2"}), "")],
    ids=["none", "hidden by the layout", "one of two hidden"],
)
def test_a_missing_view_is_said(ready, monkeypatch, views, words):
    """The window is not asked about OpenGL: that of Slicer's views always says no, for nobody tells it."""
    monkeypatch.setattr(slicer.app, "layoutManager", layout_of(*(view_widget(**each) for each in views)))
    ready.parameters.outputVolume = color_node(two_colors(16, 6), "result")
    ready.ui.show3DCheckBox.click()
    assert words in ready.ui.statusLabel.text
    assert bool(ready.ui.statusLabel.text) is bool(words)
    assert ready.ui.show3DCheckBox.checked


def test_comparison_controls(ready):
    composite = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSliceCompositeNode")
    ready.parameters.outputVolume = color_node(two_colors(16, 6), "result")
    ready.ui.compareCheckBox.click()
    assert "not the one that was coloured" in ready.ui.statusLabel.text
    assert not ready.ui.compareCheckBox.checked
    ready.parameters.inputVolume = grey_node(shape=(16, 16, 16))
    ready.ui.compareCheckBox.click()
    assert composite.GetForegroundOpacity() == 1.0
    ready.ui.fadeSlider.value = 0.2
    assert composite.GetForegroundOpacity() == pytest.approx(0.2)
    ready.ui.compareCheckBox.click()
    assert not ready.ui.compareCheckBox.checked


def test_apply_and_preview_take_the_tissue_labels(ready, library):
    labels = label_node()
    ready.ui.labelsSelector.setCurrentNode(labels)
    ready.ui.applyButton.click()
    ready.ui.previewButton.click()
    assert [guard.present for guard in library.guards] == [(1, 2), (1, 2)]
    ready.ui.labelsSelector.setCurrentNode(slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "bare"))
    assert not ready.ui.applyButton.enabled
    assert "bare has no segments" in ready.ui.applyButton.toolTip


# --- the worker ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("there", "within"), [(4, 3), (2, 2)], ids=["all cores", "fewer, as set"])
def test_worker_leaves_a_core_to_the_window(ready, library, monkeypatch, there, within):
    """And gives torch and OpenCV their threads back: they belong to the whole of Slicer."""
    import cv2
    import torch
    from MedColorSlicer import running

    monkeypatch.setattr(running.os, "cpu_count", lambda: 4)
    before = torch.get_num_threads(), cv2.getNumThreads()
    seen = []
    library.in_the_middle = lambda: seen.append((torch.get_num_threads(), cv2.getNumThreads()))
    torch.set_num_threads(there)
    cv2.setNumThreads(there)
    try:
        ready.ui.applyButton.click()
        assert seen == [(within, within)]
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (there, there)
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


def test_workers_side_by_side_give_the_threads_back(monkeypatch, qt_host):
    """The second comes while the first computes, and stays longer: it must not take the reduced number for the usual one."""
    import threading

    import cv2
    import torch
    from MedColorSlicer import running

    monkeypatch.setattr(running.os, "cpu_count", lambda: 4)
    before = torch.get_num_threads(), cv2.getNumThreads()
    inside, leave, seen = [threading.Event() for _ in range(2)], [threading.Event() for _ in range(2)], []

    def work(n):
        with running.a_core_for_the_window():
            inside[n].set()
            leave[n].wait(30)
            seen.append((torch.get_num_threads(), cv2.getNumThreads()))

    def threads_of_a_new_worker():
        worker = threading.Thread(target=lambda: seen.append((torch.get_num_threads(), cv2.getNumThreads())))
        worker.start()
        worker.join()
        return seen.pop()

    torch.set_num_threads(4)
    cv2.setNumThreads(4)
    try:
        workers = [threading.Thread(target=work, args=(n,)) for n in range(2)]
        for n, worker in enumerate(workers):
            worker.start()
            assert inside[n].wait(30)
        for n, worker in enumerate(workers):
            leave[n].set()
            worker.join()
            assert threads_of_a_new_worker() == [(3, 3), (4, 4)][n]
        assert seen == [(3, 3), (3, 3)]
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])
