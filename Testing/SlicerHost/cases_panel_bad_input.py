"""Bad things through the panel, with the library itself: a sentence with a remedy, never a traceback, the scene as it was."""

from __future__ import annotations

import contextlib
import io
import logging

import numpy as np
import pytest
import slicer
from host_fixtures import color_node, grey_node, label_node, node_ids
from panel_fixtures import ui_settled

from MedColorLib.phantom import section

pytest.importorskip("torch", reason="the library needs torch")
PHOTOGRAPH = section()[None]


def file(folder, name, content=b"this is no picture"):
    path = folder / name
    path.write_bytes(content)
    return str(path)


def picture(folder, name, rgb):
    import cv2

    path = str(folder / name)
    cv2.imwrite(path, rgb[..., ::-1])
    return path


def from_path(make):
    def change(panel, folder):
        panel.parameters.referenceSource = "files"
        panel.parameters.referencePath = make(folder)

    return change


def volume(make):
    def change(panel, _folder):
        panel.parameters.inputVolume = slicer.util.addVolumeFromArray(make(), name="bad")

    return change


def chosen(**values):
    def change(panel, _folder):
        for name, value in values.items():
            setattr(panel.parameters, name, value() if callable(value) else value)

    return change


def broken_folder(folder):
    inner = folder / "photographs"
    inner.mkdir()
    for name in ("a.png", "b.jpg"):
        file(inner, name)
    return str(inner)


def empty_folder(folder):
    (folder / "empty").mkdir()
    return str(folder / "empty")


def flat(panel, _folder):
    """A volume that has no extent along one axis."""
    matrix = slicer.util.vtkMatrixFromArray(np.diag([1.0, 0.0, 1.0, 1.0]))
    panel.parameters.inputVolume.SetIJKToRASMatrix(matrix)


def mask_of_a_file(panel, folder):
    panel.parameters.referenceSource = "files"
    panel.parameters.referencePath = picture(folder, "photo.png", PHOTOGRAPH[0])
    panel.parameters.referenceMaskPath = picture(folder, "mask.png", PHOTOGRAPH[0, :9, :7])


def region(centre, size):
    def make():
        node = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLMarkupsROINode", "box")
        node.SetCenter(*centre)
        node.SetSize(*size)
        return node

    return make


def other_grid(name):
    return lambda: label_node(np.ones((3, 4, 5), np.uint8), name)


BAD = {
    "text for a picture": (from_path(lambda folder: file(folder, "photo.png")), "photo"),
    "nothing for a picture": (from_path(lambda folder: file(folder, "photo.png", b"")), "photo"),
    "folder without pictures": (from_path(empty_folder), "holds no picture"),
    "folder of broken pictures": (from_path(broken_folder), "none of its 2 pictures"),
    "grey photograph": (
        from_path(lambda folder: picture(folder, "grey.png", np.full((40, 40, 3), 99, np.uint8))),
        "no colour",
    ),
    "path that no system takes": (from_path(lambda folder: "a\0b"), "no file or folder"),
    "missing values alone": (volume(lambda: np.full((4, 30, 30), np.nan, np.float32)), "bad"),
    "one value alone": (volume(lambda: np.full((4, 30, 30), 7, np.int16)), ""),
    "infinite values": (volume(lambda: np.full((4, 30, 30), np.inf, np.float64)), "bad"),
    "one voxel": (volume(lambda: np.ones((1, 1, 1), np.int16)), ""),
    "no extent along an axis": (flat, "extent"),
    "labels of another grid": (chosen(labels=other_grid("organs")), "organs"),
    "body of another grid": (chosen(body="node", bodyNode=other_grid("torso")), "torso"),
    "body that is nowhere": (
        chosen(body="node", bodyNode=lambda: label_node(np.zeros((6, 40, 40), np.uint8), "torso")),
        "torso",
    ),
    "mask of another size": (mask_of_a_file, "7 x 9 pixels"),
    "region outside": (chosen(roi=region((500, 0, 0), (5, 5, 5))), "outside the volume"),
    "region without size": (chosen(roi=region((5, 5, 3), (0, 0, 0))), "box has no size"),
    "device that is not there": (chosen(device="mps"), "not here"),
    "weights that are not there": (chosen(features="gray-vgg19"), "weights"),
    "value of a smoother that it does not take": (
        chosen(smootherAutomatic=False, smootherOptions='{"regression": {"cell_px": -4}}'),
        "cell_px",
    ),
    "values of a smoother that are none": (chosen(smootherAutomatic=False, smootherOptions="[1, {"), ""),
    "unknown value of a smoother": (
        chosen(smootherAutomatic=False, smootherOptions='{"regression": {"speed": 9}}'),
        "speed",
    ),
}


@pytest.fixture
def usable(ready, monkeypatch, tmp_path):
    """The panel with a small volume and a photograph, and the library's own colouring."""
    import MedColorLib
    from MedColorLib import pipeline

    monkeypatch.setattr(MedColorLib, "colorize", pipeline.colorize)
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(tmp_path))
    monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: tmp_path)
    voxels = np.zeros((6, 40, 40), np.int16)
    voxels[:, 8:32, 6:34] = np.random.default_rng(2).integers(200, 900, (6, 24, 28))
    ready.parameters.inputVolume = slicer.util.addVolumeFromArray(voxels, name="small")
    ready.parameters.referenceNode = color_node(PHOTOGRAPH, "photograph")
    ready.parameters.preset = "draft"
    return ready


def said(panel):
    """What a person reads: why Apply is off, or else how it ended."""
    ui_settled()
    if not panel.ui.applyButton.enabled:
        return panel.ui.applyButton.toolTip
    panel.ui.applyButton.click()
    return panel.ui.statusLabel.text


@pytest.mark.parametrize("case", BAD)
def test_a_sentence_and_no_traceback(usable, tmp_path, case, caplog):
    change, words = BAD[case]
    change(usable, tmp_path)
    before = node_ids(slicer.mrmlScene)
    console = io.StringIO()
    with contextlib.redirect_stderr(console), contextlib.redirect_stdout(console), caplog.at_level(logging.WARNING):
        text = said(usable)
        usable.plan.ask()
        if usable.ui.previewButton.enabled:
            usable.ui.previewButton.click()
        usable.ui.followCheckBox.click()
        ui_settled()
        usable.live.stop()
    assert words in text
    assert text
    if words:
        assert "Done" not in text
        assert node_ids(slicer.mrmlScene) == before, "the scene is as it was"
    assert "Unexpected" not in text
    assert "Traceback" not in console.getvalue()
    assert not [record for record in caplog.records if record.exc_info], "nothing that nobody thought of"


def test_any_type_of_voxels(usable):
    for kind in (np.uint8, np.int8, np.uint16, np.int32, np.uint32, np.float32, np.float64):
        voxels = np.zeros((2, 40, 40), kind)
        voxels[:, 8:32, 6:34] = np.random.default_rng(2).integers(20, 90, (2, 24, 28))
        usable.parameters.inputVolume = slicer.util.addVolumeFromArray(voxels, name=f"of {np.dtype(kind).name}")
        assert said(usable).startswith("Done"), kind


def test_grey_volume_of_the_host_is_as_good_as_any(usable):
    usable.parameters.inputVolume = grey_node(shape=(6, 40, 40))
    assert "Unexpected" not in said(usable)
