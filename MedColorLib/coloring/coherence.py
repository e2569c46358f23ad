"""Stage *coherence*: neighbouring slices share their evidence, so that colour does not flicker from slice to slice.

Slices are matched one by one, but what their matches say about colour, the sums of the local regression over place in the
body and grey, is averaged along the stack with a Gaussian of given width in millimetres before it is read. Evidence is
kept only for the slices within reach: memory does not grow with the stack. The cells of the regression lie in the body's
box, which jumps by pixels from slice to slice; they take a box that is smoothed by the same Gaussian.

Colour passes from one reference to the next by the same average, so no slice is matched with two. Smoothers that do not
weigh matches share no evidence; with these the matched colours themselves are averaged, near changes of reference alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

REACH_SIGMAS = 2.0  # beyond, a slice weighs under a seventh of the nearest
MOST_SLICES = 12.0  # the widest Gaussian in slices: evidence of four times as many is in memory, 1 MB each
GUIDE_SIGMA = 60.0  # 8-bit grey levels at which a neighbouring slice's pixel counts 1/e


def sigma_in_slices(spacing_mm: float, sigma_mm: float) -> float:
    """Width of the Gaussian in slices, at most MOST_SLICES."""
    return min(sigma_mm / spacing_mm, MOST_SLICES) if spacing_mm > 0 else 0.0


def frames(boxes: np.ndarray, spacing_mm: float, sigma_mm: float) -> list[tuple[float, float, float, float]]:
    """Where each slice's box lies in its smoothed box: (top, bottom, left, right), 0 and 1 where they agree.

    Args:
        boxes: (n, 4) [j0, j1, i0, i1) of slices `spacing_mm` apart, in order. sigma_mm: of the smoothing; 0 for none.
    """
    from scipy.ndimage import gaussian_filter1d

    exact = boxes.astype(np.float64)
    sigma = sigma_in_slices(spacing_mm, sigma_mm)
    reach = int(np.floor(REACH_SIGMAS * sigma))
    smooth = gaussian_filter1d(exact, sigma, axis=0, mode="nearest", radius=reach) if reach > 0 else exact
    found = []
    for axis in (slice(0, 2), slice(2, 4)):
        low, high = smooth[:, axis].T
        found += list((exact[:, axis] - low[:, None]).T / (high - low))
    return [tuple(map(float, edges)) for edges in np.stack(found, 1)]


def shares_near_changes(reference_of: Mapping[int, int], spacing_mm: float, sigma_mm: float) -> dict[int, float]:
    """How much of a slice's colour is the average along the stack: most at a change of reference, none out of its reach.

    Args:
        reference_of: slice -> index of its reference.

    Returns:
        Slice -> share 0..1, in order, for the slices within reach; it falls as a parabola, so that colour passes without a
        step at either end.

    >>> shares_near_changes({0: 5, 1: 5, 2: 5, 3: 5, 4: 6, 5: 6}, spacing_mm=1.0, sigma_mm=1.0)
    {2: 0.4375, 3: 0.9375, 4: 0.9375, 5: 0.4375}
    """
    reach = REACH_SIGMAS * sigma_in_slices(spacing_mm, sigma_mm)
    slices = sorted(reference_of)
    changes = [(a + b) / 2 for a, b in zip(slices, slices[1:]) if reference_of[a] != reference_of[b]]
    distance = {k: min((abs(k - change) for change in changes), default=reach) for k in slices}
    return {k: 1 - (far / reach) ** 2 for k, far in distance.items() if far < reach}


class SliceAverage:
    """Gaussian average of per-slice arrays along a stack, in order, with bounded memory.

    >>> average = SliceAverage([3, 4, 5], spacing_mm=1.0, sigma_mm=1.0)
    >>> done = [k for number in (3, 4, 5) for k, _ in average.push(number, np.ones(1))]
    >>> done
    [3, 4, 5]
    """

    def __init__(self, slices: Sequence[int], spacing_mm: float, sigma_mm: float) -> None:
        """Args:
        slices: indices in the order in which they will be pushed, ascending.
        spacing_mm: between neighbouring indices. sigma_mm: of the Gaussian; 0 keeps slices apart.
        """
        self._slices = list(slices)
        self._sigma = sigma_in_slices(spacing_mm, sigma_mm)
        self._reach = int(np.floor(REACH_SIGMAS * self._sigma))
        self._waiting: dict[int, np.ndarray] = {}
        self._guides: dict[int, np.ndarray | None] = {}
        self._next = 0

    def push(self, k: int, values: np.ndarray, guide: np.ndarray | None = None) -> Iterator[tuple[int, np.ndarray]]:
        """Add slice `k`; yields (slice, weighted mean over its neighbours) for each slice that is complete now.

        Args:
            values: any shape, or () for a slice that adds nothing.
            guide: (H, W) 0..255 of `values` (H, W, C): a neighbour's pixel counts less the more its grey differs, as along
                a line of the fast global smoother. None where `values` know grey themselves.
        """
        planes = values if guide is None or values.ndim < 3 else np.ascontiguousarray(np.moveaxis(values, -1, 0))
        self._waiting[k], self._guides[k] = planes, guide
        last = k == self._slices[-1]
        while self._next < len(self._slices):
            due = self._slices[self._next]
            if due > k or (not last and self._needs_more(due, k)):
                break
            yield due, self._average(due)
            self._next += 1
            self._forget()

    def _needs_more(self, due: int, newest: int) -> bool:
        return any(newest < other <= due + self._reach for other in self._slices[self._next :][: 2 * self._reach + 2])

    def _average(self, due: int) -> np.ndarray:
        near = [k for k in sorted(self._waiting) if abs(k - due) <= self._reach]
        own = self._guides[due]
        whole = max((self._waiting[k] for k in near), key=np.size)  # a slice that adds nothing has no shape
        if own is not None and whole.ndim == 0:
            return whole
        total, part, weights = np.zeros_like(whole), np.empty_like(whole), 0.0
        for k in near:  # in place: fresh memory for every product would take longer than the sums
            weight = np.float32(np.exp(-0.5 * ((k - due) / self._sigma) ** 2) if k != due else 1.0)
            if own is not None:
                weight = weight * np.exp(np.abs(self._guides[k] - own) / np.float32(-GUIDE_SIGMA))
            total += np.multiply(self._waiting[k], weight, out=part)
            weights = weights + weight
        return total / weights if own is None else np.moveaxis(total / weights, 0, -1)

    def _forget(self) -> None:
        if self._next < len(self._slices):
            oldest = self._slices[self._next] - self._reach
            for k in [k for k in self._waiting if k < oldest]:
                del self._waiting[k], self._guides[k]
