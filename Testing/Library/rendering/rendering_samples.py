"""What the tests of rendering share: samples and small helpers."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest

from MedColorLib.rendering import (
    presets,
    render_view,
)
from MedColorLib.volume import ColorVolume

ORANGE, BLUE = (200, 120, 60), (60, 120, 200)


RAS_DIAGONAL = np.diag([-1.0, -1.0, 1.0, 1.0])  # the usual file: LPS, right-handed


def centred(matrix, shape_kji):
    """The matrix with its translation chosen so that the array's middle lies at RAS 0."""
    matrix = np.array(matrix, dtype=float)
    matrix[:3, 3] = -matrix[:3, :3] @ ((np.array(shape_kji[::-1]) - 1) / 2)
    return matrix


def painted(paint, shape_kji, matrix=RAS_DIAGONAL):
    """A volume whose voxel colours are `paint(r, a, s)` at the voxels' RAS positions."""
    matrix = centred(matrix, shape_kji)
    k, j, i = np.meshgrid(*[np.arange(n) for n in shape_kji], indexing="ij")
    r, a, s = (matrix[row, 0] * i + matrix[row, 1] * j + matrix[row, 2] * k + matrix[row, 3] for row in range(3))
    return ColorVolume(paint(r, a, s).astype(np.uint8), matrix)


def two_colour_ball(radius_mm=18.0, left=BLUE, right=ORANGE):
    def paint(r, a, s):
        inside = r**2 + a**2 + s**2 < radius_mm**2
        return np.where(inside[..., None], np.where((r > 0)[..., None], right, left), 0)

    return paint


SIDES = {  # six balls on the axes, each of a colour of its own
    "R": ((1, 0, 0), (230, 60, 60)),
    "L": ((-1, 0, 0), (60, 200, 60)),
    "A": ((0, 1, 0), (90, 90, 240)),
    "P": ((0, -1, 0), (220, 200, 40)),
    "S": ((0, 0, 1), (200, 60, 200)),
    "I": ((0, 0, -1), (60, 200, 200)),
}


def six_balls(r, a, s):
    rgb = np.zeros((*r.shape, 3))
    for axis, colour in SIDES.values():
        centre = 14.0 * np.array(axis)
        rgb[(r - centre[0]) ** 2 + (a - centre[1]) ** 2 + (s - centre[2]) ** 2 < 5.5**2] = colour
    return rgb


SOLID = 0.88  # hardly anything shines through


def view(volume, name="anterior", size=(120, 120), **kwargs):
    return render_view(volume, name, size, **{"shade": False, "opacity": SOLID, **kwargs})


def lit(colour):
    """What a surface that faces the lamp shows: all three Phong terms."""
    share = presets.AMBIENT + presets.DIFFUSE
    return np.minimum(share * np.array(colour) + presets.SPECULAR * 255, 255)


def distance(pixel, colour):
    return np.abs(pixel.astype(int) - np.array(colour)).max()


def directions():
    """Of the 48 storage orders and signs, right- and left-handed, every seventh: enough to meet all axes."""
    chosen = []
    for order, signs in list(product(permutations(range(3)), product((-1, 1), repeat=3)))[::7]:
        matrix = np.zeros((4, 4))
        matrix[3, 3] = 1
        for column, (row, sign) in enumerate(zip(order, signs)):
            matrix[row, column] = sign
        chosen.append(pytest.param(matrix, id=f"{order}{signs}"))
    return chosen


def rotation(axis, degrees):
    axis = np.array(axis, float) / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), axis)
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


OBLIQUE = {
    "rotated": rotation((1, 2, 3), 35),
    "rotated left-handed": rotation((3, -1, 2), 50) @ np.diag([1, 1, -1]),
    "sheared": np.array([[1, 0.3, 0], [0, 1, 0.2], [0, 0, 1]]),
    "anisotropic": rotation((1, 0, 1), 20) @ np.diag([0.7, 0.7, 1.5]),
}
