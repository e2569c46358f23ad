"""Local regression: colour as a function of grey in a neighbourhood, checked on functions that are known."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib.errors import SettingsError
from MedColorLib.filters.regression import RegressionParameters, fit, predict, smooth, splat

DEFAULT = RegressionParameters()
SIZES = [(1, 1), (1, 7), (9, 1), (2, 2), (5, 40), (40, 33), (64, 64)]


def ramp(height=64, width=64) -> np.ndarray:
    """Every grey in every neighbourhood: 0..255 in stripes of 16 pixels."""
    return np.tile(np.linspace(0, 255, 16), (height, -(-width // 16)))[:, :width]


def everywhere(guide) -> np.ndarray:
    return np.ones(guide.shape, np.float32)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("value", [0.0, -37.5, 1e4])
def test_constants_stay(size, value, rng):
    got = smooth(np.full((*size, 2), value), rng.uniform(0, 255, size))
    assert got.shape == (*size, 2) and got.dtype == np.float32
    np.testing.assert_allclose(got, value, rtol=1e-5)


@pytest.mark.parametrize("size", SIZES)
def test_within_the_range_of_each_channel(size, rng):
    source = rng.normal(0, 20, (*size, 3))
    got = smooth(source, rng.uniform(0, 255, size))
    assert np.isfinite(got).all()
    slack = 1e-4 * np.abs(source).max()
    assert (got.min((0, 1)) >= source.min((0, 1)) - slack).all()
    assert (got.max((0, 1)) <= source.max((0, 1)) + slack).all()


def test_linear_in_the_source(rng):
    guide = rng.uniform(0, 255, (40, 33))
    a, b = rng.normal(0, 20, (2, 40, 33, 2))
    np.testing.assert_allclose(smooth(2 * a - 3 * b, guide), 2 * smooth(a, guide) - 3 * smooth(b, guide), atol=1e-3)


def test_channels_do_not_mix(rng):
    guide, source = rng.uniform(0, 255, (24, 31)), rng.normal(0, 20, (24, 31, 3))
    together = smooth(source, guide)
    for c in range(3):
        np.testing.assert_allclose(together[..., c], smooth(source[..., c : c + 1], guide)[..., 0], atol=1e-5)


def test_arguments_are_not_altered(rng):
    source, guide = rng.normal(0, 20, (20, 20, 2)), rng.uniform(-5, 260, (20, 20))
    weight = everywhere(guide)
    before = source.copy(), guide.copy(), weight.copy()
    predict(fit(source, guide, weight, DEFAULT), guide)
    for now, then in zip((source, guide, weight), before):
        np.testing.assert_array_equal(now, then)


def test_a_function_of_grey_is_recovered():
    guide = ramp()
    source = np.stack([guide / 5 - 20, 30 * np.sin(guide / 60), (guide / 255 - 0.4) ** 2 * 100], -1)
    inner = (guide > 30) & (guide < 225)  # the ends of the grid see one side only
    assert np.abs(smooth(source, guide) - source)[inner].mean(0).max() < 1.5


def test_two_functions_in_two_regions_are_kept_apart():
    guide = ramp(64, 128)
    left = np.arange(128) < 64
    source = np.where(left[None, :, None], (guide / 5 - 20)[..., None], (40 - guide / 4)[..., None])
    error = np.abs(smooth(source, guide) - source)[..., 0]
    far = np.abs(np.arange(128) - 64) > 24
    assert error[:, far].mean() < 2.5
    one_for_all = np.abs(source - (guide / 5 - 20 + 40 - guide / 4)[..., None] / 2)[..., 0]
    assert error[:, far].mean() < 0.25 * one_for_all[:, far].mean()


def test_edges_of_the_guide_are_edges_of_the_result():
    guide = np.full((48, 48), 60.0)
    guide[:, 25:] = 190
    source = np.where(guide > 100, 30.0, -30.0)[..., None]
    got = smooth(source, guide)[..., 0]
    assert got[:, 25:].min() > 28 and got[:, :25].max() < -28


def test_single_wrong_matches_are_outvoted(rng):
    guide = ramp()
    source = (guide / 5 - 20)[..., None]
    wrong = np.where(rng.random(guide.shape) < 0.05, 100.0, source[..., 0])[..., None]
    assert np.abs(smooth(wrong, guide) - smooth(source, guide)).mean() < 8  # the mean of the damage itself is 5


class TestWeights:
    def test_pixels_without_weight_do_not_count(self, rng):
        guide, weight = rng.uniform(0, 255, (40, 40)), (rng.random((40, 40)) < 0.5).astype(np.float32)
        source = rng.normal(0, 20, (40, 40, 2))
        poisoned = np.where(weight[..., None] > 0, source, np.nan)
        np.testing.assert_array_equal(fit(source, guide, weight, DEFAULT), fit(poisoned, guide, weight, DEFAULT))

    def test_a_region_without_weight_takes_the_colours_of_the_rest(self):
        guide = ramp()
        source = (guide / 5 - 20)[..., None]
        weight = everywhere(guide)
        weight[:, 32:] = 0
        got = predict(fit(source, guide, weight, DEFAULT), guide)
        inner = (guide > 30) & (guide < 225)
        assert np.abs(got - source)[inner].mean() < 2

    def test_no_weight_at_all_is_no_colour(self):
        guide = ramp(16, 16)
        model = fit(np.ones((16, 16, 2)), guide, 0 * everywhere(guide), DEFAULT)
        assert np.isfinite(model).all() and not model.any()

    def test_one_pixel_of_weight_colours_everything(self):
        guide = ramp()
        weight = 0 * everywhere(guide)
        weight[20, 30] = 1
        source = np.zeros((64, 64, 1))
        source[20, 30] = 17
        np.testing.assert_allclose(predict(fit(source, guide, weight, DEFAULT), guide), 17, rtol=1e-4)


class TestSplat:
    def test_sums_are_kept(self, rng):
        guide, weight = rng.uniform(-10, 270, (37, 22)), rng.random((37, 22)).astype(np.float32)
        source = rng.normal(3, 20, (37, 22, 2))
        total = splat(source, guide, weight, DEFAULT).astype(np.float64).sum((0, 1, 2))
        assert total[2] == pytest.approx(weight.sum(), rel=1e-5)
        np.testing.assert_allclose(total[:2], (source * weight[..., None]).sum((0, 1)), rtol=1e-4, atol=1e-2)

    def test_evidence_adds_up(self, rng):
        guide, weight = rng.uniform(0, 255, (30, 30)), rng.random((30, 30)).astype(np.float32)
        source = rng.normal(0, 20, (30, 30, 2))
        parts = splat(source, guide, weight, DEFAULT) + splat(source, guide, 2 * weight, DEFAULT)
        np.testing.assert_allclose(parts, splat(source, guide, 3 * weight, DEFAULT), rtol=1e-4, atol=1e-3)

    def test_a_pixel_goes_to_its_neighbourhood_and_grey(self):
        guide = np.full((64, 64), 255.0)
        weight = 0 * everywhere(guide)
        weight[0, 63] = 1
        counts = splat(np.zeros((64, 64, 1)), guide, weight, DEFAULT)[..., -1]
        rows, cols, bins = np.nonzero(counts)
        assert set(rows) == {0, 1} and set(cols) == {counts.shape[1] - 2, counts.shape[1] - 1}
        assert set(bins) == {DEFAULT.bins - 1}


class TestOtherSizes:
    @pytest.mark.parametrize("size", [(1, 1), (1, 50), (20, 30), (200, 150)])
    def test_read_at_any_size(self, size):
        guide = ramp()
        model = fit(np.stack([guide / 5, 20 - guide / 5], -1), guide, everywhere(guide), DEFAULT)
        got = predict(model, np.full(size, 128.0))
        assert got.shape == (*size, 2) and got.dtype == np.float32
        np.testing.assert_allclose(got, np.broadcast_to((25.6, -5.6), got.shape), atol=1.5)

    def test_places_stay_in_place(self):
        rows = np.linspace(-40, 40, 64)[:, None, None] * np.ones((1, 64, 1))
        model = fit(rows, np.full((64, 64), 100.0), np.ones((64, 64), np.float32), DEFAULT)
        fine = predict(model, np.full((128, 96), 100.0))[..., 0]
        expected = np.linspace(-40, 40, 128)
        assert np.abs(fine.mean(1) - expected)[20:-20].max() < 3.5 and np.ptp(fine, axis=1).max() < 1

    def test_grey_beyond_0_and_255_counts_as_the_end(self):
        guide = ramp()
        model = fit(guide[..., None], guide, everywhere(guide), DEFAULT)
        np.testing.assert_array_equal(predict(model, guide - 1000), predict(model, 0 * guide))
        np.testing.assert_array_equal(predict(model, guide + 1000), predict(model, 0 * guide + 255))


@pytest.mark.parametrize(
    "wrong",
    [{"cell_px": 0.5}, {"bins": 1}, {"bins": 2.5}, {"support_px": 0}, {"levels": -1}, {"cell_px": float("nan")}],
)
def test_wrong_parameters(wrong):
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        RegressionParameters(**wrong)


class TestSums:
    def test_every_point_goes_to_the_eight_cells_around_it(self, rng):
        """Point by point, corner by corner."""
        parameters = RegressionParameters(cell_px=4, bins=5)
        source, guide, weight = rng.normal(0, 20, (9, 13, 2)), rng.uniform(0, 255, (9, 13)), rng.uniform(0, 1, (9, 13))
        weight[2:4] = 0
        got = splat(source, guide, weight, parameters)
        expected = np.zeros(got.shape)
        rows, cols, bins = got.shape[:3]
        for j, i in np.ndindex(guide.shape):
            at = [0.5 + (j + 0.5) / 9 * (rows - 2), 0.5 + (i + 0.5) / 13 * (cols - 2), guide[j, i] / 255 * (bins - 1)]
            for corner in np.ndindex(2, 2, 2):
                cell = [min(int(a), n - 2) + c for a, n, c in zip(at, (rows, cols, bins), corner)]
                share = np.prod([1 - abs(a - c) for a, c in zip(at, cell)])
                expected[tuple(cell)] += share * weight[j, i] * np.array([*source[j, i], 1])
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)

    def test_each_second_row_and_column_counts_for_four(self, rng):
        source, guide = rng.normal(0, 20, (24, 32, 2)), rng.uniform(0, 255, (24, 32))
        kept = np.zeros((24, 32))
        kept[::2, ::2] = 4
        got = splat(source[::2, ::2], guide[::2, ::2], np.ones((12, 16)), DEFAULT, every=2)
        np.testing.assert_allclose(got, splat(source, guide, kept, DEFAULT), rtol=1e-5, atol=1e-5)

    def test_nothing_that_counts(self):
        assert not splat(np.ones((8, 8, 2)), np.ones((8, 8)), np.zeros((8, 8)), DEFAULT).any()


@pytest.mark.parametrize("support_px", [1e-300, 1e-12, 1e9])
def test_support_beyond_float32_leaves_no_cell_undefined(support_px, rng):
    source, guide = rng.normal(0, 20, (40, 33, 2)), rng.uniform(0, 255, (40, 33))
    got = smooth(source, guide, RegressionParameters(support_px=support_px))
    assert np.isfinite(got).all() and np.abs(got).max() <= np.abs(source).max()
