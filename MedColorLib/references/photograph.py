"""Stage *reference*: a colour photograph becomes tissue colours and a mask that tells tissue from everything else."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..errors import InputError
from ..scan.grid import Grid, continue_outwards, to_grid
from .exposure import Exposure, neutral_balance
from .tissue_mask import find_tissue


@dataclass(frozen=True)
class Frame:
    """The part of a picture that was kept: `shape` (h, w) of the whole picture, (first, behind the last) row and column."""

    shape: tuple[int, int]
    rows: tuple[int, int]
    cols: tuple[int, int]

    @classmethod
    def around(cls, mask: np.ndarray) -> Frame:
        """The bounding box of a mask (h, w), which must not be empty."""
        rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        return cls(mask.shape, (int(rows[0]), int(rows[-1]) + 1), (int(cols[0]), int(cols[-1]) + 1))

    def cut(self, picture: np.ndarray) -> np.ndarray:
        """That part of a picture (h, w[, c]); a contiguous copy."""
        return np.ascontiguousarray(picture[slice(*self.rows), slice(*self.cols)])

    def scaled(self, shape: tuple[int, int]) -> Frame:
        """The same part of the picture in another size, (h, w)."""
        down, across = (new / old for new, old in zip(shape, self.shape))
        rows = round(self.rows[0] * down), round(self.rows[1] * down)
        return Frame(shape, rows, (round(self.cols[0] * across), round(self.cols[1] * across)))


@dataclass(frozen=True)
class Reference:
    """A prepared colour reference, cut to its tissue.

    Attributes:
        rgb: (h, w, 3) uint8 sRGB, cropped to the tissue's bounding box.
        mask: (h, w) bool, True where the pixel is tissue.
        name: label for reports (file name without folder).
        removed: fraction of the photograph that is not tissue.
        group: the folder, library or colour volume that it is one of many of, for the plan.
        credit: whom to name with a result.
        frame: which part of its picture it is; None where that is not known.
        notes: what was decided when it was read and prepared, one clause each.
        white: (red, green, blue) factors of the white balance that the picture asks for; see `exposure`.
        exposure: what `rgb` has been brought to its usual brightness with.
    """

    rgb: np.ndarray
    mask: np.ndarray
    name: str
    removed: float
    group: str = ""
    credit: str = ""
    frame: Frame | None = None
    notes: tuple[str, ...] = ()
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exposure: Exposure = field(default_factory=Exposure)


def prepare_reference(rgb: np.ndarray, name: str = "reference", tissue: np.ndarray | None = None) -> Reference:
    """Cut the tissue out of a photograph; see `tissue_mask`. Its exposure is not changed here.

    Args:
        rgb: (h, w, 3) uint8 sRGB.
        tissue: (h, w) bool, True on tissue where that is known (a given mask, the picture's own transparency).

    Raises:
        InputError: wrong shape or type, no colour in it, or less than 1 % tissue.
    """
    rgb = np.asarray(rgb)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or not rgb.size:
        raise InputError(f"reference {name}: expected an RGB picture (h, w, 3) of uint8, got {rgb.dtype} {rgb.shape}")
    if int(np.ptp(rgb.astype(np.int16), axis=2).max()) <= 2:
        raise InputError(f"reference {name}: the picture has no colour; use a colour photograph")
    if tissue is not None and tissue.shape != rgb.shape[:2]:
        raise InputError(
            f"reference {name}: its mask has shape {tissue.shape}, the picture {rgb.shape[:2]}; make them equal"
        )
    mask, note = find_tissue(rgb) if tissue is None else (np.asarray(tissue, bool), "")
    fraction = float(mask.mean())
    if fraction < 0.01:
        raise InputError(
            f"reference {name}: no tissue found ({100 * fraction:.1f} % of the picture); "
            "use a section that fills the picture, or name what is tissue (--reference-mask)"
        )
    frame, white = Frame.around(mask), neutral_balance(rgb, mask)
    notes = (note,) if note else ()
    return Reference(frame.cut(rgb), frame.cut(mask), name, 1 - fraction, frame=frame, notes=notes, white=white)


def on_grid(reference: Reference, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grey 0..1 (H, W), L*a*b* (H, W, 3) and tissue mask (H, W) of a prepared reference on the grid."""
    from ..color.lab import lightness_to_gray, srgb_to_lab

    # background colour must not bleed into the outline when pixels are averaged
    lab = continue_outwards(srgb_to_lab(reference.rgb.astype(np.float64) / 255), reference.mask)
    mask = to_grid(reference.mask, grid) > 0.5
    lab = continue_outwards(to_grid(lab, grid), mask)
    grey = (lightness_to_gray(lab[..., 0].astype(np.float64)) * mask).astype(np.float32)
    return grey, lab, mask
