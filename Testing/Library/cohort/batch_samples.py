"""What the tests of batch share: samples and small helpers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from MedColorLib import Settings, colorize, read_color_volume
from MedColorLib.parameters import PRESETS

DRAFT = Settings(preset="draft", features="embedded", device="cpu")


GOOD = ("a.nrrd", "b/c.nrrd", "b/d.nrrd", "e.nrrd")


OPTIONS = ("-r", "section.png", "--preset", "draft", "--features", "embedded", "--device", "cpu")


def states(result) -> dict[str, str]:
    return {outcome.volume: outcome.state for outcome in result.outcomes}


def expected_states(state: str) -> dict[str, str]:
    return {**dict.fromkeys(GOOD, state), "broken.nrrd": "failed"}


_PLAIN: dict[tuple, np.ndarray] = {}


def plain_run(path: Path, settings: Settings) -> np.ndarray:
    """Voxels (k, j, i, 3) of a run by itself in this process, made once for the same bytes and settings."""
    from MedColorLib import read_volume

    key = (path.read_bytes(), Path("section.png").read_bytes(), repr(settings), repr(PRESETS[settings.preset]))
    if key not in _PLAIN:
        _PLAIN[key] = colorize(read_volume(path), ["section.png"], settings).rgb
    return _PLAIN[key]


def assert_whole(results: Path, settings: Settings = DRAFT) -> None:
    """Every good volume has exactly the voxels of a run by itself, and nothing else lies there."""
    names = {path.relative_to(results).as_posix() for path in results.rglob("*") if path.is_file()}
    stems = [name.removesuffix(".nrrd") for name in GOOD]
    whole = {"batch.json", *(f"{stem}-colored.{kind}" for stem in stems for kind in ("nrrd", "json"))}
    assert names == whole, f"missing {sorted(whole - names)}, more {sorted(names - whole)}"
    for name, stem in zip(GOOD, stems):
        plain = plain_run(Path("in", name), settings)
        np.testing.assert_array_equal(read_color_volume(results / f"{stem}-colored.nrrd").rgb, plain)


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
