"""Stage *slices*: the volume as a stack of transverse slices, whatever way it was acquired, without resampling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .air import in_hounsfield
from .grid import Grid, to_grid
from .intensity import Window, apply_window, choose_window, of_hounsfield

if TYPE_CHECKING:
    from .body import Body

PLANES = ("transverse", "acquired")
SAMPLE_SLICES = 7  # slices from which contrast curve and orientation are taken


@dataclass(frozen=True)
class SliceOrder:
    """How to see an array (k, j, i[, c]) as a stack of slices, and back. Transposes and flips only: exact and free.

    Attributes:
        axes: for stack, row, column: which array axis they are.
        flips: for stack, row, column: whether the array axis runs the other way.
    """

    axes: tuple[int, int, int]
    flips: tuple[bool, bool, bool]

    def view(self, array: np.ndarray) -> np.ndarray:
        """The array as (slice, row, column[, c]): a view, nothing copied."""
        rest = tuple(range(3, array.ndim))
        seen = array.transpose(*self.axes, *rest)
        return seen[tuple(slice(None, None, -1 if flip else 1) for flip in self.flips)]

    def ranges(self, region, shape: tuple[int, int, int]) -> tuple[tuple[int, int], ...]:
        """Voxel ranges ((k0, k1), (j0, j1), (i0, i1)) of the array as (slice, row, column) ranges of the view."""
        seen = []
        for axis, flip in zip(self.axes, self.flips):
            start, stop = (min(edge, shape[axis]) for edge in region[axis])
            seen.append((shape[axis] - stop, shape[axis] - start) if flip else (start, stop))
        return tuple(seen)

    def describe(self) -> str:
        """One sentence for the plan."""
        stack = "kji"[self.axes[0]]
        return f"slices run along array axis {stack}{', reversed' if self.flips[0] else ''}"


def slice_order(ijk_to_ras: np.ndarray, plane: str = "transverse") -> SliceOrder:
    """Order in which slices run from the feet up, rows from front to back, columns from the patient's right to left.

    That is the usual display of a transverse slice, and how cryosection photographs are compared. Oblique volumes take
    the nearest axes. With plane "acquired" the array is taken as it lies.
    """
    if plane == "acquired":
        return SliceOrder((0, 1, 2), (False, False, False))
    directions = ijk_to_ras[:3, :3] / np.linalg.norm(ijk_to_ras[:3, :3], axis=0)
    by_array_axis = directions[:, ::-1]  # columns now k, j, i = array axes 0, 1, 2; rows R, A, S
    best, axes = -1.0, (0, 1, 2)
    for candidate in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        stack, row, column = candidate
        fit = abs(by_array_axis[2, stack]) + abs(by_array_axis[1, row]) + abs(by_array_axis[0, column])
        if fit > best + 1e-9:
            best, axes = fit, candidate
    stack, row, column = axes
    flips = (by_array_axis[2, stack] < 0, by_array_axis[1, row] > 0, by_array_axis[0, column] > 0)
    return SliceOrder(axes, tuple(bool(f) for f in flips))


def window_of(
    view: np.ndarray,
    body: Body,
    ks: Sequence[int],
    given: tuple[float, float] | None = None,
    proposed: tuple[float, float] | None = None,
) -> Window:
    """The window of a scan, from what the body holds in some slices; with tones where the values are Hounsfield units.

    Args:
        view: (slice, row, column) scalars, as `SliceOrder.view` gives them. Others and errors as of `intensity.choose_window`.
    """
    masks = np.stack([body.plane(k) > 0.5 for k in ks])
    window = choose_window(view[ks], masks if masks.any() else None, given, proposed)
    return of_hounsfield(window) if in_hounsfield(view) else window


def slice_in_box(view: np.ndarray, body: Body, window: Window, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Slice k cut to the body's box, at full resolution.

    Args:
        view: (slice, row, column) scalars, as `SliceOrder.view` gives them.

    Returns:
        Tones 0..1 and coverage by the body 0..1, both (rows, cols) float32.
    """
    j0, j1, i0, i1 = body.boxes[k]
    return window.tone(apply_window(view[k, j0:j1, i0:i1], window)), body.plane(k)[j0:j1, i0:i1]


def slice_on_grid(view: np.ndarray, body: Body, window: Window, grid: Grid, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Tones 0..1, black outside the body, and body mask of slice k on the grid, both (H, W)."""
    grey, cover = slice_in_box(view, body, window, k)
    mask = to_grid(cover, grid) > 0.5
    return to_grid(grey * (cover > 0.5), grid) * mask, mask


def sample_slices(slices: Sequence[int], count: int = SAMPLE_SLICES) -> list[int]:
    """At most `count` evenly spread members of `slices`, ends left out where there are enough."""
    if len(slices) <= count:
        return list(slices)
    positions = (np.arange(count) + 0.5) * len(slices) / count
    return [slices[int(p)] for p in positions]
