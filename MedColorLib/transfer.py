"""Stage *transfer*: matched colours and the scan's own luminance become the slice's colours.

The paper's equation T'' = S(T', T_L) - S(T_Lab, T_L) + T_Lab, with S the smoother and T_L its guide. S is linear in its
source, so S(T') - S(T_Lab) = S(T' - T_Lab): one solve of the difference. With the scan's own luminance kept, only a* and
b* of the difference are smoothed; the scan has a* = b* = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .color.gamut import gamma_decode, gamma_encode, lab_to_srgb_in_gamut
from .color.lab import gray_to_lightness, lab_to_srgb, lightness_to_gray, srgb_to_lab
from .filters import FILTERS, regression
from .grid import MARGIN, from_grid
from .intensity import apply_curve

if TYPE_CHECKING:
    from .confidence import Trust

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
    trust: Trust | None = None,
) -> tuple[np.ndarray, int]:
    """Colour one slice.

    Args:
        grey: (rows, cols) display grey 0..1 of the body's box at full resolution; mask: (rows, cols) bool body.
        matched: (H, W, 3) T', L* a* b* on the grid.
        grid_grey, grid_mask: (H, W) the slice on the grid.
        trust: how far the matches count in the regression; None trusts all alike. Not used by the other smoothers.

    Returns:
        (rows, cols, 3) uint8 sRGB, black outside the mask; number of pixels drawn into the gamut.
    """
    return to_picture(transfer_lab(grey, mask, matched, grid_grey, grid_mask, parameters, trust), mask)


def to_picture(lab: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, int]:
    """(rows, cols, 3) uint8 sRGB of L* a* b*, black outside the mask; number of pixels drawn into the gamut."""
    rgb, clipped = lab_to_srgb_in_gamut(lab)
    rgb[~mask] = 0
    return rgb, clipped


def transfer_lab(
    grey: np.ndarray,
    mask: np.ndarray,
    matched: np.ndarray,
    grid_grey: np.ndarray,
    grid_mask: np.ndarray,
    parameters: TransferParameters,
    trust: Trust | None = None,
) -> np.ndarray:
    """`transfer` before its colours are drawn into the gamut: (rows, cols, 3) L* a* b* float64, 0 outside the mask."""
    if parameters.smoother == "regression":
        sums = evidence(matched, grid_grey, grid_mask, parameters, trust)
        return transfer_evidence(grey, mask, sums, parameters, lightness_change(matched, grid_grey, parameters))
    difference = _difference(matched, grid_grey, parameters)
    if parameters.luminance == "keep":
        difference = difference[..., 1:]
    return _combined(grey, mask, _filtered(difference, grey, parameters, parameters.smoother), parameters)


def evidence(
    matched: np.ndarray,
    grid_grey: np.ndarray,
    grid_mask: np.ndarray,
    parameters: TransferParameters,
    trust: Trust | None = None,
) -> np.ndarray:
    """What a slice's matches say about colour: sums for the local regression, which may be averaged between slices.

    Every match is a witness: here, at this grey of the scan, there is this colour. Where scan and photograph agree in
    contrast, it is a second one: at this luminance of the *photograph* there is this colour. That relation holds even
    when the match is a few pixels off; `Trust.own_relation_weight` says how much it counts.

    Args:
        trust: None trusts all matches alike and takes the first witness only.

    Returns:
        float32, see `regression.splat`.
    """
    weight = grid_mask.astype(np.float32) if trust is None else grid_mask * trust.confidence
    sums = _witnesses(matched, grid_grey, weight, parameters)
    own = 0.0 if trust is None else trust.own_relation_weight
    if own > 0:
        seen = np.clip(lightness_to_gray(matched[..., 0].astype(np.float64)), 0, 1)
        sums += own * _witnesses(matched, apply_curve(seen, trust.inverse_curve), weight, parameters)
    return sums


def _witnesses(matched, grey, weight, parameters) -> np.ndarray:
    inner = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
    difference = _difference(matched, grey, parameters)[..., 1:]
    guide = 255 * _spread(grey, parameters)
    return regression.splat(difference[inner], guide[inner], weight[inner], regression.RegressionParameters())


def transfer_evidence(
    grey: np.ndarray,
    mask: np.ndarray,
    sums: np.ndarray,
    parameters: TransferParameters,
    change: np.ndarray | None = None,
) -> np.ndarray:
    """Colour one slice from evidence: (rows, cols, 3) L* a* b* float64, 0 outside the mask.

    Args:
        change: (H, W) of `lightness_change`, or None.
    """
    model = regression.solve(sums, regression.RegressionParameters())
    smoothed = regression.predict(model, 255 * _spread(grey, parameters))
    if change is not None:
        smoothed = np.concatenate([_filtered(change[..., None], grey, parameters, "fgs"), smoothed], -1)
    return _combined(grey, mask, smoothed, parameters)


def lightness_change(matched: np.ndarray, grid_grey: np.ndarray, parameters: TransferParameters) -> np.ndarray | None:
    """T'_L - T_L (H, W) on the grid where the reference's luminance is let through, else None.

    It goes through FGS beside the regression, too: a regression of luminance on luminance would return a curve of grey
    and lose what the scan shows.
    """
    if parameters.luminance == "keep":
        return None
    return _difference(matched, grid_grey, parameters)[..., 0].astype(np.float32)


def _filtered(difference: np.ndarray, grey: np.ndarray, parameters: TransferParameters, smoother: str) -> np.ndarray:
    """S(difference) at full resolution, guided by the slice's lightness in 8-bit units."""
    guide = (_lightness(grey, parameters) * 2.55).astype(np.float32)
    return FILTERS[smoother](from_grid(difference.astype(np.float32), grey.shape), guide)


def _spread(grey: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    return grey if parameters.guide_curve is None else apply_curve(grey, parameters.guide_curve)


def _lightness(grey: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    """L* of the slice in the space of the transfer."""
    return gray_to_lightness(gamma_encode(grey.astype(np.float64), _GAMMA if parameters.gamma else 1.0))


def _difference(matched: np.ndarray, grid_grey: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    """T' - T_Lab on the grid, L* a* b* (the scan's a* and b* are 0), in the space of the transfer."""
    lab = matched.astype(np.float64)
    if parameters.gamma:
        lab = srgb_to_lab(gamma_encode(np.clip(lab_to_srgb(lab), 0, 1), _GAMMA))
    lab[..., 0] -= _lightness(grid_grey, parameters)
    return lab


def _combined(grey: np.ndarray, mask: np.ndarray, smoothed: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    """S(T' - T) + T, out of the space of the transfer, 0 outside the mask."""
    lab = np.zeros((*grey.shape, 3))
    lab[..., 0] = _lightness(grey, parameters)
    lab[..., 3 - smoothed.shape[2] :] += smoothed
    if parameters.gamma:
        lab = srgb_to_lab(gamma_decode(np.clip(lab_to_srgb(lab), 0, 1), _GAMMA))
        if parameters.luminance == "keep":  # exact again: clipping before decoding may have moved it
            lab[..., 0] = gray_to_lightness(grey.astype(np.float64))
    lab[~mask] = 0
    return lab
