"""MedColorLogic without any view: results, re-runs, cancel and errors leave the scene as it was."""

from __future__ import annotations

import logging
import sys
import threading

import numpy as np
import pytest
import slicer
from host_fixtures import color_node, grey_node, label_node, node_ids

from MedColorLib.errors import Cancelled, InputError, MedColorError, SettingsError

REFERENCE = np.full((4, 5, 3), (180, 90, 40), np.uint8)


@pytest.fixture
def logic(scene):
    from MedColorSlicer.logic import MedColorLogic

    return MedColorLogic()


def test_no_qt_is_needed(logic):
    assert "qt" not in sys.modules
    assert "ctk" not in sys.modules


def test_result_and_what_the_library_was_given(logic, library):
    grey = grey_node()
    steps = []
    result = logic.process(grey, [REFERENCE], preset="draft", seed=3, progress=lambda *step: steps.append(step))
    (volume, references, settings), *_ = library.calls
    assert volume.array.shape == (6, 8, 10)
    np.testing.assert_array_equal(references[0], REFERENCE)
    assert (settings.preset, settings.seed) == ("draft", 3)
    assert [fraction for fraction, _text in steps] == [0, 0.25, 0.5, 0.75]
    np.testing.assert_array_equal(slicer.util.arrayFromVolume(result)[0, 0, 0], (150, 100, 50))
    assert result.GetAttribute("MedColor.Report").count("stand-in") == 1


@pytest.mark.parametrize("kind", ["path", "folder", "node", "array", "list"])
def test_kinds_of_references(logic, library, tmp_path, kind):
    (tmp_path / "a.png").write_bytes(b"")
    path = str(tmp_path / "a.png")
    node = color_node(REFERENCE[None])
    given = {"path": path, "folder": str(tmp_path), "node": node, "array": REFERENCE, "list": [path, node]}[kind]
    logic.process(grey_node(), given)
    got = library.calls[0][1]
    assert [r if isinstance(r, str) else r.shape for r in got] == {
        "path": [path], "folder": [str(tmp_path)], "node": [(4, 5, 3)], "array": [(4, 5, 3)], "list": [path, (4, 5, 3)],
    }[kind]  # fmt: skip


def test_a_mask_is_a_node_or_a_file(logic, library):
    """An array ended in an AttributeError."""
    with pytest.raises(InputError, match="a volume or segmentation node, or a picture file"):
        logic.process(grey_node(), [color_node(REFERENCE[None])], referenceMasks=[REFERENCE[..., 0]])
    assert not library.calls


def test_mask_of_an_array_is_no_node_and_what_is_advised_works(logic, library, tmp_path):
    from PIL import Image

    from MedColorLib.references.loading import load_references

    picture = np.random.default_rng(0).integers(0, 256, (16, 16, 3), np.uint8)
    tissue = np.zeros((16, 16), np.uint8)
    tissue[2:14, 3:12] = 255
    with pytest.raises(InputError, match="fourth channel or a picture file"):
        logic.process(grey_node(), [picture], referenceMasks=[label_node((tissue[None] > 0).astype(np.uint8))])
    assert not library.calls
    path = tmp_path / "mask.png"
    Image.fromarray(tissue).save(path)
    logic.process(grey_node(), [picture], referenceMasks=[str(path)])
    logic.process(grey_node(), [np.dstack([picture, tissue])])
    for _volume, given, settings in library.calls:
        (reference,) = load_references(given, masks=settings.reference_masks)
        assert reference.mask.sum() == 12 * 9


def test_rerun_updates_the_same_node_and_keeps_the_user_rendering(logic, library):
    grey = grey_node()
    first = logic.process(grey, [REFERENCE])
    display = logic.showVolumeRendering(first, opacity=0.6)
    prop = display.GetVolumePropertyNode().GetVolumeProperty()
    prop.ShadeOff()
    prop.SetAmbient(0.55)
    first.SetName("my name")
    before = node_ids(slicer.mrmlScene)
    again = logic.process(grey, [REFERENCE], first)
    assert again is first
    assert node_ids(slicer.mrmlScene) == before
    assert first.GetName() == "my name"
    assert display.GetVolumePropertyNode().GetVolumeProperty() is prop
    assert not prop.GetShade()
    assert prop.GetAmbient() == pytest.approx(0.55)
    assert display.GetAttribute("MedColor.Opacity") == "0.6"


@pytest.mark.parametrize("error", [Cancelled(), MedColorError("no"), ValueError("bug"), MemoryError()])
@pytest.mark.parametrize("again", [False, True])
def test_error_or_cancel_leaves_the_scene_as_it_was(logic, library, error, again):
    grey = grey_node()
    output = logic.process(grey, [REFERENCE]) if again else None
    before, when = node_ids(slicer.mrmlScene), output.GetImageData().GetMTime() if output else None
    library.error = error
    with pytest.raises(type(error)):
        logic.process(grey, [REFERENCE], output)
    assert node_ids(slicer.mrmlScene) == before
    assert output is None or output.GetImageData().GetMTime() == when


