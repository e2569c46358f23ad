"""The recipes of `Resources/Documentation/developers.md`, followed: what they add works."""

from __future__ import annotations

import re
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from MedColorLib import Settings, colorize, filters, parameters, read_volume

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "Resources" / "Documentation" / "developers.md"
BLOCKS = dict(re.findall(r"```python\n# (\w+)\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S))


def names_of(recipe: str, monkeypatch) -> dict:
    """What the block of a recipe defines; it is a module, since dataclasses look for theirs."""
    module = types.ModuleType(f"recipe_{recipe}")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(BLOCKS[recipe], str(PAGE), "exec"), module.__dict__)
    return module.__dict__


def colored(ct, **settings):
    return colorize(ct.volume, [ct.reference], Settings(slices=(5, 7), device="cpu", **settings))


def test_there_are_recipes():
    assert set(BLOCKS) == {"reader", "smoother", "features", "preset"}


def test_reader(tmp_path, monkeypatch):
    from MedColorLib.io import files

    read = names_of("reader", monkeypatch)["read_numpy"]
    monkeypatch.setitem(files._READERS, ".npy", read)
    array = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    np.save(tmp_path / "scan.npy", array)
    volume = read_volume(tmp_path / "scan.npy")
    np.testing.assert_array_equal(volume.array, array)
    assert volume.name == "scan" and "1 mm" in volume.notes[0]


@pytest.mark.usefixtures("small_raster")
def test_smoother(ct, monkeypatch):
    names = names_of("smoother", monkeypatch)
    monkeypatch.setitem(filters.FILTERS, "box", names["smooth"])
    monkeypatch.setitem(filters.PARAMETERS, "box", names["BoxParameters"])
    monkeypatch.setattr(parameters, "SMOOTHERS", (*parameters.SMOOTHERS, "box"))
    result = colored(ct, smoother="box", smoother_options={"side": 9})
    assert result.rgb[5:7].any() and "box" in str(result.report["plan"])
    assert (result.rgb != colored(ct, smoother="box", smoother_options={"side": 1}).rgb).any()


@pytest.mark.usefixtures("small_raster")
def test_features(ct, monkeypatch):
    from MedColorLib import features
    from MedColorLib.matching import confidence
    from MedColorLib.run import prepare

    blocks, choose, make = (
        names_of("features", monkeypatch)["Blocks"],
        features.choose_features,
        features.make_extractor,
    )
    monkeypatch.setattr(parameters, "FEATURES", (*parameters.FEATURES, "blocks"))
    monkeypatch.setattr(features, "EXTRACTORS", (*features.EXTRACTORS, "blocks"))
    monkeypatch.setattr(features, "make_extractor", lambda name, *a: blocks() if name == "blocks" else make(name, *a))
    monkeypatch.setattr(prepare, "choose_features", lambda name, *a: name if name == "blocks" else choose(name, *a))
    monkeypatch.setitem(features.CONTEXT_WEIGHTS, "blocks", (0.5, 0.5))
    monkeypatch.setitem(prepare.NETWORKS, "blocks", "blocks of grey")
    monkeypatch.setitem(confidence.LIKENESS_RANGE, "blocks", (0.1, 0.3))
    result = colored(ct, features="blocks")
    assert result.rgb[5:7].any() and "blocks of grey" in result.report["plan"]["steps"]["features"]


def test_preset(ct, monkeypatch):
    preset = names_of("preset", monkeypatch)["PREVIEW"]
    monkeypatch.setitem(parameters.PRESETS, "preview", replace(preset, grid_px=64))
    result = colored(ct, preset="preview")
    assert result.rgb[5:7].any() and result.report["settings"]["preset"] == "preview"
