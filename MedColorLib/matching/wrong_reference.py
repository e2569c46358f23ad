"""Stage *wrong reference*: whether a photograph can be of the part of the body that the scan shows, before anything is matched.

How far matches are trusted does not tell: a chest after a head is trusted more than after a thorax. Three things do. The
outline: heads and trunks have other proportions, and a picture that tissue, or anything else, fills from edge to edge has
none. And which way up: anatomy fits the right way up and no other; a texture, a landscape or another part of the body fits as
well turned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..references.photograph import Frame
from .orientation import Lie, turned

OUTLINES_ALIKE = 0.8  # intersection over union in one box: right pairs 0.83 to 0.93, rectangles at most 0.79
PROPORTIONS = 0.3  # of log(height / width): right pairs up to 0.2, head and trunk 0.4 to 1.1
# Of similarity between ways up. 35 scans after a right photograph: 0.015 to 0.074, the one below 0.018 with a quarter margin of
# 0.138; after pictures of something else (wood, bread, mosaics, three seeds) mostly below 0.01.
LEAST_MARGIN, LEAST_MARGIN_OF_SURE_QUARTER, SURE_QUARTER = 0.018, 0.013, 0.13
# Likewise between ways that differ by a quarter turn, asked of a photograph that seems to lie on its side: right ones 0.081 to
# 0.163 but for three brains without skull (0.064 to 0.077), pictures of something else 0.007 to 0.076 but for one in 237.
LEAST_QUARTER = 0.08
_TRUNK = 0.6  # of the largest inscribed disc's radius
_LONG_SIDE, _SIDE = 160, 64  # pixels on which outlines are compared
_END = 0.5  # of the largest slice's area
_RECTANGLE = 0.97  # of its box filled
_BEST_QUARTER = 75  # per cent: a scan shows more levels than a photograph; a quarter of its slices must fit
REMEDY = "choose a photograph of the same part of the body, cut across as the slices are"


@dataclass(frozen=True)
class Outline:
    """The trunk of a slice or a photograph: what is left without arms, ears and tables.

    Attributes:
        filled: (64, 64) bool, its bounding box. proportion: log(height / width) of the box. area: of it, in the unit of
            `size`, squared.
    """

    filled: np.ndarray
    proportion: float
    area: float = 1.0


def outline(mask: np.ndarray, size: tuple[float, float]) -> Outline:
    """Outline of a slice or photograph.

    Args:
        mask: (h, w) bool, not empty. size: (height, width) of the mask's bounding box in any unit that is the same for both.
    """
    import cv2
    from scipy import ndimage

    box = Frame.around(ndimage.binary_fill_holes(mask))
    scale = _LONG_SIDE / max(size)
    shape = tuple(max(8, round(length * scale)) for length in size)
    whole = cv2.resize(box.cut(mask).astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
    depth = ndimage.distance_transform_edt(np.pad(ndimage.binary_fill_holes(whole), 1))
    # opened by a disc too large for an arm beside a trunk, which may touch it
    radius = _TRUNK * depth.max()
    trunk = ndimage.distance_transform_edt(depth <= radius) <= radius
    frame = Frame.around(trunk)
    height, width = (last - first for first, last in (frame.rows, frame.cols))
    filled = cv2.resize(frame.cut(trunk).astype(np.float32), (_SIDE, _SIDE), interpolation=cv2.INTER_AREA) > 0.5
    return Outline(filled, float(np.log(height / width)), float(filled.mean()) * height * width / scale**2)


def doubts(slices: Sequence[Outline], photograph: Outline, lie: Lie, best_margin: float | None = None) -> list[str]:
    """Reasons to think that the photograph shows something else than the slices; empty where nothing speaks against it.

    Args:
        slices: evenly spread over the slices that the photograph is for. photograph: as it lies in its file. lie: how it lies.
        best_margin: the largest margin among several references; None: that of `lie`.
    """
    reasons = []
    margin = lie.margin if best_margin is None else best_margin
    least = LEAST_MARGIN if lie.quarter_margin < SURE_QUARTER else LEAST_MARGIN_OF_SURE_QUARTER
    on_its_side = lie.way.startswith(("turned left", "turned right"))
    if margin < least or (on_its_side and lie.margin >= margin and lie.quarter_margin < LEAST_QUARTER):
        reasons.append("it looks no more like the scan one way up than another")
    slices = [one for one in slices if one.filled.mean() < _RECTANGLE]  # a field of view without air has no outline
    if not slices:
        return reasons
    largest = max(one.area for one in slices)
    slices = [one for one in slices if one.area > _END * largest]  # the ends of a head or a brain have any outline
    upright = turned(photograph.filled, lie.way)
    proportion = -photograph.proportion if on_its_side else photograph.proportion
    overlap = [(one.filled & upright).sum() / max((one.filled | upright).sum(), 1) for one in slices]
    if np.percentile(overlap, _BEST_QUARTER) < OUTLINES_ALIKE:
        reasons.append(f"its outline is another ({100 * np.percentile(overlap, _BEST_QUARTER):.0f} % in common)")
    apart = np.percentile([abs(one.proportion - proportion) for one in slices], 100 - _BEST_QUARTER)
    if apart > PROPORTIONS:
        mine = np.exp(np.median([one.proportion for one in slices]))
        reasons.append(f"its proportions are others (height to width {np.exp(proportion):.2f}, the scan {mine:.2f})")
    return reasons