def test_cancelled_is_asked(logic, library):
    answers = iter([False, True])
    with pytest.raises(Cancelled):
        logic.process(grey_node(), [REFERENCE], cancelled=lambda: next(answers))


def remove(node):
    slicer.mrmlScene.RemoveNode(node)


def shrink(node):
    slicer.util.updateVolumeFromArray(node, np.ones((2, 2, 2), np.int16))


@pytest.mark.parametrize("what", [remove, shrink, lambda _node: slicer.mrmlScene.Clear(0)])
def test_input_removed_or_changed_while_running(logic, library, what):
    grey = grey_node()
    library.in_the_middle = lambda: what(grey)
    with pytest.raises(InputError, match="while it was being coloured"):
        logic.process(grey, [REFERENCE])
    assert not slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")


def test_output_removed_while_running(logic, library):
    grey = grey_node()
    output = logic.process(grey, [REFERENCE])
    library.in_the_middle = lambda: slicer.mrmlScene.RemoveNode(output)
    with pytest.raises(InputError, match="removed"):
        logic.process(grey, [REFERENCE], output)
    assert not slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")


def test_bad_output(logic, library):
    grey = grey_node()
    for output in (grey, grey_node("other")):
        with pytest.raises(InputError, match="cannot take colours"):
            logic.process(grey, [REFERENCE], output)
    assert not library.calls


def test_unknown_setting_is_named(logic, library):
    with pytest.raises(SettingsError, match="sharpness"):
        logic.process(grey_node(), [REFERENCE], sharpness=1)


@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_region_of_interest(logic, library, flip):
    grey = grey_node(shape=(20, 20, 20), matrix=np.diag([1.0, 1.0, flip, 1.0]))
    roi = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLMarkupsROINode")
    roi.SetXYZ(10, 10, 4 * flip)
    roi.SetRadiusXYZ(3, 3, 2)
    voxels = slicer.util.arrayFromVolume(logic.process(grey, [REFERENCE], roi=roi))
    assert library.calls[0][2].region == ((2, 7), (7, 14), (7, 14))
    colored = np.argwhere(voxels.any(axis=-1))
    np.testing.assert_array_equal([colored.min(axis=0), colored.max(axis=0)], [[2, 7, 7], [6, 13, 13]])
    with pytest.raises(InputError, match="none of the chosen slices"):
        logic.process(grey, [REFERENCE], roi=roi, slices=(8, 10))
    logic.process(grey, [REFERENCE], roi=roi, slices=(6, 7) if flip > 0 else (13, 14))  # counted from the feet up


def test_preview_is_one_slice_at_its_place_and_not_saved(logic, library):
    matrix = np.diag([-1.0, -1.0, 2.5, 1.0])
    grey = grey_node(shape=(6, 8, 10), matrix=matrix)
    node = logic.preview(grey, [REFERENCE], 4)
    settings = library.calls[0][2]
    assert settings.slices == (4, 5)
    assert settings.preset == "draft"
    assert slicer.util.arrayFromVolume(node).shape == (3, 8, 10, 3), "its faces, too"
    assert node.GetOrigin()[2] == pytest.approx(10.0 - 2.5)
    assert not node.GetSaveWithScene()
    assert logic.preview(grey, [REFERENCE], 2, previous=node) is node
    assert node.GetOrigin()[2] == pytest.approx(5.0 - 2.5)


@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_preview_outside_the_region_is_said(logic, library, flip):
    grey = grey_node(shape=(20, 20, 20), matrix=np.diag([1.0, 1.0, flip, 1.0]))
    roi = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLMarkupsROINode")
    roi.SetName("knee box")
    roi.SetXYZ(10, 10, 4 * flip)
    roi.SetRadiusXYZ(3, 3, 2)
    inside = range(2, 7) if flip > 0 else range(13, 18)  # counted from the feet up
    for index in (inside[0] - 1, inside[-1] + 1):
        with pytest.raises(InputError, match=f"red view shows slice {index}, outside the region knee box; scroll"):
            logic.preview(grey, [REFERENCE], index, roi=roi)
    assert not library.calls
    for index in (inside[0], inside[-1]):
        logic.preview(grey, [REFERENCE], index, roi=roi)
    with pytest.raises(InputError, match="Select a volume"):
        logic.preview(None, [REFERENCE], 3, roi=roi)


def test_only_rgb_volumes_are_shown(logic):
    for node in (None, grey_node(), color_node(np.zeros((2, 2, 2, 3), np.uint16))):
        with pytest.raises(InputError, match="RGB"):
            logic.showVolumeRendering(node)


