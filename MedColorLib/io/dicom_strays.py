"""Single images that are no slices of the volume that they lie beside: planning pictures, slices that were taken again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

EVEN = 0.05  # of a step: a stack this even is a volume of its own
_FAR = 3.0  # usual steps beyond which a single image at an end is none of the volume
_LEAST = 4  # images that make a volume without the strays


def is_even(heights: Sequence[float]) -> bool:
    """Whether ascending heights are evenly spaced; of two they are."""
    if len(heights) < 3:
        return len(heights) == 2
    line = np.linspace(heights[0], heights[-1], len(heights))
    step = (heights[-1] - heights[0]) / (len(heights) - 1)
    return bool(step > 0 and np.abs(np.asarray(heights) - line).max() <= EVEN * step)


def strays(heights: Sequence[float]) -> tuple[list[int], str]:
    """Indices of images that are no slices, and why; none where the stack can do with all of them.

    Args:
        heights: in millimetres, ascending, no two the same.
    """
    if len(heights) <= _LEAST or is_even(heights):
        return [], ""
    steps = np.diff(heights)
    far = steps > _FAR * np.median(steps)
    ends = [index for index, is_far in ((0, far[0]), (len(heights) - 1, far[-1])) if is_far]
    if ends and not far[1:-1].any():
        apart = " and ".join(f"{steps[0 if index == 0 else -1]:.4g}" for index in ends)
        return ends, f"single images {apart} mm beyond the others are none of its slices and are left out"
    for index in np.argsort(steps[:-1] + steps[1:])[:2] + 1:  # the one between its neighbours has the smallest steps
        if is_even([*heights[:index], *heights[index + 1 :]]):
            return [int(index)], "one image lies between slices that are even without it, and is left out"
    return [], ""
