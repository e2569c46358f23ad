"""Is a wrong reference noticed? Every volume at hand after every photograph, and after pictures of something else.

    wrong_references(colorize, data, settings) -> list[Case]; rates(cases) -> (share of wrong noticed, of right warned of)

A case counts as noticed where the report has warnings under `WARNINGS_KEY`, or where the picture is refused with an error.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..color.gamut import lab_to_srgb_in_gamut
from ..errors import MedColorError
from ..parameters import Settings
from ..scan.slices import slice_order
from .pairs import SECTIONS
from .seen import load

WARNINGS_KEY = "reference_warnings"  # of the report: a list of sentences, empty where nothing is wrong
VOLUMES = {
    "vhf_head_ct.nrrd": "head",
    "mr_head_t1_dicom": "head",
    "head_mr_t1_3d.nii.gz": "head",
    "head_mr_t2.nii.gz": "head",
    "brain_mr_flair_stripped.nii.gz": "head",
    "brain_mr_gd_dicom": "head",
    "brain_pd_dicom": "head",
    "chest_ct.nrrd": "thorax",
    "heart_mr.nrrd": "thorax",
}
_SLICES = 10
_MIDDLE = {"vhf_head_ct.nrrd": 122}  # elsewhere the middle of the stack


@dataclass(frozen=True)
class Case:
    """One volume after one picture.

    Attributes:
        right: whether the picture shows the same part of the body. noticed: warned of, or refused. said: what was said.
    """

    volume: str
    picture: str
    right: bool
    noticed: bool
    said: str


def wrong_references(
    colorize, data: Path, settings: Settings | None = None, volumes: Iterable[str] | None = None
) -> list[Case]:
    """Colour ten slices in the middle of every volume after every picture."""
    pictures: dict[str, object] = {name: str(data / file) for name, file in SECTIONS.items()}
    pictures.update(foreign_pictures())
    cases = []
    for name in volumes or [name for name in VOLUMES if (data / name).exists()]:
        volume = load(str(data / name))
        count = slice_order(volume.ijk_to_ras).view(volume.array).shape[0]
        middle = _MIDDLE.get(name, count // 2)
        stack = (max(0, middle - _SLICES // 2), min(count, middle + _SLICES // 2))
        for picture, reference in pictures.items():
            said = _said(colorize, volume, reference, replace(settings or Settings(), slices=stack))
            cases.append(Case(name, picture, picture == VOLUMES.get(name), bool(said), said))
    return cases


def _said(colorize, volume, reference, settings: Settings) -> str:
    try:
        report = colorize(volume, [reference], settings).report
    except MedColorError as error:
        return f"refused: {error}"
    return "; ".join(map(str, report.get(WARNINGS_KEY) or ()))


def rates(cases: list[Case]) -> tuple[float, float]:
    """Share of the wrong pictures that were noticed, and of the right ones that were warned of."""
    wrong, right = ([case.noticed for case in cases if case.right is kind] for kind in (False, True))
    return float(np.mean(wrong)) if wrong else float("nan"), float(np.mean(right)) if right else float("nan")


def foreign_pictures(size: int = 256, seed: int = 0) -> dict[str, np.ndarray]:
    """Pictures (size, size, 3) uint8 of no part of a body, each an object on a plain background: name -> picture."""
    from scipy import ndimage

    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[:size, :size] / (size - 1) * 2 - 1
    radius, angle = np.hypot(rows, cols), np.arctan2(rows, cols)
    disc = radius < 0.85 + 0.04 * np.cos(3 * angle)

    def clouds(width: float) -> np.ndarray:
        field = ndimage.gaussian_filter(rng.normal(size=(size, size)), width * size)
        return field / field.std()

    rings = np.sin(40 * (radius + 0.01 * clouds(0.05)))
    wood = np.stack([55 + 12 * rings + 2 * clouds(0.01), 10 + 3 * rings, 28 + 5 * clouds(0.03)], -1)
    labels = rng.uniform(-1, 1, (40, 2))
    owner = np.argmin((rows[..., None] - labels[:, 0]) ** 2 + (cols[..., None] - labels[:, 1]) ** 2, -1)
    hue, light = rng.uniform(-40, 60, (40, 2)), rng.uniform(20, 85, 40)
    mosaic = np.dstack([light[owner], hue[owner] + 10])
    crumb = np.stack([60 + 12 * clouds(0.006), 14 + 4 * clouds(0.05), 35 + 6 * clouds(0.02)], -1)
    paper = np.array([92.0, 0.0, 0.0])
    found = {"wood": wood, "mosaic": mosaic, "bread": crumb}
    return {name: lab_to_srgb_in_gamut(np.where(disc[..., None], lab, paper))[0] for name, lab in found.items()}
