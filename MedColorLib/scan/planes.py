"""Stage *slices*: planes of a stack that lie across memory, or across a mapped file, brought together some at a time.

A transverse slice of a sagittal series takes a voxel or two from every page of the file. Slice by slice, a file larger than
memory would be read from disk once a slice; in blocks of planes it is read once a block.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator

import numpy as np

MOST_BYTES = 1 << 25  # of a block; two are kept, one for slices that are matched, one for those that are coloured later
_KEPT = 2


def planes_of(view: np.ndarray, most_bytes: int | None = None) -> np.ndarray | PlaneBlocks:
    """A stack (slice, row, column) to be read plane by plane.

    Returns:
        The view itself where each plane lies together, a copy in which it does where that takes at most `most_bytes`
        (None: MOST_BYTES), else blocks.
    """
    most_bytes = MOST_BYTES if most_bytes is None else most_bytes
    strides = [abs(stride) for stride, size in zip(view.strides, view.shape) if size > 1]
    if len(view) == 1 or not strides or abs(view.strides[0]) == max(strides):
        return view
    return np.ascontiguousarray(view) if view.nbytes <= most_bytes else PlaneBlocks(view, most_bytes)


class PlaneBlocks:
    """Looks like the stack for reading: `planes[k]`, `planes[k, j0:j1, i0:i1]`, `planes[[3, 5]]`, `planes[::4]`, iteration.

    May be read by several threads.
    """

    def __init__(self, view: np.ndarray, most_bytes: int) -> None:
        self._view = view
        self._count = max(1, min(len(view), most_bytes // max(view[0].nbytes, 1)))
        self._blocks: OrderedDict[int, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()
        self.shape, self.dtype, self.ndim, self.size = view.shape, view.dtype, view.ndim, view.size
        self.flags = view.flags

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, index):
        first, rest = (index[0], index[1:]) if isinstance(index, tuple) else (index, ())
        if isinstance(first, slice):
            return PlaneBlocks(self._view[(first, *rest)], self._count * self._view[0].nbytes)
        if np.ndim(first):
            return np.stack([self[(k, *rest)] for k in first])
        k = range(len(self))[first]  # negative ones, and an IndexError beyond
        return self._block(k // self._count)[(k % self._count, *rest)]

    def __array__(self, dtype=None, copy=None):
        return np.array(self._view, dtype)

    def _block(self, number: int) -> np.ndarray:
        with self._lock:
            if number not in self._blocks:
                while len(self._blocks) >= _KEPT:
                    self._blocks.popitem(last=False)
                self._blocks[number] = self._read(number)
            self._blocks.move_to_end(number)
            return self._blocks[number]

    def _read(self, number: int) -> np.ndarray:
        block = np.ascontiguousarray(self._view[number * self._count : (number + 1) * self._count])
        block.setflags(write=False)
        return block
