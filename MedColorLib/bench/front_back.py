"""Hue follows tissue, not place: colours of the front and of the back of one brain where they are equally light.

    front_back(colorize, data, "mr_head_t1_dicom", settings) -> FrontBack

Frontal and occipital lobes are drawn by hand on slices through the upper brain. `same_lightness`: for every step of one L*
of the result that both hold, CIEDE2000 between the mean a*, b* of both, weighed by the smaller number of voxels.
`same_grey`: the same for every step of one L* of the scan as it is shown, the result's L* compared, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..color.difference import ciede2000
from ..color.lab import srgb_to_lab
from ..parameters import Settings
from .detail import display_lightness
from .drawn_regions import drawn
from .pairs import SECTIONS
from .seen import load

TARGET = 2.5
_FEWEST = 30  # voxels of a step on either side

# volume -> slices of the transverse stack, and shapes (column, row) of the frontal and the occipital lobes
LOBES: dict[str, tuple[tuple[int, int], tuple, tuple]] = {
    "mr_head_t1_dicom": (
        (26, 36),
        (
            ((175, 95), (215, 75), (250, 80), (250, 145), (215, 145), (165, 145)),
            ((280, 80), (310, 72), (345, 90), (360, 145), (310, 145), (280, 145)),
        ),
        (
            ((165, 385), (230, 375), (255, 385), (250, 425), (200, 425)),
            ((280, 385), (330, 375), (375, 385), (345, 425), (280, 425)),
        ),
    ),
    "head_mr_t1_3d.nii.gz": (
        (72, 90),
        (((52, 36), (75, 32), (75, 60), (45, 60)), ((85, 32), (108, 36), (116, 60), (85, 60))),
        (((45, 165), (77, 165), (77, 190), (55, 187)), ((85, 165), (118, 165), (108, 187), (85, 190))),
    ),
}


@dataclass(frozen=True)
class FrontBack:
    """CIEDE2000 between front and back; see the module."""

    same_lightness: float
    same_grey: float


def front_back(colorize, data: Path, name: str, settings: Settings | None = None) -> FrontBack:
    """One of LOBES, coloured after the photograph of the head."""
    stack, front, back = LOBES[name]
    volume = load(str(data / name))
    references, settings = [str(data / SECTIONS["head"])], replace(settings or Settings(), slices=stack)
    scan, _, order = display_lightness(volume, references, settings)
    rgb = order.view(colorize(volume, references, settings).rgb)[slice(*stack)]
    return front_back_of(rgb, scan[slice(*stack)], front, back)


def front_back_of(rgb: np.ndarray, scan: np.ndarray, front: tuple, back: tuple) -> FrontBack:
    """The same of a result: rgb (n, rows, cols, 3) uint8, L* of the scan (n, rows, cols), shapes of both lobes."""
    lab = srgb_to_lab(rgb.astype(np.float64) / 255)
    masks = [np.broadcast_to(drawn(scan.shape[1:], shapes), scan.shape) & (rgb.max(-1) > 0) for shapes in (front, back)]
    colors, greys = [lab[mask] for mask in masks], [scan[mask] for mask in masks]
    return FrontBack(apart(*colors, *(lab[:, 0] for lab in colors)), apart(*colors, *greys))


def apart(first: np.ndarray, second: np.ndarray, first_key: np.ndarray, second_key: np.ndarray) -> float:
    """Mean CIEDE2000 between two sets of L*a*b* (n, 3) and (m, 3) where their keys (n), (m), rounded, agree; NaN if never."""
    total = weight = 0.0
    steps = np.intersect1d(np.rint(first_key), np.rint(second_key))
    for step in steps:
        ours, theirs = first[np.rint(first_key) == step], second[np.rint(second_key) == step]
        fewer = min(len(ours), len(theirs))
        if fewer >= _FEWEST:
            total += fewer * float(ciede2000(ours.mean(0), theirs.mean(0)))
            weight += fewer
    return total / weight if weight else float("nan")
