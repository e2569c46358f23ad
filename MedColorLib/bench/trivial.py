"""The trivial methods as `colorize(volume, references, settings)`, to stand beside the pipeline in every measure.

`look_up_table`: the scan's grey, histogram matched inside the body, reads the reference's mean L*, a*, b* at that L*.
`histogram_match`: red, green and blue by themselves take the reference's histogram inside its tissue.
`keep`, `paper`: the pipeline with that luminance; `at_reference` with its slider at the reference's end.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..color.gamut import lab_to_srgb_in_gamut
from ..color.lab import gray_to_lightness, lightness_to_gray, srgb_to_lab
from ..parameters import Settings
from ..scan.intensity import histogram_match_curve
from ..volume import ColorVolume, Volume

REFERENCE_END = "slider at the reference's"
SLIDER = "lightness"  # the slider's name in Settings; the method is listed where Settings has it
_LEVELS = 256


def keep(volume: Volume, references: list, settings: Settings) -> ColorVolume:
    """The pipeline with the scan's own luminance."""
    from ..pipeline import colorize

    return colorize(volume, references, replace(settings, luminance="keep"))


def paper(volume: Volume, references: list, settings: Settings) -> ColorVolume:
    """The pipeline with the paper's luminance."""
    from ..pipeline import colorize

    return colorize(volume, references, replace(settings, luminance="paper"))


def at_reference(volume: Volume, references: list, settings: Settings) -> ColorVolume:
    """The pipeline with the slider of the luminance at the reference's end."""
    from ..pipeline import colorize

    return colorize(volume, references, replace(settings, luminance="natural", **{SLIDER: 1.0}))


def look_up_table(volume: Volume, references: list, settings: Settings) -> ColorVolume:
    """See the module."""
    return _by_curve(volume, references, settings, _looked_up)


def histogram_match(volume: Volume, references: list, settings: Settings) -> ColorVolume:
    """See the module."""
    return _by_curve(volume, references, settings, _matched_channels)


def _looked_up(grey: np.ndarray, tissue: np.ndarray) -> np.ndarray:
    lab = srgb_to_lab(tissue.astype(np.float64) / 255)
    curve = histogram_match_curve(grey, lightness_to_gray(lab[:, 0]), _LEVELS)
    level = np.clip(np.rint(lab[:, 0]), 0, 100).astype(np.int64)
    counts = np.bincount(level, minlength=101)
    known = np.flatnonzero(counts)
    means = np.stack([np.bincount(level, lab[:, c], minlength=101)[known] / counts[known] for c in range(3)], -1)
    wanted = gray_to_lightness(curve.astype(np.float64))
    return lab_to_srgb_in_gamut(np.stack([np.interp(wanted, known, means[:, c]) for c in range(3)], -1))[0]


def _matched_channels(grey: np.ndarray, tissue: np.ndarray) -> np.ndarray:
    curves = [histogram_match_curve(grey, tissue[:, c] / 255.0, _LEVELS) for c in range(3)]
    return np.rint(np.clip(np.stack(curves, -1), 0, 1) * 255).astype(np.uint8)


def _by_curve(volume: Volume, references: list, settings: Settings, make: Callable) -> ColorVolume:
    """Every grey has one colour: `make(grey (n,) 0..1 in the body, tissue (m, 3) uint8)` gives (256, 3) uint8."""
    from ..run.prepare import prepare
    from ..scan.intensity import apply_window

    start = time.perf_counter()
    prepared = prepare(volume, references, settings)
    seconds = {"prepare": time.perf_counter() - start, "network": 0.0}
    reference = prepared.references[0]
    chosen = list(prepared.plan.slices)
    bodies = {k: prepared.body.plane(k) > 0.5 for k in chosen}
    greys = {k: apply_window(np.asarray(prepared.view[k]), prepared.window) for k in chosen}
    table = make(np.concatenate([greys[k][bodies[k]] for k in chosen]), reference.rgb[reference.mask])
    rgb = np.zeros((*volume.array.shape, 3), np.uint8)
    seen = prepared.order.view(rgb)
    for k in chosen:
        level = np.rint(np.clip(greys[k][bodies[k]], 0, 1) * (_LEVELS - 1)).astype(np.int64)
        seen[k][bodies[k]] = table[level]
    seconds["total"] = time.perf_counter() - start
    return ColorVolume(rgb, volume.ijk_to_ras, {"seconds": seconds})


METHODS: dict[str, Callable[[Volume, list, Settings], ColorVolume]] = {
    "look-up table": look_up_table,
    "histogram match": histogram_match,
    "keep": keep,
    "paper": paper,
    **({REFERENCE_END: at_reference} if SLIDER in Settings.__dataclass_fields__ else {}),
}
WITHOUT_FEATURES = ("look-up table", "histogram match")


def features_of(method: str, settings: Settings) -> str:
    """What a table calls the features of a method: "" for those that have none."""
    return "" if method in WITHOUT_FEATURES else settings.features
