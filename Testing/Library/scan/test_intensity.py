"""Intensity: windows and histogram matching against exact arithmetic and the definitions, at every extreme."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from MedColorLib.errors import InputError, SettingsError
from MedColorLib.scan.air import in_hounsfield
from MedColorLib.scan.intensity import (
    AS_SHOWN,
    SOFT_TISSUE_HU,
    SOFT_TISSUE_SHARE,
    Window,
    apply_curve,
    apply_window,
    check_values,
    choose_window,
    finite_sample,
    histogram_match_curve,
    of_hounsfield,
    spreading_curve,
    strided,
)

NAN, INF = float("nan"), float("inf")
numbers = st.floats(allow_nan=False, allow_infinity=False)


def volume(*values, dtype=np.float64) -> np.ndarray:
    return np.array(values, dtype).reshape(1, 1, -1)


class TestCheckValues:
    @pytest.mark.parametrize("values", [(NAN, NAN), (INF, -INF, NAN)])
    def test_nothing_finite(self, values):
        with pytest.raises(InputError, match=r"scan: no voxel has a finite value; check"):
            check_values(volume(*values), "scan")

    @pytest.mark.parametrize("values", [(7, 7, 7), (7.0, NAN, 7.0), (7, INF, 7)])
    def test_constant(self, values):
        with pytest.raises(InputError, match="scan: every voxel has the value 7; there is nothing to colour"):
            check_values(volume(*values), "scan")

    def test_some_not_finite_are_counted_over_all_slices(self):
        values = np.arange(24, dtype=float).reshape(2, 3, 4)
        values[0, 0, 0], values[1, 2, 3], values[1, 0, 0] = NAN, INF, -INF
        assert check_values(values, "scan") == "3 voxels are not finite and are treated as air"

    @pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u8", "i8", "f2", "f4", "f8", "?"])
    def test_sound_values_need_no_word(self, dtype):
        assert check_values(volume(0, 1, 1, dtype=dtype), "scan") is None

    def test_one_slice_without_any_finite_value(self):
        values = np.stack([np.full((2, 2), NAN), np.arange(4.0).reshape(2, 2)])
        assert check_values(values, "scan").startswith("4 voxels")


class TestSamples:
    def test_small_arrays_are_taken_whole(self):
        np.testing.assert_array_equal(strided(np.arange(10, dtype=np.int16)), np.arange(10.0))

    @pytest.mark.parametrize("size", [99, 100, 101, 1000, 4096])
    def test_never_more_than_the_limit_nor_far_less(self, size):
        assert min(size, 33) <= strided(np.zeros(size), limit=100).size <= 100

    def test_stride_does_not_stay_in_one_column(self):
        columns = np.tile(np.arange(64), (64, 64, 1))
        assert set(strided(columns, limit=64**2)) == set(range(64))

    def test_finite_values_only(self):
        np.testing.assert_array_equal(finite_sample(np.array([1, NAN, INF, -INF, 2])), [1, 2])


class TestChooseWindow:
    @pytest.mark.parametrize("given_window", [(5, 5), (6, 5), (NAN, 1), (0, NAN), (-INF, 1), (0, INF)])
    def test_a_given_window_must_be_finite_and_not_empty(self, given_window):
        with pytest.raises(SettingsError, match="window: expected finite LO < HI"):
            choose_window(volume(0, 1), given=given_window)

    def test_given_comes_before_the_file(self):
        assert choose_window(volume(0, 1), given=(-5, 9), proposed=(0, 1)) == Window(-5, 9, "given")

    def test_the_files_window(self, rng):
        values = rng.uniform(0, 100, (2, 9, 9))
        assert choose_window(values, proposed=(20, 80)) == Window(20, 80, "file (DICOM window)")

    @pytest.mark.parametrize("proposed", [(200, 300), (5, 5), (9, 1), (NAN, 3), (0, INF)])
    def test_a_useless_window_of_the_file_is_passed_over(self, proposed, rng):
        chosen = choose_window(rng.uniform(0, 100, (2, 9, 9)), proposed=proposed)
        assert chosen.source.startswith("percentiles")
        assert ("shows next to nothing" in chosen.source) == (proposed == (200, 300))

    def test_percentiles_of_the_body_only(self, rng):
        values = rng.normal(0, 1, (3, 20, 20))
        body = np.zeros(values.shape, bool)
        body[:, 5:15] = True
        values[~body] = 1e6
        window = choose_window(values, body)
        assert (window.low, window.high) == pytest.approx(tuple(np.percentile(values[body], [0.5, 99.5])))

    def test_a_rare_second_value_still_opens_the_window(self):
        values = np.zeros((1, 100, 100))
        values[0, 0, 0] = 7
        window = choose_window(values)
        assert (window.low, window.high) == (0, 7)

    @pytest.mark.parametrize("values", [(3, 3, 3), (3, NAN, INF)])
    def test_a_single_value(self, values):
        with pytest.raises(InputError, match=r"single value 3; give a window"):
            choose_window(volume(*values))

    def test_nothing_finite(self):
        with pytest.raises(InputError, match=r"no finite value; give a window"):
            choose_window(volume(NAN, INF))

    def test_extremes_of_float64(self):
        window = choose_window(volume(-1.7e308, 1.7e308))
        assert -1.7e308 <= window.low < window.high <= 1.7e308


class TestApplyWindow:
    @settings(deadline=None, max_examples=300)
    @given(numbers, numbers, numbers)
    def test_exact_fraction(self, value, end, other):
        low, high = sorted((end, other))
        if not high / 2 - low / 2 > 1e-300:
            return
        exact = (Fraction(value) - Fraction(low)) / (Fraction(high) - Fraction(low))
        got = apply_window(np.array([value]), Window(low, high, ""))
        assert got.dtype == np.float32
        assert abs(float(got[0]) - float(min(max(exact, Fraction(0)), Fraction(1)))) < 1e-7

    @settings(deadline=None)
    @given(st.lists(st.floats(), min_size=2, max_size=9), st.floats(-1e4, 1e4), st.floats(1e-3, 1e4))
    def test_monotone_and_within_0_and_1(self, values, low, width):
        got = apply_window(np.array(values), Window(low, low + width, ""))
        assert ((got >= 0) & (got <= 1)).all()
        order = np.argsort(np.nan_to_num(values, nan=-INF))
        assert (np.diff(got[order]) >= 0).all()

    def test_not_finite(self):
        np.testing.assert_array_equal(apply_window(np.array([NAN, -INF, INF]), Window(-1000, 1000, "")), [0, 0, 1])

    @pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
    def test_limits_of_every_type(self, dtype):
        limits = np.iinfo(dtype) if np.dtype(dtype).kind in "iu" else np.finfo(dtype)
        values = np.array([limits.min, limits.max], dtype)
        before = values.copy()
        np.testing.assert_array_equal(apply_window(values, Window(-100, 100, ""))[1:], [1])
        np.testing.assert_array_equal(apply_window(values, Window(float(limits.min), float(limits.max), "")), [0, 1])
        np.testing.assert_array_equal(values, before)

    def test_metal(self):
        got = apply_window(np.array([-1000, 1000, 30000], np.int16), Window(-1000, 3000, ""))
        np.testing.assert_allclose(got, [0, 0.5, 1])

    def test_no_width_is_a_step(self):
        got = apply_window(np.array([-1, 5, 5.1, INF, NAN]), Window(5, 5, ""))
        np.testing.assert_array_equal(got, [0, 0, 1, 1, 0])


class TestTones:
    """CT in Hounsfield units: soft tissue has room in what is matched, whatever the window shows."""

    @pytest.mark.parametrize(
        ("low", "high"), [(-1000, 1500), (-250, 2000), (-100, 3000), (-2000, 300), (-1e300, 1e300), (500, 900)]
    )
    def test_there_and_back(self, low, high):
        window, grey = of_hounsfield(Window(low, high, "")), np.linspace(0, 1, 2001)
        tones = window.tone(grey)
        assert (tones[0], tones[-1]) == (0, 1) and (np.diff(tones) >= 0).all()
        np.testing.assert_allclose(window.shown(tones), grey, atol=2e-6)

    @pytest.mark.parametrize(("low", "high"), [(-1000, 1500), (-250, 2000), (-100, 3000), (-2000, 300)])
    def test_soft_tissue_has_its_share_and_the_rest_keeps_its_proportions(self, low, high):
        window = of_hounsfield(Window(low, high, ""))
        ends = np.clip(SOFT_TISSUE_HU, low, high)
        below, above = window.tone(apply_window(ends, window))
        assert above - below == pytest.approx(SOFT_TISSUE_SHARE, abs=1e-6)
        assert below * (high - ends[1]) == pytest.approx((1 - above) * (ends[0] - low), abs=1e-3)
        assert window.coarse_noise == pytest.approx(0.6 * 50 / 650)

    @pytest.mark.parametrize(("low", "high"), [(-160, 240), (-400, 500), (500, 900), (-1e300, 1e300)])
    def test_a_window_of_soft_tissue_or_of_none_stays(self, low, high):
        window, grey = of_hounsfield(Window(low, high, "")), np.linspace(0, 1, 11)
        assert window.tone(grey) is grey and window.shown(grey) is grey and "matched" not in window.describe()

    def test_other_scans_are_matched_as_shown(self):
        assert not AS_SHOWN.tones and AS_SHOWN.coarse_noise == 0

    def test_units_are_told(self, ct, mr):
        assert in_hounsfield(ct.volume.array)
        for other in (mr.volume.array, 3 * ct.volume.array, ct.volume.array + 1024, np.zeros((2, 3, 3))):
            assert not in_hounsfield(other)


class TestHistogramMatch:
    @settings(deadline=None, max_examples=50)
    @given(st.lists(st.floats(0, 1), min_size=1, max_size=50), st.lists(st.floats(0, 1), min_size=1, max_size=50))
    def test_monotone_and_within_the_target(self, source, target):
        curve = histogram_match_curve(np.array(source), np.array(target))
        assert curve.shape == (256,) and (np.diff(curve) >= -1e-15).all()
        assert min(target) - 1e-12 <= curve.min() and curve.max() <= max(target) + 1e-12

    def test_gives_the_distribution_of_the_target(self, rng):
        source, target = rng.beta(2, 5, 20000), rng.beta(4, 2, 15000)
        matched = apply_curve(source, histogram_match_curve(source, target))
        levels = np.linspace(0.05, 0.95, 19)
        np.testing.assert_allclose(np.quantile(matched, levels), np.quantile(target, levels), atol=0.01)

    def test_own_distribution_is_kept(self, rng):
        source = rng.beta(2, 5, 20000)
        curve = histogram_match_curve(source, source)
        seen = np.linspace(0.05, 0.7, 50)
        np.testing.assert_allclose(apply_curve(seen, curve), seen, atol=0.005)

    def test_one_level_becomes_the_median(self, rng):
        target = rng.beta(2, 5, 1001)
        curve = histogram_match_curve(np.full(50, 100 / 255), target)
        assert curve[100] == pytest.approx(np.median(target))
        assert np.ptp(histogram_match_curve(rng.random(99), np.full(9, 0.25))) == 0

    def test_nothing_to_match_changes_nothing(self):
        identity = np.linspace(0, 1, 256)
        np.testing.assert_array_equal(histogram_match_curve(np.empty(0), np.ones(3)), identity)
        np.testing.assert_array_equal(histogram_match_curve(np.ones(3), np.empty(0)), identity)


class TestCurves:
    @pytest.mark.parametrize("grey", [np.zeros(0), np.zeros(9), np.ones(9), np.full(9, 0.3), np.linspace(0, 1, 77)])
    def test_spreading_increases_strictly_from_0_to_1(self, grey):
        curve = spreading_curve(grey)
        assert (np.diff(curve) > 1e-3).all() and curve.min() >= 0 and curve.max() <= 1
        np.testing.assert_array_equal(spreading_curve(grey, share=0), np.linspace(0, 1, 256))

    def test_spreading_is_half_identity_and_half_midpoint_of_the_distribution(self):
        curve = spreading_curve(np.repeat([51 / 255, 153 / 255], [30, 10]))
        assert curve[51] == pytest.approx(0.5 * 0.2 + 0.5 * 15 / 40)
        assert curve[153] == pytest.approx(0.5 * 0.6 + 0.5 * 35 / 40)

    def test_spreading_gives_room_to_frequent_levels(self, rng):
        curve = spreading_curve(np.clip(rng.normal(0.5, 0.01, 5000), 0, 1))
        assert apply_curve(np.float64(0.53), curve) - apply_curve(np.float64(0.47), curve) > 0.5

    def test_apply_curve_is_linear_between_its_nodes(self, rng):
        curve, grey = rng.random(256), rng.random((5, 6))
        low = np.floor(grey * 255).astype(int)
        share = grey * 255 - low
        expected = (1 - share) * curve[low] + share * curve[low + 1]
        got = apply_curve(grey, curve)
        assert got.dtype == np.float32 and got.shape == (5, 6)
        np.testing.assert_allclose(got, expected, atol=1e-6)