def test_recommendation_finds_the_section_of_the_same_phantom(logic, tmp_path, monkeypatch):
    pytest.importorskip("torch", reason="the library needs torch to compare pictures")
    import cv2

    from MedColorLib.phantom import sample

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    volume, picture = sample()
    grey = slicer.util.addVolumeFromArray(volume.array, np.asarray(volume.ijk_to_ras), "phantom")
    library = tmp_path / "library"
    library.mkdir()
    cv2.imwrite(str(library / "section.png"), picture[..., ::-1])
    stripes = np.zeros_like(picture)
    stripes[40:220, 40:200] = np.where((np.arange(160) // 9 % 2)[None, :, None], (200, 150, 120), (120, 50, 40))
    cv2.imwrite(str(library / "stripes.png"), stripes[..., ::-1])
    found = logic.recommend(grey, str(library), features="embedded")
    assert [path.rpartition("/")[2] for path, _score in found] == ["section.png", "stripes.png"]
    assert found[0][1] > found[1][1]


def test_plan_is_readable(logic):
    pytest.importorskip("torch", reason="the library needs torch to tell the device")
    from MedColorLib.phantom import sample

    volume, picture = sample()
    grey = slicer.util.addVolumeFromArray(volume.array, np.asarray(volume.ijk_to_ras), "phantom")
    plan = logic.plan(grey, color_node(picture[None]))
    assert "Left out" in plan.text()
    assert plan.to_dict()["slices"]


def test_console_example_of_the_documentation_runs(logic, tmp_path):
    """The whole way with the real library, on the phantom it makes itself."""
    pytest.importorskip("torch", reason="the library needs torch to colour")
    from MedColorLib.phantom import sample

    volume, picture = sample()
    grey = slicer.util.addVolumeFromArray(volume.array, np.asarray(volume.ijk_to_ras), "phantom")
    result = logic.process(grey, picture, preset="draft", features="embedded", slices=(4, 6))
    voxels = slicer.util.arrayFromVolume(result)
    assert voxels.shape == (*volume.array.shape, 3)
    assert voxels.max() > 60
    assert (voxels.max(axis=-1).astype(int) - voxels.min(axis=-1)).max() > 20, "there is colour in it"
    assert logic.showVolumeRendering(result).GetVisibility()


# --- the worker thread ------------------------------------------------------------------------------------------------


def test_worker_returns_what_the_function_returns_and_keeps_the_window_alive():
    from MedColorSlicer import running

    turns, done = [], threading.Event()

    def keep_alive():
        turns.append(threading.current_thread())
        if len(turns) == 5:
            done.set()

    def work():
        assert done.wait(10)
        return threading.current_thread()

    worker = running.run_responsive(work, keep_alive, poll_seconds=0.001)
    assert worker is not threading.current_thread()
    assert set(turns) == {threading.current_thread()}


def test_worker_raises_what_the_function_raises():
    from MedColorSlicer import running

    def work():
        raise MedColorError("from the worker")

    with pytest.raises(MedColorError, match="from the worker"):
        running.run_responsive(work, lambda: None)


def test_log_of_the_worker_arrives_in_the_calling_thread():
    from MedColorSlicer import running

    threads = []

    class Handler(logging.Handler):
        def emit(self, record):
            threads.append((record.getMessage(), threading.current_thread()))

    logger, handler = logging.getLogger("MedColorLib"), Handler()
    logger.addHandler(handler)
    try:
        running.run_responsive(lambda: logger.warning("hello"), lambda: None)
    finally:
        logger.removeHandler(handler)
    assert threads == [("hello", threading.current_thread())]
    assert not logger.filters


def test_time_left_is_said_only_when_it_is_known(monkeypatch):
    from MedColorSlicer import running

    now = [100.0]
    monkeypatch.setattr(running.time, "monotonic", lambda: now[0])
    job = running.Job()
    assert job.state() == (0.0, "", None)
    now[0] = 110.0
    job.progress(0.25, "slice 3")
    assert job.state() == (0.25, "slice 3", 30.0)
    job.progress(7, "")
    assert job.state()[0] == 1.0
    assert [running.readable_seconds(s) for s in (0.2, 45, 150, 4800)] == ["1 s", "45 s", "2 min", "1 h 20 min"]


def test_guard_leaves_other_volumes_alone(logic, host):
    result = color_node(np.full((4, 4, 4, 3), 90, np.uint8))
    logic.showVolumeRendering(result)
    display = host.rendering_logic.CreateDefaultVolumeRenderingNodes(grey_node())
    preset = host.rendering_logic.GetPresetByName("CT-Bones")
    display.GetVolumePropertyNode().CopyContent(preset)
    assert display.GetVolumePropertyNode().GetScalarOpacity().GetRange() == preset.GetScalarOpacity().GetRange()
