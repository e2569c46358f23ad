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

from .orientation import Lie, largest_part, main_part, turned

OUTLINES_ALIKE = 0.8  # intersection over union in one box: right pairs 0.83 to 0.93, rectangles at most 0.79
PROPORTIONS = 0.3  # of log(height / width): right pairs up to 0.2, head and trunk 0.4 to 1.1
LEAST_MARGIN = 0.018  # of similarity between ways up: right pairs 0.02 to 0.07, pictures of something else up to 0.01
_BEST_QUARTER = 75  # per cent: a scan shows more levels than a photograph; a quarter of its slices must fit
REMEDY = "choose a photograph of the same part of the body, cut across as the slices are"


@dataclass(frozen=True)
class Outline:
    """The largest part of a slice or a photograph.

    Attributes:
        filled: (H, W) bool, brought to the whole grid. proportion: log(height / width), in millimetres or pixels of the picture.
    """

    filled: np.ndarray
    proportion: float


def outline(grey: np.ndarray, mask: np.ndarray, size: tuple[float, float]) -> Outline:
    """Outline of a slice or photograph on the grid.

    Args:
        grey, mask: (H, W). size: (height, width) of the mask's bounding box in any unit that is the same for both.
    """
    part = largest_part(mask)
    share = [np.ptp(np.flatnonzero(part.any(axis))) + 1 for axis in (1, 0)]
    whole = [np.ptp(np.flatnonzero(mask.any(axis))) + 1 for axis in (1, 0)]
    height, width = (size[n] * share[n] / whole[n] for n in (0, 1))
    return Outline(main_part(grey, mask)[1], float(np.log(height / width)))


def doubts(slices: Sequence[Outline], photograph: Outline, lie: Lie) -> list[str]:
    """Reasons to think that the photograph shows something else than the slices; empty where nothing speaks against it.

    Args:
        slices: evenly spread over the slices that the photograph is for. photograph: as it lies in its file. lie: how it lies.
    """
    upright = turned(photograph.filled, lie.way)
    on_its_side = lie.way.startswith(("turned left", "turned right"))
    proportion = -photograph.proportion if on_its_side else photograph.proportion
    overlap = [(one.filled & upright).sum() / max((one.filled | upright).sum(), 1) for one in slices]
    reasons = []
    if np.percentile(overlap, _BEST_QUARTER) < OUTLINES_ALIKE:
        reasons.append(f"its outline is another ({100 * np.percentile(overlap, _BEST_QUARTER):.0f} % in common)")
    apart = np.percentile([abs(one.proportion - proportion) for one in slices], 100 - _BEST_QUARTER)
    if apart > PROPORTIONS:
        mine = np.exp(np.median([one.proportion for one in slices]))
        reasons.append(f"its proportions are others (height to width {np.exp(proportion):.2f}, the scan {mine:.2f})")
    if lie.margin < LEAST_MARGIN:
        reasons.append("it looks no more like the scan one way up than another")
    return reasons
