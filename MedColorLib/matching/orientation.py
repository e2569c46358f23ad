"""Stage *orientation*: which way up a photograph lies. Cryosections are kept face up, face down, mirrored, or on their side.

The eight ways a picture can lie (quarter turns, and each mirrored) are matched coarsely with contrast-invariant features that
know their place in the body; the way with the highest similarity is taken. Two things help: bodies are mirror images of
themselves about the plane between left and right, not about any other, which tells quarter turns; and where the scan shows
less than the photograph (a head without its skull), the photograph's inner part is tried, too. Left and right of a body
differ little: a picture is not mirrored unless that is clearly better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..device import Each
from ..scan.grid import Grid, to_grid
from ..scan.intensity import apply_curve, histogram_match_curve
from .coarse import LAYER, mean_inside

WAYS = {  # how a picture lies: quarter turns to the left that it has been turned by, whether it was mirrored before
    "as it is": (0, False),
    "turned by half": (2, False),
    "mirrored": (0, True),
    "upside down": (2, True),
    "turned left": (1, False),
    "turned right": (3, False),
    "turned left and mirrored": (1, True),
    "turned right and mirrored": (3, True),
}
PAIRS = (  # differ in left and right only
    ("as it is", "mirrored"),
    ("turned by half", "upside down"),
    ("turned left", "turned left and mirrored"),
    ("turned right", "turned right and mirrored"),
)
CLEARLY = 0.015  # of similarity, for left and right; their scatter on real heads is up to 0.012
# Likewise, of a picture that lies turned: three trunks 0.004 where it is not, slabs of one 0.014; the sample 0.0126 where it is.
MIRRORED = 0.012
TURNED = 0.004  # of similarity, for another way up
GUESS = 0.015  # of similarity between the best two pairs of ways; less is a guess
SURE = 0.03  # more needs no second look
SLICES = 6  # that are compared with the photograph; the half that is most like it counts twice
_SYMMETRY = 0.5  # of similarity, by how much more alike one mirror image is than the other
_MOST_SYMMETRY = 0.05
_INNER = 0.11  # of the shorter side: scalp and skull
_TOUCH = 0.035  # of the grid's side: where two parts touch in a stretch narrower than twice that, they are two
_REACH = 2  # positions of the layer


@dataclass(frozen=True)
class Lie:
    """How a photograph lies.

    Attributes:
        way: key of WAYS. margin: similarity by which its pair of ways is ahead of the next, 0 or more.
        scores: similarity of each way.
    """

    way: str
    margin: float
    scores: dict[str, float]

    @property
    def quarter_margin(self) -> float:
        """Similarity by which the best way is ahead of the best that differs by a quarter turn."""
        own = WAYS[max(self.scores, key=self.scores.get)][0] % 2
        others = (score for way, score in self.scores.items() if WAYS[way][0] % 2 != own)
        return float(max(self.scores.values()) - max(others))

    @property
    def guess(self) -> bool:
        """Whether another way is nearly as likely."""
        return self.margin < GUESS

    def describe(self) -> str:
        """For people."""
        return f"{self.way}, a guess: another way looks nearly as likely" if self.guess else self.way


def turned(picture: np.ndarray, way: str) -> np.ndarray:
    """The picture (h, w[, c]) that lies the given way, brought upright: (h, w[, c]) or (w, h[, c]); a contiguous copy."""
    quarters, mirrored = WAYS[way]
    upright = np.rot90(picture, -quarters)
    return np.ascontiguousarray(upright[:, ::-1] if mirrored else upright)


def laid(picture: np.ndarray, way: str) -> np.ndarray:
    """The inverse of `turned`: an upright picture laid the given way."""
    quarters, mirrored = WAYS[way]
    return np.ascontiguousarray(np.rot90(picture[:, ::-1] if mirrored else picture, quarters))


def choose_way(greys: np.ndarray, masks: np.ndarray, reference_grey: np.ndarray, reference_mask: np.ndarray) -> str:
    """Key of WAYS in which the reference looks most like the slices; see `find_way`."""
    return find_way(greys, masks, reference_grey, reference_mask).way


def find_way(
    greys: np.ndarray, masks: np.ndarray, reference_grey: np.ndarray, reference_mask: np.ndarray, each: Each = map
) -> Lie:
    """Find out how the reference lies.

    Args:
        greys: (S, H, W) 0..1 on a square grid; masks: (S, H, W) bool. reference_grey, reference_mask: (H, W) on the grid.
        each: how ways and slices are looked at, which do not depend on each other; see `device.side_by_side`.
    """
    if not reference_mask.any() or not masks.any():
        return Lie("as it is", 0.0, dict.fromkeys(WAYS, 0.0))
    slices = [main_part(*one) for one in zip(*_some(greys, masks))]
    photograph = main_part(reference_grey, reference_mask)
    scores = _scores(slices, (photograph, inner_part(*photograph)), each)
    *symmetries, own = each(symmetry, *zip(*slices, photograph))
    upright = np.median(symmetries)
    agreement = _SYMMETRY * min(abs(upright), abs(own), _MOST_SYMMETRY) * np.sign(upright * own)
    for way, (quarters, _) in WAYS.items():
        scores[way] += float(agreement if quarters % 2 == 0 else -agreement)
    return _lie(scores)


def common_way(lies: Sequence[Lie]) -> Lie:
    """How a series lies, whose pictures all lie the same way: the way of the highest mean."""
    scores = {way: float(np.mean([lie.scores[way] for lie in lies])) for way in WAYS}
    return _lie(scores)


def mirrored_by_both(lie: Lie, greys, masks, reference_grey, reference_mask) -> Lie:
    """How a photograph lies that self-similarity takes for mirrored: so only where the own features agree.

    Left and right of a trunk differ little, and a slab that begins two slices higher must not exchange them. Of chest slabs whose
    photograph is not mirrored, self-similarity is ahead by 0.006 to 0.014 where it is, the own features where it is not.

    Args:
        lie: of `find_way`; the others as for it.
    """
    import torch

    from ..features.contrast_net import Contrast
    from .contrast_match import match

    if not WAYS[lie.way][1]:
        return lie
    plain = next(way for pair in PAIRS if lie.way in pair for way in pair if not WAYS[way][1])
    greys, masks = _some(greys, masks)
    network, inside, alike = Contrast(), torch.from_numpy(masks), {}
    target = network.positions(torch.from_numpy((greys * masks).astype(np.float32))[:, None])
    for way in (lie.way, plain):
        grey, mask = turned(reference_grey * reference_mask, way), turned(reference_mask, way)
        features = network.positions(torch.from_numpy(grey.astype(np.float32))[None, None])
        found = match(target, features, inside, torch.from_numpy(mask), keep_reverse=False)
        alike[way] = mean_inside(found.similarity, inside)
    return replace(lie, way=max((plain, lie.way), key=alike.get))


def _bar(plain: str) -> float:
    """Similarity by which a picture has to be ahead where it is mirrored, that otherwise lies so."""
    return CLEARLY if plain == "as it is" else MIRRORED


def _lie(scores: dict[str, float]) -> Lie:
    """The best way; a picture lies as it is, and is not mirrored, unless another way is clearly better.

    On three trunks (two CT, one MR) the mirrored way of a photograph that is not was ahead by 0.000, 0.001 and 0.004.
    """
    best = max(scores, key=scores.get)
    pair = next(pair for pair in PAIRS if best in pair)
    margin = scores[best] - max(score for way, score in scores.items() if way not in pair)
    plain = next(way for way in pair if not WAYS[way][1])
    if scores[best] <= scores[plain] + _bar(plain):
        best = plain
    if "as it is" not in pair and scores[best] <= scores["as it is"] + TURNED:
        best = "as it is"
    return Lie(best, max(float(margin), 0.0), scores)


def coarse_similarity(greys, masks, reference_grey, reference_mask) -> float:
    """Mean similarity inside the body of slices and reference at layer 4, whatever their contrasts."""
    planes = np.asarray(greys, np.float32), np.asarray(masks)
    target = _features(_in_contrast(*planes, reference_grey, reference_mask))
    return float(np.mean(_similarities(target, planes[1], reference_grey, reference_mask)))


def main_part(grey: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey and mask (H, W) of the largest part alone, brought to the whole grid: a trunk without the arms beside it."""
    return _filling(grey, largest_part(mask))


