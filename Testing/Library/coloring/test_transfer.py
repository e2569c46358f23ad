"""Transfer: the paper's equation by its own words, and what each choice of luminance promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from MedColorLib.color.difference import ciede2000
from MedColorLib.color.gamut import gamma_decode, gamma_encode
from MedColorLib.color.lab import gray_to_lightness, lab_to_srgb, lightness_to_gray, srgb_to_lab
from MedColorLib.coloring.transfer import REMAINDER, SliceMatch, TransferParameters, transfer, transfer_lab
from MedColorLib.filters import FILTERS
from MedColorLib.filters.regression import RegressionParameters, predict, solve, splat
from MedColorLib.matching.confidence import LEAST_TRUST, Trust
from MedColorLib.scan.grid import MARGIN, choose_grid, to_grid
from MedColorLib.scan.intensity import spreading_curve

GRID = choose_grid(64)
INNER = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
SMOOTHERS = ("regression", *FILTERS)
BROWN, CREAM = (140, 90, 70), (222, 196, 150)


def scan(shape=(48, 48), seed=0):
    """Display grey with two tissues and noise, black at one corner; a round body."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
    grey = np.where(rows + 0.5 * cols > 0, 0.65, 0.3) + rng.normal(0, 0.03, shape)
    grey[: shape[0] // 4, : shape[1] // 4] = 0
    return np.clip(grey, 0, 1).astype(np.float32), rows**2 + cols**2 < 0.95


def matched_as(picture_rgb) -> np.ndarray:
    """T' on the grid: a colour everywhere."""
    return np.broadcast_to(srgb_to_lab(np.array(picture_rgb, np.float64) / 255), (64, 64, 3)).copy()


def matched_two(grid_grey) -> np.ndarray:
    return np.where(grid_grey[..., None] > 0.45, matched_as(CREAM), matched_as(BROWN))


def arguments(shape=(48, 48)):
    grey, mask = scan(shape)
    grid_mask = to_grid(mask, GRID) > 0.5
    grid_grey = to_grid(grey * mask, GRID) * grid_mask
    return grey, mask, SliceMatch(matched_two(grid_grey), grid_grey, grid_mask)


def match_of(lab, grey, mask=None) -> SliceMatch:
    """A slice (rows, cols) matched with `lab` on the grid."""
    mask = np.ones(grey.shape, bool) if mask is None else mask
    grid_mask = to_grid(mask, GRID) > 0.5
    return SliceMatch(lab, to_grid(grey * mask, GRID) * grid_mask, grid_mask)


def lightness_of(rgb):
    return srgb_to_lab(rgb)[..., 0]


@pytest.mark.parametrize("gamma", [True, False])
@pytest.mark.parametrize("smoother", SMOOTHERS)
class TestEveryWay:
    @pytest.mark.parametrize("luminance", ["keep", "paper"])
    def test_uint8_black_outside_and_arguments_untouched(self, smoother, luminance, gamma):
        given = arguments((60, 37))
        arrays = (*given[:2], given[2].lab, given[2].grey, given[2].mask)
        before = [values.copy() for values in arrays]
        rgb, clipped, _bent = transfer(*given, TransferParameters(smoother, luminance, gamma))
        assert rgb.shape == (60, 37, 3) and rgb.dtype == np.uint8 and clipped >= 0
        assert not rgb[~given[1]].any() and rgb[given[1]].any(-1).mean() > 0.8
        for now, then in zip(arrays, before):
            np.testing.assert_array_equal(now, then)

    def test_kept_luminance_is_the_scans(self, smoother, gamma):
        given = arguments()
        rgb, _clipped, bent = transfer(*given, TransferParameters(smoother, "keep", gamma))
        inside = given[1]
        change = (lightness_of(rgb) - gray_to_lightness(given[0].astype(np.float64)))[inside]
        assert change.max() < 0.4  # the rounding of three bytes
        assert np.count_nonzero(change < -0.9) <= bent < 0.1 * inside.sum(), (
            "lower only where sRGB holds no such colour"
        )
        black = inside & (given[0] == 0)
        assert black.any() and not rgb[black].any()

    def test_black_scan_stays_black(self, smoother, gamma):
        grey, mask, match = arguments()
        dark = SliceMatch(match.lab, 0 * match.grey, match.mask)
        rgb, *_ = transfer(0 * grey, mask, dark, TransferParameters(smoother, "keep", gamma))
        assert not rgb.any()

    def test_grey_matches_leave_the_scan_grey(self, smoother, gamma):
        grey, mask, _ = arguments()
        parameters = TransferParameters(smoother, "keep", gamma)
        rgb, clipped, _bent = transfer(grey, mask, match_of(matched_as((90, 90, 90)), grey, mask), parameters)
        assert clipped == 0 and np.ptp(rgb, axis=-1).max() == 0
        np.testing.assert_allclose(rgb[mask][:, 0], 255 * grey[mask], atol=0.51)


# Gamma does not keep lightness: with the scan's own kept, the two cannot be alike on both sides of it.
@pytest.mark.parametrize(("luminance", "gamma"), [("keep", False), ("paper", False), ("paper", True)])
@pytest.mark.parametrize("smoother", SMOOTHERS)
def test_a_scan_as_bright_as_its_matches_takes_their_colour(smoother, luminance, gamma):
    mask = np.ones((48, 48), bool)
    power = 0.5 if gamma else 1.0
    encoded = lightness_of(gamma_encode(np.array([BROWN]) / 255, power))
    grey = np.full((48, 48), gamma_decode(lightness_to_gray(encoded), power)[0])
    rgb, *_ = transfer(grey, mask, match_of(matched_as(BROWN), grey), TransferParameters(smoother, luminance, gamma))
    assert np.abs(rgb.astype(int) - BROWN).max() <= 1


def encoded_lab(lab, gamma):
    return srgb_to_lab(gamma_encode(np.clip(lab_to_srgb(lab), 0, 1), 0.5)) if gamma else lab


def decoded_lab(lab, gamma):
    return srgb_to_lab(gamma_decode(np.clip(lab_to_srgb(lab), 0, 1), 0.5)) if gamma else lab


@pytest.mark.parametrize("gamma", [True, False])
@pytest.mark.parametrize("smoother", tuple(FILTERS))
def test_papers_equation_with_both_of_its_solves(smoother, gamma):
    """S(T', T_L) - S(T_Lab, T_L) + T_Lab, word by word, on a slice as large as the grid's inner part."""
    grey, _, _ = arguments()
    mask, match = np.ones_like(grey, bool), match_of(matched_two(to_grid(grey, GRID)), grey)
    scan_lab = np.zeros((*grey.shape, 3))
    scan_lab[..., 0] = gray_to_lightness(gamma_encode(grey.astype(np.float64), 0.5 if gamma else 1))
    reference_lab = encoded_lab(match.lab, gamma)[INNER]

    def smoothed(source):
        guide = 2.55 * scan_lab[..., 0]
        return FILTERS[smoother](source, np.rint(guide) if smoother == "fgs" else guide)  # of 8 bits, as in the paper

    expected = decoded_lab(smoothed(reference_lab) - smoothed(scan_lab) + scan_lab, gamma)
    got = transfer_lab(grey, mask, match, TransferParameters(smoother, "paper", gamma))
    np.testing.assert_allclose(got, expected, atol=0.02)
    kept = transfer_lab(grey, mask, match, TransferParameters(smoother, "keep", gamma))
    if not gamma:
        np.testing.assert_allclose(kept[..., 1:], expected[..., 1:], atol=0.02)
        np.testing.assert_allclose(kept[..., 0], scan_lab[..., 0], atol=1e-6)


def test_same_equation_with_the_regression_for_the_guess():
    """X + S(T' - X), X the regression on each second row and column, S the fast global smoother on means of 2 x 2 pixels."""
    import cv2

    grey, _, _ = arguments()
    match = match_of(matched_two(to_grid(grey, GRID)) + np.random.default_rng(1).normal(0, 3, (64, 64, 3)), grey)
    guide = 255 * grey.astype(np.float64)
    chroma = match.lab[INNER][..., 1:]
    sums = splat(chroma[::2, ::2], guide[::2, ::2], np.ones((24, 24)), RegressionParameters(), every=2)
    model = solve(sums, RegressionParameters())
    guess, coarse_grey = predict(model, guide), grey.reshape(24, 2, 24, 2).mean((1, 3))
    rest = chroma.reshape(24, 2, 24, 2, 2).mean((1, 3)) - predict(model, 255 * coarse_grey)
    lightness = gray_to_lightness(coarse_grey.astype(np.float64))
    expected = guess + cv2.resize(FILTERS["fgs"](rest, 2.55 * lightness, REMAINDER), (48, 48))
    got = transfer_lab(grey, np.ones(grey.shape, bool), match, TransferParameters("regression", "keep", False))
    np.testing.assert_allclose(got[..., 1:], expected, atol=0.02)
    assert np.abs(expected - guess).max() > 0.1


def test_natural_lightness_takes_a_share_of_the_remainder(monkeypatch):
    """Where a grey is one tissue. The less the matches are trusted the less of it: edges lie a little beside the scan's."""
    grey, mask, _ = arguments()
    match = match_of(matched_two(to_grid(grey, GRID)) + np.random.default_rng(1).normal(0, 3, (64, 64, 3)), grey)

    def with_share(share, trust=1.0, luminance="natural"):
        monkeypatch.setattr("MedColorLib.coloring.transfer.OWN_SHARE", share)
        doubtful = replace(match, trust=Trust(match.mask * np.float32(trust), 0.0, None))
        return transfer_lab(grey, mask, doubtful, TransferParameters("regression", luminance, False, one_tissue=1.0))

    none, some, all_of_it = with_share(0.0), with_share(0.7), with_share(1.0)
    for channels in (np.s_[..., :1], np.s_[..., 1:]):
        changes = [np.abs(lab - none)[channels].mean() for lab in (some, all_of_it)]
        assert 0.05 < changes[0] < 0.9 * changes[1]
        assert np.abs(with_share(1.0, 0.5) - with_share(0.0, 0.5))[channels].mean() < 0.5 * changes[1]
    np.testing.assert_array_equal(with_share(0.0, luminance="keep"), with_share(1.0, luminance="keep"))


class TestOutliers:
    """Where few matches can be trusted, a grey takes the colour of most of its matches, not the mean with the wrong ones."""

    def lightness(self, trusted_share: float, wrong: float = 0.3) -> float:
        """L* that cream tissue gets of which a share of `wrong` pixels is matched with brown."""
        rng = np.random.default_rng(3)
        grey = np.full((48, 48), 0.55, np.float32)
        lab = np.where(rng.random((64, 64, 1)) < wrong, matched_as(BROWN), matched_as(CREAM))
        confidence = np.where(rng.random((64, 64)) < trusted_share, 0.7, 0.55).astype(np.float32)
        match = match_of(lab, grey)
        match = replace(match, trust=Trust(confidence * match.mask, 0.0, None))
        mean = regression_of(match)
        return float((mean[..., 0] - matched_as(BROWN)[0, 0, 0]).mean())

    def test_most_decide_where_few_can_be_trusted(self):
        between = matched_as(CREAM)[0, 0, 0] - matched_as(BROWN)[0, 0, 0]
        assert self.lightness(0.3) > 0.85 * between > 0.75 * between > self.lightness(0.7)
        assert self.lightness(0.7) < self.lightness(0.55) < self.lightness(0.5)

    def test_equal_halves_stay_what_they_are(self):
        between = matched_as(CREAM)[0, 0, 0] - matched_as(BROWN)[0, 0, 0]
        assert 0.3 * between < self.lightness(0.3, wrong=0.5) < 0.7 * between

    def test_without_outliers_nothing_changes(self):
        few, many = self.lightness(0.3, wrong=0.0), self.lightness(0.7, wrong=0.0)
        assert few == pytest.approx(many, abs=1e-3)


def regression_of(match: SliceMatch) -> np.ndarray:
    """What place and grey say of L* a* b* at the scan's pixels: (48, 48, 3)."""
    from MedColorLib.coloring.transfer import relation_sums, solve_relation

    parameters = TransferParameters("regression", "natural", False, doubts_outliers=True)
    return predict(solve_relation(relation_sums(match, parameters), parameters), 255 * match.grey[INNER])


class TestTrust:
    """A patch of wrong matches that nobody trusts takes its colour from what is trusted around it."""

    def error(self, smoother, trusted):
        grey = np.full((48, 48), 0.55, np.float32)
        match = match_of(matched_as(BROWN), grey)
        patch = np.s_[26:38, 26:38]
        match.lab[patch] = matched_as((40, 160, 60))[patch]
        confidence = match.mask.astype(np.float32) + LEAST_TRUST
        confidence[patch] = 1 + LEAST_TRUST if trusted else LEAST_TRUST
        match = SliceMatch(match.lab, match.grey, match.mask, Trust(confidence, 0.0, None))
        lab = transfer_lab(grey, np.ones(grey.shape, bool), match, TransferParameters(smoother, "keep", False))
        return np.abs(lab[..., 1:] - matched_as(BROWN)[0, 0, 1:])[20:28, 20:28].mean()

    @pytest.mark.parametrize("smoother", ["regression", "fgs", "domain-transform", "wls"])
    def test_wrong_matches_leave_no_patch(self, smoother):
        assert self.error(smoother, trusted=False) < 0.3 * self.error(smoother, trusted=True)

    @pytest.mark.parametrize("smoother", ["regression", "fgs"])
    def test_no_colour_where_nothing_is_trusted(self, smoother):
        from MedColorLib.coloring.transfer import combine, relation_sums, remainder, solve_relation

        grey, mask, match = arguments()
        parameters = TransferParameters(smoother, "keep", False)
        relation = solve_relation(relation_sums(match, parameters), parameters) if smoother == "regression" else None
        rest = remainder(match, relation, parameters)
        lab = combine(grey, mask, relation, rest, parameters, saturation=0.0)
        assert lab.shape == (np.count_nonzero(mask), 3)
        assert np.abs(lab[:, 1:]).max() == 0 and lab[:, 0].max() > 50


@pytest.mark.parametrize("smoother", SMOOTHERS)
def test_tissues_take_the_colours_of_their_matches(smoother):
    grey, mask, match = arguments()
    rgb, *_ = transfer(grey, mask, match, TransferParameters(smoother, "paper", False))
    lab = srgb_to_lab(rgb)
    rows, cols = np.mgrid[-1:1:48j, -1:1:48j]
    far = mask & (np.abs(rows + 0.5 * cols) > 0.4) & (grey > 0)  # the filters of the paper let colour cross edges
    assert ciede2000(lab, match.lab[INNER])[far].mean() < (6 if smoother == "regression" else 16)
    assert lab[far & (grey > 0.45), 2].mean() > lab[far & (grey <= 0.45), 2].mean() + 2  # cream is the yellower one


def test_gamma_changes_the_result():
    given = arguments()
    on, off = (transfer(*given, TransferParameters("fgs", "paper", gamma))[0].astype(int) for gamma in (True, False))
    assert 1 < np.abs(on - off)[given[1]].mean() < 60


def test_guide_curve_is_for_the_regression_only():
    given = arguments()
    curve = spreading_curve(given[0][given[1]])
    for smoother in SMOOTHERS:
        with_curve = transfer(*given, TransferParameters(smoother, "keep", False, curve))[0]
        without = transfer(*given, TransferParameters(smoother, "keep", False))[0]
        assert (with_curve != without).any() == (smoother == "regression")


def test_lightness_gives_way_to_chroma_and_both_are_counted():
    """Pure red on lights: sRGB holds no such colour at L* above 54."""
    grey, mask, _ = arguments()
    parameters = TransferParameters("regression", "keep", False)
    rgb, clipped, bent = transfer(grey, mask, match_of(matched_as((255, 0, 0)), grey, mask), parameters)
    assert 0 < clipped <= mask.sum() and 0 < bent <= mask.sum()
    own, seen = gray_to_lightness(grey.astype(np.float64))[mask], lightness_of(rgb)[mask]
    assert (seen < own + 0.4).all()
    light = own > 60
    assert srgb_to_lab(rgb)[mask][light][:, 1].min() > 60, "lights keep their red"
    assert np.corrcoef(own[light], seen[light])[0, 1] > 0.8, "and their order"
    assert transfer(grey.clip(0.1), mask, match_of(matched_as((120, 110, 100)), grey, mask), parameters)[1:] == (0, 0)


@pytest.mark.parametrize("smoother", SMOOTHERS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1), (3, 200)])
def test_boxes_of_any_shape(smoother, shape):
    grey, mask = np.full(shape, 0.5, np.float32), np.ones(shape, bool)
    rgb, *_ = transfer(grey, mask, match_of(matched_as(BROWN), grey), TransferParameters(smoother, "keep", True))
    assert rgb.shape == (*shape, 3) and np.abs(lightness_of(rgb) - gray_to_lightness(np.array([0.5]))).max() < 0.4
    assert (rgb[..., 0] > rgb[..., 2]).all()


def test_body_that_the_grid_does_not_show():
    """A body so thin that no pixel of the grid is half covered: no evidence, so grey, and no NaN."""
    grey, mask, match = arguments()
    unseen = SliceMatch(match.lab, match.grey, np.zeros_like(match.mask))
    rgb, clipped, _bent = transfer(grey, mask, unseen, TransferParameters("regression", "keep", False))
    assert clipped == 0 and np.ptp(rgb, axis=-1).max() == 0
