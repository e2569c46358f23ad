"""The body that a run takes: found, all of it, or the user's mask; what is said of it in plan, log and report."""

from __future__ import annotations

import json
import logging
from dataclasses import replace

import numpy as np
import pytest

from MedColorLib import Settings, Volume, colorize, make_plan
from MedColorLib.cli.main import main
from MedColorLib.errors import InputError, SettingsError


def write_volume(volume: Volume, path) -> None:
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(volume.array)
    to_lps = np.diag([-1.0, -1.0, 1.0])
    image.SetSpacing(volume.spacing_mm.tolist())
    image.SetDirection((to_lps @ volume.ijk_to_ras[:3, :3] / volume.spacing_mm).ravel().tolist())
    image.SetOrigin((to_lps @ volume.ijk_to_ras[:3, 3]).tolist())
    sitk.WriteImage(image, str(path))


DRAFT = Settings(preset="draft", features="embedded", device="cpu", slices=(4, 6))


@pytest.fixture
def mask(ct) -> np.ndarray:
    labels = np.zeros(ct.volume.array.shape, np.uint8)
    labels[:, 20:40, 15:45] = 2
    return labels


def test_all_of_the_picture(ct):
    plan = make_plan(ct.volume, [ct.reference], replace(DRAFT, body="all"))
    assert "all of the picture" in plan.steps["body"]
    result = colorize(ct.volume, [ct.reference], replace(DRAFT, body="all", window=(-1100, 1000)))
    assert result.rgb[4, 0, 0].any()  # air, shown dark grey by this window, is coloured, too


@pytest.mark.parametrize("kind", ["array", "bool", "float", "volume"])
def test_a_mask_in_memory_is_the_body(ct, mask, kind):
    given = {
        "array": mask,
        "bool": mask > 0,
        "float": mask.astype(np.float32),
        "volume": Volume(mask, ct.volume.ijk_to_ras, name="liver"),
    }[kind]
    result = colorize(ct.volume, [ct.reference], replace(DRAFT, body=given))
    colored = result.rgb[4:6].any(axis=-1)
    assert not colored[mask[4:6] == 0].any() and colored[(mask[4:6] > 0) & (ct.volume.array[4:6] > 0)].mean() > 0.95
    assert result.report["body"]["how"].startswith("mask ")
    assert "SHA-256" in result.report["settings"]["body"]
    json.dumps(result.report)


def test_a_mask_from_a_file(ct, mask, tmp_path, capsys):
    scan, labels, out, report = (tmp_path / name for name in ("a.nrrd", "patient doe.nrrd", "o.nrrd", "r.json"))
    write_volume(ct.volume, scan)
    write_volume(Volume(mask, ct.volume.ijk_to_ras), labels)
    reference = tmp_path / "r.png"
    import cv2

    cv2.imwrite(str(reference), ct.reference[..., ::-1])
    command = [
        "colorize",
        str(scan),
        "-r",
        str(reference),
        "--preset",
        "draft",
        "--slices",
        "4:6",
        "--features",
        "embedded",
    ]
    assert main([*command, "-o", str(out), "--report", str(report), "--body", str(labels)]) == 0
    told = json.loads(report.read_text())
    assert told["settings"]["body"] == labels.name and told["body"]["left_out_fraction"] is None
    assert main([*command, "--plan", "--body", "nothing.nrrd"]) == 2
    assert "neither auto nor all nor a file" in capsys.readouterr().err
    moved = np.array(ct.volume.ijk_to_ras)
    moved[0, 3] += 5
    write_volume(Volume(mask, moved), labels)
    assert main([*command, "--plan", "--body", str(labels)]) == 2
    assert "resample the labels" in capsys.readouterr().err


def test_masks_that_do_not_fit_are_refused(ct, mask):
    for given, message in (
        (mask[1:], "resample the labels"),
        (np.zeros_like(mask), "0 everywhere"),
        (mask * 0.3, "no labels"),
    ):
        with pytest.raises(InputError, match=message):
            make_plan(ct.volume, [ct.reference], replace(DRAFT, body=given))
    for given in (mask[0], 3, None, "", np.array(["a"] * 8).reshape(2, 2, 2)):
        with pytest.raises(SettingsError, match="body"):
            replace(DRAFT, body=given)


def test_the_scan_is_no_mask_of_itself(ct):
    scan = replace(ct.volume, array=ct.volume.array - ct.volume.array.min())
    with pytest.raises(SettingsError, match="is the scan itself; give a label volume"):
        make_plan(scan, [ct.reference], replace(DRAFT, body=scan))


def test_a_batch_takes_no_mask(ct, mask, tmp_path):
    from MedColorLib.cohort.batch import Found, make_tasks

    with pytest.raises(SettingsError, match="one volume"):
        make_tasks(Found({}, {}), [ct.reference], tmp_path, replace(DRAFT, body=mask), 0)


def test_what_is_left_out_is_said_everywhere(ct, caplog):
    values = ct.volume.array.copy()
    values[:, -4:-2, 2:-2] = 200  # a table
    volume = Volume(values, ct.volume.ijk_to_ras)
    text = "left out of the body: "
    plan = make_plan(volume, [ct.reference], DRAFT)
    assert text in plan.steps["body"] and any(text in warning for warning in plan.warnings)
    assert f"Warning: {text}" in plan.text()
    with caplog.at_level(logging.WARNING):
        report = colorize(volume, [ct.reference], DRAFT).report
    assert any(text in message and "--body all" in message for message in caplog.messages)
    assert report["body"]["left_out_fraction"] > 0.02 and report["body"]["left_out_of_slices"]
    assert text in report["body"]["warning"] and text in report["plan"]["warnings"][0]
    clean = make_plan(ct.volume, [ct.reference], DRAFT)
    assert clean.warnings == () and f"{text}0.0 %" in clean.steps["body"]


def test_settings_round_trip():
    for body in ("auto", "all", "a/b.nrrd"):
        assert Settings.from_dict(Settings(body=body).to_dict()).body == body
