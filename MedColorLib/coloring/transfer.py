"""Stage *transfer*: matched colours and the scan's own luminance become the slice's colours.

The paper's equation T'' = S(T', T_L) - S(X, T_L) + X, with S the smoother, T_L its guide and, in the paper, X = T_Lab, the
grey slice. S is linear in its source, so S(T') - S(X) = S(T' - X): one solve of the remainder. With the scan's own
luminance kept, only a* and b* are smoothed; the scan has a* = b* = 0. With natural luminance, L* of T' is smoothed as it is,
S(T'), and `natural` puts the scan's detail on it.

With the smoother "regression", X is a better guess than grey: colour as a function of grey in each neighbourhood
(`filters.regression`), and S the fast global smoother. What the guess explains keeps the scan's detail; what it does not,
because two tissues share a grey there, comes from the matches as in the paper.

Matches are weighed by how far they can be trusted, w: S(w (T' - X)) / S(w) spreads colour from trusted pixels to others, so
that a wrong match leaves no patch. Both the guess and the remainder are sums that may be averaged between slices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..color.gamut import bend_lightness, gamma_decode, gamma_encode, lab_to_srgb_in_gamut
from ..color.lab import gray_to_lightness, lab_to_srgb, lightness_to_gray, srgb_to_lab
from ..filters import FILTERS, FgsParameters, regression, smoother_parameters
from ..parameters import AVERAGING
from ..scan.grid import MARGIN, from_grid
from ..scan.intensity import AS_SHOWN, Window, apply_curve
from .natural import natural_lightness, without_noise
from .one_tissue import one_tissue
from .tints import tinted

if TYPE_CHECKING:
    from ..matching.confidence import Trust

# Beside the regression, on half the grid: one iteration. Mean CIEDE2000 on 15 pairs, VGG-19 and embedded: 1.905 and 1.936;
# three iterations of twice the strength 1.923 and 1.985.
REMAINDER = FgsParameters(lam=2.0, sigma=30.0, iterations=1)
# Of the remainder where a grey is one tissue: the photograph's edges lie beside the scan's wherever a match is a little off.
OWN_SHARE = 0.7
EVERY = 2  # each so many-th row and column of the grid is a witness of colour and grey: 0.006 CIEDE2000 more than all
# A witness so far (CIE76) from what its neighbourhood says of its grey counts exp(-1/2): Welsch's weights, in so many turns.
# Without: CT 122 4.8, worst 10.6 instead of 4.5 and 9.5; muscle of the chest CT 17.2 instead of 15.5; front against back of a
# brain 2.0 instead of 1.8 (lightness 0.9). With VGG-19 the chest gets worse, 13.4 to 14.2. Cauchy's weights lead further in
# the chest (12.4), but amplify noise (1.17 instead of 0.95).
OUTLIER_DISTANCE, OUTLIER_TURNS = 14.0, 2
# Share of matches that can be trusted: up to the first outliers are looked for; from the second there are two tissues of one
# grey side by side rather than wrong matches, as in pairs of a section and itself.
_LOOKED_FOR = 0.5, 0.6
_GAMMA = 0.5  # the paper encodes with 1/2 and decodes with 2
_INNER = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]


@dataclass(frozen=True)
class TransferParameters:
    """How colours are brought onto a slice.

    Attributes:
        smoother: "regression" or one of FILTERS.
        luminance: "natural", "keep" or "paper".
        gamma: transfer between gamma 1/2 and 2.
        guide_curve: (256,) how the regression spreads display grey 0..1 over its bins (`intensity.spreading_curve`);
            None leaves it as it is. Not used by the other smoothers.
        smoother_options: names and values of the smoother's parameters (`filters.smoother_options`), or None.
        lightness: 0..1 with natural luminance: from the scan's own lightness to the reference's.
        one_tissue: 0..1, how far a grey is one tissue all over a slice; see `one_tissue`.
        doubts_outliers: the regression's witnesses far from the others count less where few matches can be trusted.
        tints: hue of the photograph by lightness, of `tints.tints_of`, for natural luminance without gamma; None: detail
            changes no hue.
        elsewhere: what all the scan says of grey and colour where a grey is one tissue; see `one_tissue`.
        window: of the scan; the greys here are its tones, and the scan's own lightness is that of its display.
    """

    smoother: str
    luminance: str
    gamma: bool
    guide_curve: np.ndarray | None = None
    smoother_options: dict | None = None
    lightness: float = 1.0
    one_tissue: float = 0.0
    doubts_outliers: bool = False
    tints: np.ndarray | None = None
    elsewhere: np.ndarray | None = None
    window: Window = AS_SHOWN

    @property
    def first_channel(self) -> int:
        """0 where L* is changed, 1 where only a* and b* are."""
        return 1 if self.luminance == "keep" else 0

    @property
    def own(self):
        """The parameters of the chosen smoother."""
        return smoother_parameters(self.smoother, self.smoother_options)


@dataclass(frozen=True)
class SliceMatch:
    """A slice after matching, on the grid.

    Attributes:
        lab: (H, W, 3) T', L* a* b* of the matched colours. grey: (H, W) display grey 0..1. mask: (H, W) bool body.
        trust: how far the matches count; None trusts all alike.
        within: where the slice's box lies in the frame of the regression's cells (`coherence.frames`).
    """

    lab: np.ndarray
    grey: np.ndarray
    mask: np.ndarray
    trust: Trust | None = None
    within: tuple[float, float, float, float] = regression.WHOLE

    @property
    def weight(self) -> np.ndarray:
        """(H, W) float32, how much each match counts; 0 outside the body."""
        mask = self.mask.astype(np.float32)
        return mask if self.trust is None else mask * self.trust.confidence


def transfer(
    grey: np.ndarray, mask: np.ndarray, match: SliceMatch, parameters: TransferParameters
) -> tuple[np.ndarray, int, int]:
    """Colour one slice by itself.

    Args:
        grey: (rows, cols) display grey 0..1 of the body's box at full resolution; mask: (rows, cols) bool body.

    Returns:
        As `to_picture`.
    """
    return to_picture(_transferred(grey, mask, match, parameters), mask)


def to_picture(colors: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, int, int]:
    """L* a* b* (n, 3) of the mask's pixels as a picture.

    Returns:
        (rows, cols, 3) uint8 sRGB, black outside the mask; number of pixels whose chroma was drawn into the gamut; number of
        pixels whose lightness gave way to chroma (`gamut.bend_lightness`).
    """
    rgb = np.zeros((*mask.shape, 3), np.uint8)
    colors, bent = bend_lightness(colors)
    rgb[mask], clipped = lab_to_srgb_in_gamut(colors)
    return rgb, clipped, bent


def transfer_lab(grey: np.ndarray, mask: np.ndarray, match: SliceMatch, parameters: TransferParameters) -> np.ndarray:
    """`transfer` before its colours are drawn into the gamut: (rows, cols, 3) L* a* b*, 0 outside the mask."""
    return on_plane(_transferred(grey, mask, match, parameters), mask)


def on_plane(colors: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Colours (n, 3) of the mask's pixels, row by row, in their places: (rows, cols, 3), 0 outside the mask."""
    plane = np.zeros((*mask.shape, 3), colors.dtype)
    plane[mask] = colors
    return plane


