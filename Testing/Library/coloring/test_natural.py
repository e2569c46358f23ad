"""Natural lightness: the reference's for each tissue, the scan's own detail on it, nothing lost, nothing amplified."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib.coloring.natural import AIR_LIGHTNESS, DETAIL_GAIN, natural_lightness, noise_sigma, without_noise

SHAPE = (120, 96)
RNG = np.random.default_rng(0)
LEFT = np.broadcast_to(np.arange(SHAPE[1]) < SHAPE[1] // 2, SHAPE)
MASK = np.ones(SHAPE, bool)
RIPPLE = np.broadcast_to(4 * np.sin(np.arange(SHAPE[0])[:, None] / 3), SHAPE)


def two_tissues(left: float, right: float) -> np.ndarray:
    return np.where(LEFT, left, right).astype(np.float64)


def natural(own: np.ndarray, reference: np.ndarray, mask: np.ndarray, amount: float) -> np.ndarray:
    """L* in its place, 0 outside the mask."""
    plane = np.zeros(own.shape, np.float32)
    plane[mask], _ = natural_lightness(own, reference[mask], mask, amount)
    return plane


def middle(values: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Values well inside one tissue."""
    far = np.abs(np.arange(SHAPE[1]) - SHAPE[1] // 2) > 12
    return values[side & far]


@pytest.mark.parametrize(("scan", "photograph"), [((40, 70), (80, 30)), ((40, 70), (30, 80)), ((60, 55), (80, 25))])
def test_each_tissue_takes_the_photographs_lightness_and_keeps_its_own_detail(scan, photograph):
    """Whatever the order of the two tissues in the two pictures."""
    own, reference = two_tissues(*scan) + RIPPLE, two_tissues(*photograph)
    got = natural(own, reference, MASK, 1.0)
    for side, wanted in ((LEFT, photograph[0]), (~LEFT, photograph[1])):
        assert abs(middle(got, side).mean() - wanted) < 1
        assert np.corrcoef(middle(got, side), middle(RIPPLE, side))[0, 1] > 0.97
        assert middle(got, side).std() == pytest.approx(DETAIL_GAIN * middle(RIPPLE, side).std(), rel=0.1)


def test_the_slider_goes_from_the_scan_to_the_reference():
    own, reference = two_tissues(40, 70) + RIPPLE, two_tissues(80, 30)
    none, half, whole = (natural(own, reference, MASK, amount) for amount in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(none, own, atol=1e-4)
    np.testing.assert_allclose(half, (none + whole) / 2, atol=1e-3)


def test_air_stays_black_and_the_way_to_tissue_is_steady():
    ramp = np.broadcast_to(np.linspace(0, 2 * AIR_LIGHTNESS, SHAPE[1]), SHAPE).copy()
    got = natural(ramp, np.full(SHAPE, 60.0), MASK, 1.0)
    assert got[:, 0].max() < 5
    assert np.diff(got.mean(0)).min() > -0.5


def test_noise_is_not_amplified_within_a_tissue():
    own = 50 + RNG.normal(0, 2, SHAPE)
    got = natural(own, np.full(SHAPE, 70.0), MASK, 1.0)
    assert got.std() < own.std()


def test_what_lies_outside_the_body_has_no_say():
    own, reference = two_tissues(40, 70), two_tissues(80, 30)
    inside = LEFT.copy()
    changed = np.where(inside, own, 0.0)
    got = natural(changed, reference, inside, 1.0)
    assert abs(middle(got, LEFT) - 80).max() < 1


def test_noise_goes_and_edges_stay():
    edge = np.where(LEFT, 0.3, 0.6)
    noisy = edge + RNG.normal(0, 0.005, SHAPE)
    smooth = without_noise(noisy)
    assert (middle(smooth, LEFT) - 0.3).std() < 0.5 * (middle(noisy, LEFT) - 0.3).std()
    assert np.abs(smooth - edge).max() < 0.05


@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.04])
def test_noise_is_measured_beside_edges_and_air(sigma):
    grey = np.full((120, 120), 0.3, np.float32)
    grey[:, 40:44] = grey[60:] = 0.8
    grey += np.random.default_rng(5).normal(0, 1, grey.shape).astype(np.float32) * sigma
    grey[:, 90:] = 0
    assert noise_sigma(grey) == pytest.approx(sigma, rel=0.1, abs=1e-4)
    assert noise_sigma(np.zeros((9, 9), np.float32)) == 0


def test_much_noise_is_smoothed_as_well_as_little():
    """No specks: what is left of the noise, as a share of it."""
    left = []
    for sigma in (0.01, 0.04):
        noise = np.random.default_rng(6).normal(0, sigma, (80, 80)).astype(np.float32)
        left.append(float((without_noise(0.5 + noise) - 0.5)[4:-4, 4:-4].std() / sigma))
    assert max(left) < 0.35 and left[1] == pytest.approx(left[0], rel=0.15)


def test_coarse_noise_of_ct_is_smoothed_where_it_may_be_and_edges_stay():
    """Noise as a kernel leaves it, two pixels wide; an edge as between fat and muscle."""
    from scipy.ndimage import gaussian_filter

    noise = gaussian_filter(np.random.default_rng(7).normal(0, 1, (80, 80)), 0.7)
    noise *= 0.02 / noise.std()
    edge = np.where(np.arange(80) < 40, 0.40, 0.54).astype(np.float32)
    picture = (edge + noise).astype(np.float32)
    fine, coarse = without_noise(picture), without_noise(picture, 0.046)
    left = [float((smooth - edge)[4:-4, 4:30].std()) for smooth in (fine, coarse)]
    assert left[1] < 0.75 * left[0]
    assert coarse[:, 45:50].mean() - coarse[:, 30:35].mean() > 0.13
    np.testing.assert_array_equal(without_noise(picture, 1e-4), fine)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (3, 2)])
def test_any_shape(shape):
    got = natural(np.full(shape, 50.0), np.full(shape, 70.0), np.ones(shape, bool), 1.0)
    assert got.shape == shape and np.isfinite(got).all()
    assert (
        np.isfinite(without_noise(np.full(shape, 0.5))).all() and np.isfinite(without_noise(np.eye(*shape), 1.0)).all()
    )
