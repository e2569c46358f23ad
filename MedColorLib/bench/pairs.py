"""Ground truth: a colour section, mirrored and warped, seen in grey as by another modality; the section is its reference.

Everything about such a pair is known: the colour of every target pixel and where in the reference it came from. What a
scanner does to contrast is imitated by curves from the section's grey to the target's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..color.lab import lightness_to_gray, srgb_to_lab
from ..references.photograph import Reference, prepare_reference
from ..references.pictures import read_picture
from ..scan.grid import choose_grid, continue_outwards, to_grid
from ..volume import Volume

SIZE_PX = 256
WARP_FRACTION = 0.03  # of the side: the largest shift of a control point
_AIR, _AIR_NOISE = -2.0, 0.05  # far below every tissue, as air is in CT: finding the body is not what is measured here
SECTIONS = {"thorax": "vhf_thorax_cryosection.png", "head": "vhf_head_cryosection.png"}

REMAPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as it is": lambda g: g,
    "mild": lambda g: g + 0.18 * np.sin(2 * np.pi * g),
    "strong": lambda g: g + 0.245 * np.sin(2 * np.pi * g),
    "extreme": lambda g: 0.5 - 0.5 * np.cos(2.4 * np.pi * g),
    "inverted": lambda g: 1 - g,
}


@dataclass(frozen=True)
class Section:
    """A colour section and the pixels that are tissue, on the raster of the benchmark.

    Attributes:
        name: "thorax", "head" or "phantom".
        rgb: (h, w, 3) uint8, the photograph as it came: the pipeline gets this.
        lab: (256, 256, 3) L*a*b*, its tissue's box on the raster; colours continue outside the tissue.
        mask: (256, 256) bool tissue.
    """

    name: str
    rgb: np.ndarray
    lab: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True)
class Pair:
    """A grey target and the truth about it.

    Attributes:
        section: the reference. remap: key of REMAPS.
        grey: (256, 256) 0..1, the target as it is shown. mask: (256, 256) bool body.
        truth: (256, 256, 3) true L*a*b*.
        source: (256, 256, 2) row and column in the section's raster from which each target pixel came.
    """

    section: Section
    remap: str
    grey: np.ndarray
    mask: np.ndarray
    truth: np.ndarray
    source: np.ndarray

    @property
    def volume(self) -> Volume:
        """The target as a volume of one slice; to be shown with the window 0..1."""
        air = np.random.default_rng(0).normal(_AIR, _AIR_NOISE, self.mask.shape)
        values = np.where(self.mask, self.grey, air).astype(np.float32)
        return Volume(values[None], np.diag([-1.0, -1.0, 1.0, 1.0]), name=f"{self.section.name}, {self.remap}")


def load_sections(folder: Path | None) -> list[Section]:
    """The photographs that `folder` holds, and the section made by formula; without a folder that one alone."""
    from ..phantom import section

    found = [] if folder is None else [(n, folder / file) for n, file in SECTIONS.items() if (folder / file).is_file()]
    pictures = [(name, read_picture(str(path))) for name, path in found] + [("phantom", section())]
    return [make_section(name, rgb) for name, rgb in pictures]


def make_section(name: str, rgb: np.ndarray) -> Section:
    """Cut a photograph to its tissue and bring it to the raster."""
    return Section(name, rgb, *on_raster(prepare_reference(rgb, name)))


def on_raster(reference: Reference) -> tuple[np.ndarray, np.ndarray]:
    """L*a*b* (256, 256, 3) and mask (256, 256) of a prepared reference on the raster."""
    grid = choose_grid(SIZE_PX)
    lab = continue_outwards(srgb_to_lab(reference.rgb.astype(np.float64) / 255), reference.mask)
    mask = to_grid(reference.mask, grid) > 0.5
    return continue_outwards(to_grid(lab, grid), mask).astype(np.float64), mask


def warp_field(seed: int = 0, mirror: bool = True, size: int = SIZE_PX) -> np.ndarray:
    """(size, size, 2) row and column to read from: mirrored left-right, and a smooth seeded shift.

    Bicubic between 4 x 4 control points of up to 3 % of the side either way.
    """
    import cv2

    control = np.random.default_rng(seed).uniform(-1, 1, (2, 4, 4)) * WARP_FRACTION * size
    shift = [cv2.resize(plane, (size, size), interpolation=cv2.INTER_CUBIC) for plane in control]
    rows, cols = np.mgrid[:size, :size].astype(np.float64)
    return np.stack([rows + shift[0], (size - 1 - cols if mirror else cols) + shift[1]], -1)


def make_pair(section: Section, remap: str, seed: int = 0, mirror: bool = True) -> Pair:
    """Mirror, warp and remap a section."""
    import cv2

    source = warp_field(seed, mirror)
    where = source[..., 1].astype(np.float32), source[..., 0].astype(np.float32)
    truth = cv2.remap(section.lab, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    mask = cv2.remap(section.mask.astype(np.float32), *where, cv2.INTER_LINEAR, borderValue=0) > 0.5
    grey = np.clip(REMAPS[remap](lightness_to_gray(truth[..., 0])), 0, 1)
    return Pair(section, remap, grey * mask, mask, truth, source)
