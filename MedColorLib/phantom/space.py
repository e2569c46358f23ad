"""A raster in the head's own millimetres, and bodies painted into it."""

from __future__ import annotations

import numpy as np

from .tissues import NUMBER

SIZE_MM = (94.0, 101.6, 88.8)  # from the middle to the middle of the first and last voxel: up, back, left


def depth_of(axes: tuple, centre: tuple, radii: tuple) -> np.ndarray:
    """Depth in mm below the surface of an ellipsoid, about; negative outside. Axes and triples: up, back, left."""
    parts = [(axis - np.float32(c)) / np.float32(r) for axis, c, r in zip(axes, centre, radii)]
    inner = sum((part * part for part in parts), np.float32(0))
    steep = sum(((part / np.float32(r)) ** 2 for part, r in zip(parts, radii)), np.float32(1e-6))
    root = np.sqrt(inner)
    return (root - inner) / np.sqrt(steep)


def joined(one: np.ndarray, other: np.ndarray, round_mm: float) -> np.ndarray:
    """Depth below the surface of two bodies grown together, the crease between them filled."""
    near = np.maximum(np.float32(round_mm) - np.abs(one - other), 0)
    return np.maximum(one, other) + near * near / np.float32(4 * round_mm)


def hump(axis: np.ndarray, centre_mm: float, reach_mm: float) -> np.ndarray:
    """1 at the centre, falling smoothly to 0 at that distance."""
    part = (axis - np.float32(centre_mm)) / np.float32(reach_mm)
    rest = np.maximum(1 - part * part, 0)
    return rest * rest


class Space:
    """Labels on a grid whose axes are positions in mm, up, back and left of the middle.

    Attributes:
        up, back, left: float32 arrays that broadcast to the grid. side: distance from the midline.
        labels: uint8 numbers of tissues.
    """

    def __init__(self, up_mm: np.ndarray, back_mm: np.ndarray, left_mm: np.ndarray) -> None:
        self.lines = tuple(np.asarray(line, np.float32) for line in (up_mm, back_mm, left_mm))
        self.up, self.back, self.left = np.ix_(*self.lines)
        self.side = np.abs(self.left)
        self.labels = np.zeros(tuple(len(line) for line in self.lines), np.uint8)

    def paint(self, tissue: str, centre: tuple, radii: tuple, lean=0.0, tilt=0.0, into: tuple = (), power=2) -> None:
        """An ellipsoid, twice if it lies off the midline.

        Args:
            centre: (side, back, up) in mm. radii: the same way.
            lean: by how much its middle moves sideways a millimetre back. tilt: by how much it moves back a millimetre up.
            into: tissues that it may replace; all, if none are named. power: 2 round, 4 and more boxlike.
        """
        side, back, up = centre
        for sign in (-1, 1) if side else (1,):
            self._paint_one(tissue, (sign * side, back, up), radii, sign * lean, tilt, into, power)

    def _paint_one(self, tissue, centre, radii, lean, tilt, into, power) -> None:
        x, y, z = centre
        rx, ry, rz = radii
        box = tuple(
            slice(*np.searchsorted(line, (middle - reach, middle + reach)))
            for line, middle, reach in zip(
                self.lines,
                (z, y, x),
                (rz, ry + abs(tilt) * rz, rx + abs(lean) * (ry + abs(tilt) * rz)),
            )
        )
        up, back, left = (line[part] for line, part in zip(self.lines, box))
        up, back, left = np.ix_(up, back, left)
        shift = back - np.float32(y)
        high = up - np.float32(z)
        parts = (
            high / np.float32(rz),
            (shift - np.float32(tilt) * high) / np.float32(ry),
            (left - np.float32(x) - np.float32(lean) * shift) / np.float32(rx),
        )
        total = sum(_power(part, power) for part in parts)
        inside = total < 1
        view = self.labels[box]
        if into:
            inside &= _one_of(view, into)
        view[inside] = NUMBER[tissue]

    def fill(self, tissue: str, where: np.ndarray) -> None:
        """A mask."""
        self.labels[where] = NUMBER[tissue]


def _power(part: np.ndarray, power: int) -> np.ndarray:
    square = part * part
    return square if power == 2 else square * square


def _one_of(labels: np.ndarray, names: tuple) -> np.ndarray:
    found = labels == NUMBER[names[0]]
    for name in names[1:]:
        found |= labels == NUMBER[name]
    return found