def _transferred(grey: np.ndarray, mask: np.ndarray, match: SliceMatch, parameters: TransferParameters) -> np.ndarray:
    """(n, 3) L* a* b* of the mask's pixels."""
    if parameters.smoother == "regression":
        relation = solve_relation(relation_sums(match, parameters), parameters)
        rest = remainder(match, relation, parameters)
        return combine(grey, mask, relation, rest, parameters, match.within)
    if match.trust is not None and parameters.smoother in AVERAGING:
        return combine(grey, mask, None, remainder(match, None, parameters), parameters)
    difference = _difference(match.lab, match.grey, parameters, parameters.first_channel)
    smoothed = _smoothed(from_grid(difference, grey.shape), grey, parameters)
    return _out_of_transfer(grey, mask, smoothed[mask], parameters)


def relation_sums(match: SliceMatch, parameters: TransferParameters) -> np.ndarray:
    """What a slice's matches say about colour and grey: sums, see `regression.splat`, float32.

    Every match is a witness: here, at this grey of the scan, there is this colour. Where scan and photograph agree in
    contrast, it is a second one: at this luminance of the *photograph* there is this colour. That relation holds even
    when the match is a few pixels off; `Trust.own_relation_weight` says how much it counts.

    Where few matches can be trusted, a mean of right and wrong ones is the colour of neither: witnesses far from the others of
    their place and grey count less.
    """
    sums = _without_outliers(match, parameters)
    own = 0.0 if match.trust is None else match.trust.own_relation_weight
    if own > 0:
        seen = np.clip(lightness_to_gray(match.lab[..., 0]), 0, 1)
        second = _witnesses(match, apply_curve(seen, match.trust.inverse_curve), parameters)
        sums += own * regression.splat(*second, parameters.own, match.within, EVERY)
    return sums


