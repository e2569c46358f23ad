"""One slice more or less must not change a slab's colours: slabs of the chest CT, and the same without two slices at each end.

slab_ends(colorize, data, settings) -> SlabEnds; slabs=(...) for fewer
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..color.difference import ciede2000
from ..color.lab import srgb_to_lab
from ..parameters import Settings
from .pairs import SECTIONS
from .seen import CHEST_FILE, cut, load

TARGET = 1.0
MOVED_BY = 2
SLABS = ((20, 50), (28, 50), (26, 60), (40, 72))  # contrast is learned in some of them and not in others


@dataclass(frozen=True)
class SlabEnds:
    """CIEDE2000 between a slab and the same with moved ends: mean over its body in a slice; mean and worst of the slices.

    Attributes:
        slabs: (first, stop) -> mean and worst of that slab.
    """

    mean: float
    worst: float
    slabs: dict[tuple[int, int], tuple[float, float]]


def slab_ends(colorize, data: Path, settings: Settings | None = None, slabs: tuple = SLABS) -> SlabEnds:
    """Colour every slab of the chest CT twice, the second time without `MOVED_BY` slices at both ends."""
    volume, references = load(str(data / CHEST_FILE)), [str(data / SECTIONS["thorax"])]
    found = {}
    for first, stop in slabs:
        whole = colorize(cut(volume, first, stop), references, settings or Settings())
        inner = colorize(cut(volume, first + MOVED_BY, stop - MOVED_BY), references, settings or Settings())
        found[first, stop] = changes(whole.rgb[MOVED_BY : MOVED_BY + len(inner.rgb)], inner.rgb)
    values = np.concatenate(list(found.values()))
    slabs = {slab: (float(change.mean()), float(change.max())) for slab, change in found.items()}
    return SlabEnds(float(values.mean()), float(values.max()), slabs)


def changes(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(n,) mean CIEDE2000 of each slice of two (n, rows, cols, 3) uint8, where either has colour; 0 where neither has."""
    means = []
    for before, after in zip(first, second):
        where = (before.max(-1) > 0) | (after.max(-1) > 0)
        labs = [srgb_to_lab(rgb[where].astype(np.float64) / 255) for rgb in (before, after)]
        means.append(float(ciede2000(*labs).mean()) if where.any() else 0.0)
    return np.array(means)
