"""Tints: the hue that detail has in a photograph."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib.coloring.tints import PER_LIGHTNESS, SHARE, tinted, tints_of
from MedColorLib.coloring.transfer import SliceMatch, TransferParameters, transfer_lab

RNG = np.random.default_rng(0)


def photograph(low: float, high: float, slope=(-0.2, 0.3), noise: float = 3.0, count: int = 20000) -> np.ndarray:
    """(n, 3) L* a* b*: a*, b* on a line of L*, with noise."""
    lightness = RNG.uniform(low, high, count)
    line = np.stack([20 + slope[0] * (lightness - 50), 28 + slope[1] * (lightness - 50)], -1)
    return np.concatenate([lightness[:, None], line + RNG.normal(0, noise, line.shape)], -1)


def change(tints: np.ndarray, told: float, seen: float) -> np.ndarray:
    given = np.float32([[20, 90]])
    return (tinted(tints, given, np.float32([told]), np.float32([seen])) - given)[0]


@pytest.mark.parametrize("slope", [(-0.2, 0.3), (0.1, 0.4), (0.0, 0.0)])
def test_a_line_is_found_again_and_goes_on_beyond_the_photographs_range(slope):
    tints = tints_of([photograph(20, 80, slope)])
    for told, seen in ((50, 62), (50, 35), (70, 95), (30, 5)):
        np.testing.assert_allclose(change(tints, told, seen), SHARE * (seen - told) * np.array(slope), atol=1.5)


def test_a_bend_is_followed():
    dark, light = photograph(10, 50, (0.4, 0.4)), photograph(50, 90, (-0.4, 0.2))
    tints = tints_of([np.concatenate([dark, light])])
    np.testing.assert_allclose(change(tints, 20, 35), SHARE * np.array((6, 6)), atol=1)
    np.testing.assert_allclose(change(tints, 65, 80), SHARE * np.array((-6, 3)), atol=1)


def test_against_a_mean_in_each_level():
    """Where levels are full, the table's differences are those of plain means."""
    lab = photograph(20, 80, noise=1.0, count=200000)
    means = np.array([lab[np.abs(lab[:, 0] - level) < 0.5, 1:].mean(0) for level in (30, 70)])
    np.testing.assert_allclose(change(tints_of([lab]), 30, 70), SHARE * (means[1] - means[0]), atol=0.2)


def test_photographs_count_alike_whatever_their_size():
    small, large = photograph(20, 80, (0.3, 0.3), count=2000), photograph(20, 80, (-0.3, 0.3), count=50000)
    np.testing.assert_allclose(change(tints_of([small, large]), 40, 60), (0, SHARE * 6), atol=0.5)


@pytest.mark.parametrize(
    "lab",
    [
        np.full((1, 3), 40.0),
        np.full((500, 3), (60.0, 10.0, 20.0)),
        np.zeros((0, 3)),
        np.float64([[0, 0, 0], [100, 60, -60]] * 50),
    ],
)
def test_pictures_of_one_colour_or_none_or_two(lab):
    tints = tints_of([lab])
    assert tints.shape == (100 * PER_LIGHTNESS + 1, 2) and tints.dtype == np.float32
    assert np.isfinite(tints).all() and np.abs(np.diff(tints, axis=0)).max() <= 1.001 / PER_LIGHTNESS


def test_lightness_beyond_the_table_takes_its_ends():
    tints = tints_of([photograph(20, 80)])
    np.testing.assert_array_equal(change(tints, 50, 130), change(tints, 50, 100))
    np.testing.assert_array_equal(change(tints, 50, -30), change(tints, 50, 0))


def test_cortex_and_white_matter_of_one_match_differ_in_hue():
    """A scan in two steps whose matches are one colour: the lighter step turns yellow, the darker red, the mean stays."""
    side = 96
    stripes = np.where(np.arange(side) // 4 % 2, 0.6, 0.4) * np.ones((side, 1))
    match = SliceMatch(np.full((side, side, 3), (55.0, 18.0, 27.0)), stripes, np.ones((side, side), bool))
    given = stripes, np.ones((side, side), bool), match
    plain = transfer_lab(*given, TransferParameters("regression", "natural", False))
    tinted = transfer_lab(
        *given, TransferParameters("regression", "natural", False, tints=tints_of([photograph(10, 90)]))
    )
    np.testing.assert_array_equal(plain[..., 0], tinted[..., 0])
    light, dark = (tinted[..., 1:][plain[..., 0] > 57].mean(0), tinted[..., 1:][plain[..., 0] < 53].mean(0))
    assert np.degrees(np.arctan2(light[1], light[0])) > np.degrees(np.arctan2(dark[1], dark[0])) + 4
    np.testing.assert_allclose(tinted[..., 1:].mean((0, 1)), plain[..., 1:].mean((0, 1)), atol=0.5)


def test_nothing_yellow_turns_blue_and_blue_stays():
    tints = tints_of([photograph(10, 90, (-0.2, 0.4))])
    colors, dark, light = np.float32([[10, 8], [10, -8]]), np.float32([20, 20]), np.float32([70, 70])
    assert (
        tinted(tints, colors, light, dark)[0, 1] == pytest.approx(2) and tinted(tints, colors, light, dark)[1, 1] == -8
    )
    assert (tinted(tints, colors, dark, light)[:, 1] > colors[:, 1] + SHARE * 18).all()