def largest_part(mask: np.ndarray) -> np.ndarray:
    """(H, W) bool: the largest part of a mask; parts that only touch are parted."""
    import cv2
    from scipy import ndimage

    size = 2 * round(_TOUCH * max(mask.shape)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    core = cv2.erode(mask.astype(np.uint8), disc, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    labels, count = ndimage.label(core)
    if count < 2:
        return mask
    core = labels == 1 + np.bincount(labels.ravel())[1:].argmax()
    return mask & (cv2.dilate(core.astype(np.uint8), disc) > 0)


def inner_part(grey: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey and mask (H, W) without the outermost tenth, brought to the whole grid: a head without scalp and skull."""
    from scipy import ndimage

    whole = ndimage.binary_fill_holes(mask)
    depth = ndimage.distance_transform_edt(np.pad(whole, 1))[1:-1, 1:-1]
    inner = mask & (depth > _INNER * min(np.ptp(np.flatnonzero(mask.any(1))), np.ptp(np.flatnonzero(mask.any(0)))))
    return _filling(grey, inner if inner.any() else mask)


def symmetry(grey: np.ndarray, mask: np.ndarray) -> float:
    """By how much a picture (H, W) is more like itself with left and right exchanged than upside down, -1..1."""
    import torch

    own = _features(grey[None])[LAYER]
    alike = []
    for flipped in (np.s_[:, ::-1], np.s_[::-1]):
        other = _features(np.ascontiguousarray(grey[flipped])[None])[LAYER]
        inside = torch.from_numpy(np.ascontiguousarray(mask[flipped]))[None]
        alike.append(mean_inside(nearby_similarity(own, other, inside), torch.from_numpy(mask)[None]))
    return alike[0] - alike[1]


def nearby_similarity(target, reference, reference_mask, reach: int = _REACH):
    """(N, h, w): highest similarity of each position with those of the reference within `reach` positions.

    Args:
        target: (N, C, h, w) unit features; reference: (1, C, h, w). reference_mask: (1, H, W) bool.
    """
    import torch
    from torch.nn.functional import adaptive_avg_pool2d, pad

    height, width = target.shape[2:]
    inside = adaptive_avg_pool2d(reference_mask.float(), (height, width)) > 0.5
    padded = pad(reference * inside[:, None], (reach,) * 4)
    best = torch.full((target.shape[0], height, width), -1.0)
    for row in range(2 * reach + 1):
        for col in range(2 * reach + 1):
            best = torch.maximum(best, (target * padded[:, :, row : row + height, col : col + width]).sum(1))
    return best


def _some(greys: np.ndarray, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    chosen = [k for k in range(len(greys)) if masks[k].any()]
    chosen = [chosen[int((n + 0.5) * len(chosen) / SLICES)] for n in range(SLICES)] if len(chosen) > SLICES else chosen
    return greys[chosen], masks[chosen]


def _scores(slices: Sequence[tuple], photographs: Sequence[tuple], each: Each) -> dict[str, float]:
    """Similarity of each way, with that part of the photograph that is most like the slices."""
    greys, masks = (np.stack(values) for values in zip(*slices))
    found = []
    for grey, mask in photographs:
        target = _features(_in_contrast(greys, masks, grey, mask))
        photographs_turned = ((turned(grey, way), turned(mask, way)) for way in WAYS)
        alike = np.stack(list(each(lambda turn, t=target: _similarities(t, masks, *turn), photographs_turned)))
        like = np.argsort(-alike.max(axis=0), kind="stable")[: -(-alike.shape[1] // 2)]
        found.append(dict(zip(WAYS, ((alike.mean(axis=1) + alike[:, like].mean(axis=1)) / 2).tolist())))
    return max(found, key=lambda scores: max(scores.values()))


def _filling(grey: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not rows.size:
        return grey, mask
    box, grid = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1], Grid(*mask.shape)
    filled = to_grid(mask[box], grid) > 0.5
    return (to_grid((grey * mask)[box], grid) * filled).astype(np.float32), filled


def _in_contrast(greys, masks, reference_grey, reference_mask) -> np.ndarray:
    curve = histogram_match_curve(greys[masks], reference_grey[reference_mask])
    return apply_curve(greys, curve) * masks


def _features(greys: np.ndarray):
    """Self-similarity at layers 5 and 4 of (S, H, W) greys."""
    import torch

    from ..features.self_similarity import SelfSimilarity

    return SelfSimilarity().extract(torch.from_numpy(np.asarray(greys, np.float32)[:, None]), (5, LAYER))


def _similarities(
    target: dict, masks: np.ndarray, reference_grey: np.ndarray, reference_mask: np.ndarray
) -> np.ndarray:
    """(S,) mean similarity inside the body of each slice."""
    import torch

    from .analogy import Context, deep_image_analogy

    context = Context(position_weight=1.0, luminance_weight=0.0, target=None, reference=None)
    inside = torch.from_numpy(masks), torch.from_numpy(reference_mask)
    found = deep_image_analogy(target, _features(reference_grey[None]), *inside, LAYER, context)
    return np.array([mean_inside(found.similarity[n : n + 1], inside[0][n : n + 1]) for n in range(len(masks))])
