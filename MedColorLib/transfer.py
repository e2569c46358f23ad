"""Stage *transfer*: matched colours and the scan's own luminance become the slice's colours.

The paper's equation T'' = S(T', T_L) - S(T_Lab, T_L) + T_Lab, with S the smoother and T_L its guide. S is linear in its
source, so S(T') - S(T_Lab) = S(T' - T_Lab): one solve of the difference. With the scan's own luminance kept, only a* and
b* of the difference are smoothed; the scan has a* = b* = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .color.gamut import gamma_decode, gamma_encode, lab_to_srgb_in_gamut
from .color.lab import gray_to_lightness, lab_to_srgb, srgb_to_lab
from .filters import FILTERS, regression
from .grid import MARGIN, from_grid
from .intensity import apply_curve

_GAMMA = 0.5  # the paper encodes with 1/2 and decodes with 2


@dataclass(frozen=True)
class TransferParameters:
    """How colours are brought onto a slice.

    Attributes:
        smoother: "regression" or one of FILTERS.
        luminance: "keep" or "paper".
        gamma: transfer between gamma 1/2 and 2.
        guide_curve: (256,) how the regression spreads display grey 0..1 over its bins (`intensity.spreading_curve`);
            None leaves it as it is. Not used by the other smoothers.
    """

    smoother: str
    luminance: str
    gamma: bool
    guide_curve: np.ndarray | None = None


def transfer(
    grey: np.ndarray,
    mask: np.ndarray,
    matched: np.ndarray,
    grid_grey: np.ndarray,
    grid_mask: np.ndarray,
    parameters: TransferParameters,
) -> tuple[np.ndarray, int]:
    """Colour one slice.

    Args:
        grey: (rows, cols) display grey 0..1 of the body's box at full resolution; mask: (rows, cols) bool body.
        matched: (H, W, 3) T', L* a* b* on the grid.
        grid_grey, grid_mask: (H, W) the slice on the grid.

    Returns:
        (rows, cols, 3) uint8 sRGB, black outside the mask; number of pixels drawn into the gamut.
    """
    rgb, clipped = lab_to_srgb_in_gamut(transfer_lab(grey, mask, matched, grid_grey, grid_mask, parameters))
    rgb[~mask] = 0
    return rgb, clipped


def transfer_lab(
    grey: np.ndarray,
    mask: np.ndarray,
    matched: np.ndarray,
    grid_grey: np.ndarray,
    grid_mask: np.ndarray,
    parameters: TransferParameters,
) -> np.ndarray:
    """`transfer` before its colours are drawn into the gamut: (rows, cols, 3) L* a* b* float64, 0 outside the mask."""
    matched_rgb = np.clip(lab_to_srgb(matched.astype(np.float64)), 0, 1)
    gamma = _GAMMA if parameters.gamma else 1.0
    lightness = gray_to_lightness(gamma_encode(grey.astype(np.float64), gamma))
    grid_lightness = gray_to_lightness(gamma_encode(grid_grey.astype(np.float64), gamma))
    target_lab = srgb_to_lab(gamma_encode(matched_rgb, gamma))
    difference = target_lab - np.stack(
        [grid_lightness, np.zeros_like(grid_lightness), np.zeros_like(grid_lightness)], -1
    )
    if parameters.luminance == "keep":
        difference = difference[..., 1:]
    if parameters.smoother == "regression":
        smoothed = _regressed(difference, grey, grid_grey, grid_mask, parameters.guide_curve)
    else:
        guide = (lightness * 2.55).astype(np.float32)
        smoothed = FILTERS[parameters.smoother](from_grid(difference.astype(np.float32), grey.shape), guide)
    lab = np.zeros((*grey.shape, 3))
    lab[..., 0] = lightness
    lab[..., 3 - smoothed.shape[2] :] += smoothed
    if parameters.gamma:
        lab = srgb_to_lab(gamma_decode(np.clip(lab_to_srgb(lab), 0, 1), gamma))
        if parameters.luminance == "keep":  # exact again: clipping before decoding may have moved it
            lab[..., 0] = gray_to_lightness(grey.astype(np.float64))
    lab[~mask] = 0
    return lab


def _regressed(difference, grey, grid_grey, grid_mask, guide_curve) -> np.ndarray:
    """Colour as a function of grey: fitted where the matches are, on the grid; read back at full resolution."""
    inner = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
    if guide_curve is not None:
        grey, grid_grey = apply_curve(grey, guide_curve), apply_curve(grid_grey, guide_curve)
    weight = grid_mask[inner].astype(np.float32)
    model = regression.fit(difference[inner], 255 * grid_grey[inner], weight, regression.RegressionParameters())
    return regression.predict(model, 255 * grey)
