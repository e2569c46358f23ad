"""Stage *coherence*: neighbouring slices share their evidence, so that colour does not flicker from slice to slice.

Slices are matched one by one, but what their matches say about colour, the sums of the local regression over place in the
body and grey, is averaged along the stack with a Gaussian of given width in millimetres before it is read. Evidence is
kept only for the slices within reach: memory does not grow with the stack.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

REACH_SIGMAS = 2.0  # beyond, a slice weighs under a seventh of the nearest


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
        self._sigma = sigma_mm / spacing_mm if spacing_mm > 0 else 0.0
        self._reach = int(np.floor(REACH_SIGMAS * self._sigma))
        self._waiting: dict[int, np.ndarray] = {}
        self._next = 0

    def push(self, k: int, values: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Add slice `k`; yields (slice, weighted sum over its neighbours) for each slice that is complete now."""
        self._waiting[k] = values
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
        total = None
        for k, values in self._waiting.items():
            if abs(k - due) <= self._reach:
                weight = np.exp(-0.5 * ((k - due) / self._sigma) ** 2) if k != due else 1.0
                total = weight * values if total is None else total + weight * values
        return total

    def _forget(self) -> None:
        if self._next < len(self._slices):
            oldest = self._slices[self._next] - self._reach
            for k in [k for k in self._waiting if k < oldest]:
                del self._waiting[k]
