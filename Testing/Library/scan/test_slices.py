"""Slices: the same anatomical order whatever way a volume lies in its file, with nothing copied."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from MedColorLib.scan.slices import slice_order

UP, BACK, LEFT = (0, 0, 1), (0, -1, 0), (-1, 0, 0)  # feet to head, front to back, the patient's right to left, in RAS
STANDING = np.arange(3 * 4 * 5).reshape(3, 4, 5)  # as it should be seen: (feet up, front to back, right to left)
ORIENTATIONS = list(product(permutations((0, 1, 2)), product((1, -1), repeat=3)))


def lying(seen: np.ndarray, axes, signs) -> np.ndarray:
    """The array of a file whose axis n runs along anatomical axis axes[n], forwards (1) or backwards (-1)."""
    rest = tuple(range(3, seen.ndim))
    return np.ascontiguousarray(seen.transpose(*axes, *rest)[tuple(slice(None, None, sign) for sign in signs)])


def geometry(axes, signs, spacing=(0.7, 1.3, 2.9)) -> np.ndarray:
    """IJK to RAS of such a file; columns are i, j, k, the array's axes backwards."""
    directions = [np.multiply((UP, BACK, LEFT)[axis], sign) for axis, sign in zip(axes, signs)]
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(directions[::-1]).T * spacing
    return matrix


def rotation(angles) -> np.ndarray:
    turned = np.eye(3)
    for axis, angle in enumerate(angles):
        a, b = (n for n in range(3) if n != axis)
        step = np.eye(3)
        step[[a, a, b, b], [a, b, a, b]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        turned = turned @ step
    return turned


@pytest.mark.parametrize(("axes", "signs"), ORIENTATIONS)
def test_every_orientation_is_seen_alike_and_put_back(axes, signs):
    array = lying(STANDING, axes, signs)
    order = slice_order(geometry(axes, signs))
    seen = order.view(array)
    np.testing.assert_array_equal(seen, STANDING)
    assert np.shares_memory(seen, array)

    colors = np.stack([STANDING, STANDING + 100, STANDING + 200], -1)
    out = np.zeros((*array.shape, 3), int)
    order.view(out)[:] = colors
    np.testing.assert_array_equal(out, lying(colors, axes, signs))


@pytest.mark.parametrize(("axes", "signs"), ORIENTATIONS[::5])
@pytest.mark.parametrize("region", [((0, 1), (1, 3), (2, 5)), ((0, 9), (0, 9), (1, 2)), ((1, 3), (2, 9), (0, 2))])
def test_ranges_of_the_array_are_found_in_the_view(axes, signs, region):
    array = lying(STANDING, axes, signs)
    order = slice_order(geometry(axes, signs))
    in_array, in_view = np.zeros(array.shape, bool), np.zeros(STANDING.shape, bool)
    in_array[tuple(slice(*r) for r in region)] = True
    in_view[tuple(slice(*r) for r in order.ranges(region, array.shape))] = True
    np.testing.assert_array_equal(order.view(in_array), in_view)


@pytest.mark.parametrize(("axes", "signs"), ORIENTATIONS[::7])
def test_oblique_and_sheared_volumes_take_the_nearest_axes(axes, signs):
    matrix = geometry(axes, signs, spacing=(0.01, 50, 1))
    matrix[:3, :3] = rotation((0.3, -0.25, 0.2)) @ matrix[:3, :3]
    matrix[:3, 0] += 0.2 * matrix[:3, 1] * 0.01 / 50
    np.testing.assert_array_equal(slice_order(matrix).view(lying(STANDING, axes, signs)), STANDING)


@settings(deadline=None)
@given(st.tuples(*[st.floats(-4, 4)] * 3), st.booleans())
def test_any_rotation_gives_each_axis_one_part_and_the_closest_fit(angles, left_handed):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(angles) * (1, 1, -1 if left_handed else 1)
    order = slice_order(matrix)
    assert sorted(order.axes) == [0, 1, 2]
    along = np.array([UP, BACK, LEFT]) @ matrix[:3, :3][:, ::-1]
    fit = [sum(abs(along[part, axis]) for part, axis in enumerate(axes)) for axes in permutations(range(3))]
    chosen = [along[part, axis] for part, axis in enumerate(order.axes)]
    assert sum(map(abs, chosen)) >= max(fit) - 1e-6
    assert all((value < 0) == flip for value, flip in zip(chosen, order.flips) if abs(value) > 1e-9)


def test_acquired_takes_the_array_as_it_lies():
    axes, signs = ORIENTATIONS[21]
    order = slice_order(geometry(axes, signs), "acquired")
    np.testing.assert_array_equal(order.view(STANDING), STANDING)
    assert order.describe() == "slices run along array axis k"


def test_description_names_axis_and_direction():
    assert slice_order(geometry((1, 0, 2), (1, -1, 1))).describe() == "slices run along array axis j, reversed"
