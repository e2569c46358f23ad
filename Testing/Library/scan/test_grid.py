"""Grid: one raster for bodies of any size, and back."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib.scan.grid import MARGIN, choose_grid, continue_outwards, from_grid, to_grid

SIZES = [(1, 1), (1, 300), (300, 1), (2, 3), (47, 53), (80, 80), (331, 17), (640, 480)]
INNER = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]


@pytest.mark.parametrize(("size", "side"), [(1, 48), (48, 48), (49, 64), (64, 64), (160, 160), (250, 256), (256, 256)])
def test_sides_suit_five_layers(size, side):
    grid = choose_grid(size)
    assert (grid.height, grid.width) == (side, side)
    assert grid.inner == (side - 2 * MARGIN, side - 2 * MARGIN)
    assert side % 16 == 0 and side // 16 >= 3


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("channels", [(), (1,), (2,), (3,)])
def test_there_and_back_any_size(size, channels, rng):
    grid = choose_grid(64)
    picture = rng.uniform(2, 5, (*size, *channels))
    before = picture.copy()
    on = to_grid(picture, grid)
    assert on.dtype == np.float32 and on.shape[:2] == (64, 64)
    assert on[INNER].min() > 2 - 1e-5 and on[INNER].max() < 5 + 1e-5
    outside = np.ones((64, 64), bool)
    outside[INNER] = False
    assert not on[outside].any()
    assert on.shape[2:] == channels
    back = from_grid(on, size)
    assert back.shape == (*size, *channels) and back.min() > 2 - 1e-5 and back.max() < 5 + 1e-5
    np.testing.assert_array_equal(picture, before)


@pytest.mark.parametrize("size", SIZES)
def test_constants_stay(size):
    on = to_grid(np.full(size, 7.25), choose_grid(48))
    np.testing.assert_allclose(on[INNER], 7.25, rtol=1e-6)
    np.testing.assert_allclose(from_grid(on, size), 7.25, rtol=1e-6)


def test_larger_pictures_are_averaged_over_areas(rng):
    picture = rng.random((48 * 3, 48 * 2, 3))
    on = to_grid(picture, choose_grid(64))[INNER]
    np.testing.assert_allclose(on, picture.reshape(48, 3, 48, 2, 3).mean((1, 3)), atol=1e-6)


def test_smooth_pictures_come_back():
    rows, cols = np.mgrid[0:1:90j, 0:1:130j]
    picture = np.stack([rows + 2 * cols, np.sin(3 * rows)], -1)
    back = from_grid(to_grid(picture, choose_grid(128)), (90, 130))
    assert np.abs(back - picture).max() < 0.02


def test_mask_keeps_its_share(rng):
    mask = rng.random((201, 333)) < 0.3
    assert to_grid(mask, choose_grid(96))[INNER].mean() == pytest.approx(mask.mean(), abs=1e-3)


def test_one_channel_keeps_its_axis():
    assert from_grid(np.ones((48, 48, 1)), (10, 20)).shape == (10, 20, 1)


def test_continue_outwards_takes_the_nearest_inside(rng):
    values, mask = rng.random((9, 12, 2)), rng.random((9, 12)) < 0.15
    before = values.copy()
    got = continue_outwards(values, mask)
    inside = np.argwhere(mask)
    for row, col in np.ndindex(mask.shape):
        distance = np.hypot(*(inside - (row, col)).T)
        nearest = [tuple(values[tuple(p)]) for p in inside[distance <= distance.min() + 1e-9]]
        assert tuple(got[row, col]) in nearest
    np.testing.assert_array_equal(values, before)