def _witnesses(
    match: SliceMatch, grey: np.ndarray, parameters: TransferParameters
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(h, w, c) what matches say of colour, (h, w) guide 0..255 and (h, w) weight of every EVERY-th pixel inside the margin."""
    lab, grey, weight = (values[_INNER][::EVERY, ::EVERY] for values in (match.lab, grey, match.weight))
    colors = _difference(lab, grey, parameters, 0 if parameters.luminance == "natural" else 1)
    return colors, 255 * _spread(grey, parameters), weight


def _without_outliers(match: SliceMatch, parameters: TransferParameters) -> np.ndarray:
    """Sums of the witnesses of the scan's grey, by reweighted least squares."""
    colors, guide, weight = _witnesses(match, match.grey, parameters)
    witnesses = regression.Witnesses(guide, weight > 0, parameters.own, match.within, EVERY)
    sums = witnesses.sums(colors, weight)
    few, many = _LOOKED_FOR
    known = parameters.doubts_outliers and match.trust is not None
    doubt = 0.0 if not known else np.clip((many - match.trust.trusted_fraction) / (many - few), 0, 1)
    for _ in range(OUTLIER_TURNS if doubt > 0 else 0):
        told = regression.predict(regression.solve(sums, parameters.own), guide, match.within)
        distance = np.square(colors - told).sum(-1) / np.float32(OUTLIER_DISTANCE**2)
        sums = witnesses.sums(colors, weight * np.exp(distance * np.float32(-doubt / 2)))
    return sums


def solve_relation(sums: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    """Colour as a function of place and grey, from the sums of one or several slices."""
    return one_tissue(
        regression.solve(sums, parameters.own), sums, parameters.own, parameters.one_tissue, parameters.elsewhere
    )


def remainder(match: SliceMatch, relation: np.ndarray | None, parameters: TransferParameters) -> np.ndarray:
    """w (T' - X) and, last, w: (h, w, channels + 1) float32, the grid without its margin at half its resolution.

    Half as fine, since matches are coarser still: 1 % more error on the pairs, a quarter of the memory and time.

    Args:
        relation: of `solve_relation`, for X; None takes the grey slice.
    """
    rest = _difference(match.lab, match.grey, parameters, parameters.first_channel)
    weight = match.weight[..., None]
    rest = _halved(np.concatenate([rest * weight, weight], -1))
    if relation is not None:
        grey = _halved(match.grey[..., None])[..., 0]
        guess = regression.predict(relation, 255 * _spread(grey, parameters), match.within)
        rest[..., -1 - guess.shape[-1] : -1] -= guess * rest[..., -1:]
    return rest


def combine(
    grey: np.ndarray,
    mask: np.ndarray,
    relation: np.ndarray | None,
    rest: np.ndarray,
    parameters: TransferParameters,
    within: tuple[float, float, float, float] = regression.WHOLE,
    saturation: float = 1.0,
) -> np.ndarray:
    """X + S(w (T' - X)) / S(w) at full resolution: (n, 3) L* a* b* of the mask's pixels, row by row.

    Beside the regression the remainder counts as far as the matches around can be trusted, min(S(w), 1) times; where a grey is
    one tissue, with natural luminance, (OWN_SHARE min(S(w), 1))^2 times that: what matches that find no tissue say of single
    places is blotches. S runs at half the grid's resolution: the same error on the pairs as at full resolution.

    Args:
        grey, mask: as for `transfer`. relation, rest: as for and of `remainder`. within: see `SliceMatch`.
        saturation: 0..1, share of a*, b* and natural lightness that is kept: 0 gives the grey scan, where nothing can be
            trusted.
    """
    if relation is None:
        smoothed = _smoothed(_resized(rest, grey.shape), grey, parameters)[mask]
        change = smoothed[..., :-1] / np.maximum(smoothed[..., -1:], 1e-12)
    else:
        smoothed = FILTERS["fgs"](rest, guide_of(_resized(grey, rest.shape[:2]), parameters), REMAINDER)
        believed = np.minimum(smoothed[..., -1:], 1) / np.maximum(smoothed[..., -1:], 1e-12)
        if parameters.luminance == "natural":
            trusted = np.float32(OWN_SHARE) * np.minimum(smoothed[..., -1], 1)
            smoothed[..., :-1] *= np.square(1 - np.float32(parameters.one_tissue) * (1 - trusted))[..., None]
        change = _resized(smoothed[..., :-1] * believed, grey.shape)[mask]
        read = without_noise(grey, parameters.window.coarse_noise) if parameters.luminance == "natural" else grey
        guess = regression.predict(relation, 255 * _spread(read, parameters), within, mask)
        change[..., -guess.shape[-1] :] += guess
    return _out_of_transfer(grey, mask, change, parameters, saturation)


def colors_of(
    grey: np.ndarray, mask: np.ndarray, guess: np.ndarray, parameters: TransferParameters, saturation: float = 1.0
) -> np.ndarray:
    """The slice in colours that were guessed for each pixel alone, without a remainder; arguments and result as of `combine`.

    Args:
        guess: (rows, cols, c) what a relation says of the pixels: a*, b* and, with natural luminance first, L*.
    """
    return _out_of_transfer(grey, mask, guess[mask], parameters, saturation)


def spread_guide(grey: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    """Display grey 0..1 as the regression's guide, 0..255."""
    return 255 * _spread(grey, parameters)


def remainder_guide(match: SliceMatch, parameters: TransferParameters) -> np.ndarray:
    """(h, w) 0..255: which pixels of the remainder belong together in neighbouring slices."""
    return _halved(guide_of(match.grey, parameters)[..., None])[..., 0]


def guide_of(grey: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    """The smoothers' guide: L* of the slice in the space of the transfer, as 0..255 float32.

    For the fast global smoother, which the regression uses, too, whole numbers: 8 bits as in the paper, so that OpenCV's serves
    (`filters.opencv`). On thorax pairs L*, a*, b* change by 0.06 at most, the mean error by 0.0001.
    """
    guide = (_lightness(grey, parameters) * 2.55).astype(np.float32)
    return np.rint(guide, out=guide) if parameters.smoother in ("fgs", "regression") else guide


def _smoothed(values: np.ndarray, grey: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    """S(values) of (rows, cols, c) at full resolution."""
    return FILTERS[parameters.smoother](values, guide_of(grey, parameters), parameters.own)


def _halved(values: np.ndarray) -> np.ndarray:
    """(H, W, c) on the grid -> float32 means of 2 x 2, without the margin."""
    inner = values[_INNER].astype(np.float32)
    pairs = inner[::2] + inner[1::2]
    return (pairs[:, ::2] + pairs[:, 1::2]) * np.float32(0.25)


def _resized(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(h, w[, c]) as float32 of another size: means where pixels get larger, bilinear where they get smaller."""
    import cv2

    method = cv2.INTER_AREA if values.shape[0] > shape[0] or values.shape[1] > shape[1] else cv2.INTER_LINEAR
    out = cv2.resize(values.astype(np.float32), (shape[1], shape[0]), interpolation=method)
    return out if out.ndim == values.ndim else out[..., None]


def _spread(grey: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    return grey if parameters.guide_curve is None else apply_curve(grey, parameters.guide_curve)


def _lightness(grey: np.ndarray, parameters: TransferParameters) -> np.ndarray:
    """L* of the slice in the space of the transfer."""
    return gray_to_lightness(
        gamma_encode(parameters.window.shown(grey).astype(np.float64), _GAMMA if parameters.gamma else 1.0)
    )


def _difference(matched: np.ndarray, grid_grey: np.ndarray, parameters: TransferParameters, first: int) -> np.ndarray:
    """T' - T_Lab on the grid, L* a* b* from channel `first` on (the scan's a* and b* are 0), in the space of the transfer.

    With natural luminance L* is that of T' itself.
    """
    lab = matched
    if parameters.gamma:
        lab = srgb_to_lab(gamma_encode(np.clip(lab_to_srgb(lab.astype(np.float64)), 0, 1), _GAMMA))
    rest = lab[..., first:].copy()
    if first == 0 and parameters.luminance == "paper":
        rest[..., 0] -= _lightness(grid_grey, parameters)
    return rest


def _out_of_transfer(
    grey: np.ndarray, mask: np.ndarray, change: np.ndarray, parameters: TransferParameters, saturation: float = 1.0
) -> np.ndarray:
    """T_Lab + change (n, channels), out of the space of the transfer, at the mask's pixels: (n, 3) L* a* b*.

    Args:
        saturation: as of `combine`.
    """
    exact = parameters.gamma or parameters.luminance != "natural"  # else float32 holds all that there is
    lab = np.zeros((len(change), 3), np.float64 if exact else np.float32)
    own = _lightness(grey, parameters)
    if parameters.luminance == "natural":
        told, change = change[:, 0], change[:, 1:]
        lab[:, 0], seen = natural_lightness(own, told, mask, saturation * parameters.lightness)
        if parameters.tints is not None:
            change = tinted(parameters.tints, change, told, seen)
    else:
        lab[:, 0] = own[mask]
    change[..., -2:] *= saturation
    lab[:, 3 - change.shape[1] :] += change
    if parameters.gamma:
        lab = srgb_to_lab(gamma_decode(np.clip(lab_to_srgb(lab), 0, 1), _GAMMA))
        if parameters.luminance == "keep":  # exact again: clipping before decoding may have moved it
            lab[:, 0] = gray_to_lightness(parameters.window.shown(grey[mask]).astype(np.float64))
    return lab
