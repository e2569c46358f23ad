"""Blending of neighbouring references: shares along the stack, mixing per pixel, and no seam where the reference changes."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from MedColorLib import Settings, Volume, colorize, make_plan
from MedColorLib.color.lab import srgb_to_lab
from MedColorLib.matching.blending import blended, neighbours
from MedColorLib.matching.confidence import Trust
from MedColorLib.phantom import TISSUES, labels, section


def shares(choice: dict[int, int]) -> dict[int, dict[int, float]]:
    """Slice -> reference -> share."""
    found = neighbours(choice)
    return {
        k: {own: 1 - found[k].share, found[k].index: found[k].share} if k in found else {own: 1.0}
        for k, own in choice.items()
    }


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6))
def test_shares_pass_from_middle_to_middle_in_equal_steps(lengths):
    choice = dict(enumerate(np.repeat(np.arange(len(lengths)), lengths).tolist()))
    by_slice = shares(choice)
    assert all(0 <= share <= 1 for parts in by_slice.values() for share in parts.values())
    assert all(sum(parts.values()) == pytest.approx(1) for parts in by_slice.values())
    middles = np.cumsum(lengths) - (np.array(lengths) + 1) / 2
    for k, parts in by_slice.items():  # the expected level of reference is piecewise linear through the middles
        level = sum(reference * share for reference, share in parts.items())
        assert level == pytest.approx(np.interp(k, middles, np.arange(len(lengths))))


def test_one_reference_has_no_neighbour():
    assert neighbours({3: 2, 4: 2}) == {} and neighbours({}) == {}


def matches(rng, count=3, trust=True):
    labs = rng.uniform(0, 60, (count, 4, 5, 3)).astype(np.float32)
    masks = np.ones((count, 4, 5), bool)
    masks[:, 0] = False
    curve = np.linspace(0, 1, 256)
    trusts = [
        Trust((rng.uniform(0.05, 1, (4, 5)) * m).astype(np.float32), 0.8, curve) if trust else None for m in masks
    ]
    return masks.astype(np.float32), masks, labs, trusts


@pytest.mark.parametrize("trust", [True, False])
def test_a_share_of_nothing_or_all_is_one_of_the_two(rng, trust):
    first, second = matches(rng, trust=trust), matches(rng, trust=trust)
    _, masks, labs, trusts = blended(first, second, np.array([0.0, 1.0, 0.5]))
    inside = masks[0]
    np.testing.assert_allclose(labs[0][inside], first[2][0][inside], rtol=1e-6)
    np.testing.assert_allclose(labs[1][inside], second[2][1][inside], rtol=1e-6)
    low, high = np.minimum(first[2][2], second[2][2]), np.maximum(first[2][2], second[2][2])
    assert (labs[2] >= low - 1e-4).all() and (labs[2] <= high + 1e-4).all()
    if trust:
        np.testing.assert_allclose(trusts[0].confidence, first[3][0].confidence, rtol=1e-6)
        np.testing.assert_allclose(trusts[1].confidence, second[3][1].confidence, rtol=1e-6)
        assert (trusts[2].confidence[~masks[2]] == 0).all()


def test_a_match_that_is_not_trusted_hardly_counts(rng):
    first, second = matches(rng, 1), matches(rng, 1)
    poor = Trust(second[3][0].confidence * 0 + 1e-4 * second[1][0], 0.8, np.linspace(1, 0, 256), monotone=0.0)
    _, _, labs, trusts = blended(first, (*second[:3], [poor]), np.array([0.5]))
    inside = first[1][0]
    np.testing.assert_allclose(labs[0][inside], first[2][0][inside], atol=0.3)
    np.testing.assert_array_equal(trusts[0].inverse_curve, first[3][0].inverse_curve)  # the other's is no function
    assert trusts[0].own_relation_weight == pytest.approx(0.5 * first[3][0].own_relation_weight)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("monotone", [(1.0, 1.0), (0.2, 0.8), (1.0, 0.0), (0.0, 0.0)])
def test_how_far_curves_are_functions_is_mixed_as_well(rng, share, monotone):
    first, second = matches(rng, 1), matches(rng, 1)
    curves = np.linspace(0, 1, 256), np.linspace(0.2, 0.6, 256)
    trusts = [Trust(m[3][0].confidence, 0.8, c, w) for m, c, w in zip((first, second), curves, monotone)]
    (mixed,) = blended((*first[:3], trusts[:1]), (*second[:3], trusts[1:]), np.array([share]))[3]
    assert mixed.monotone == pytest.approx((1 - share) * monotone[0] + share * monotone[1])
    weights = np.array([(1 - share) * monotone[0], share * monotone[1]])
    if weights.sum() > 0:
        np.testing.assert_allclose(mixed.inverse_curve, weights @ np.stack(curves) / weights.sum())
    else:
        assert mixed.own_relation_weight == 0


def tinted_series(strength: float) -> list[np.ndarray]:
    """Eight sections from the feet up, taken in turns in warmer and in cooler light."""
    pictures = []
    for number, level in enumerate(np.linspace(-0.9, 0.8, 8)):
        picture = section(level)
        light = 1 + strength * np.array([1, 0, -1]) * (1 if number % 2 else -1)
        gelatin = (picture[..., 2] > picture[..., 0])[..., None]
        pictures.append(np.where(gelatin, picture, np.clip(picture * light, 0, 255)).astype(np.uint8))
    return pictures


def jumps(result, anatomy) -> tuple[np.ndarray, np.ndarray]:
    """Mean jump of chroma from slice to slice over pixels of the same tissue: at changes of reference, elsewhere."""
    chosen = {int(k): name for k, name in result.report["reference_of_slice"].items()}
    lab = srgb_to_lab(result.rgb / 255.0)
    at_changes, elsewhere = [], []
    for before, after in pairwise(sorted(chosen)):
        same = (anatomy[before] == anatomy[after]) & (anatomy[before] > 0)
        if same.mean() > 0.2:  # the vertex is a handful of pixels
            jump = np.linalg.norm((lab[after] - lab[before])[same].mean(axis=0)[1:])
            (at_changes if chosen[before] != chosen[after] else elsewhere).append(jump)
    return np.array(at_changes), np.array(elsewhere)


@pytest.mark.slow
def test_no_seam_where_the_reference_changes(monkeypatch):
    """Median jump at changes over that elsewhere, measured: 2.0 with blending, 8.5 without; largest 1.5 against 5.7."""
    anatomy = labels((96, 64, 56))
    table = np.array([tissue[0] for tissue in TISSUES.values()], float)
    noise = np.random.default_rng(0).normal(0, 12, anatomy.shape)
    array = np.rint(gaussian_filter(table[anatomy], (0.6, 0.3, 0.3)) + noise).astype(np.int16)
    volume = Volume(array, np.diag([-3.2, -3.2, 2.0, 1.0]))
    settings = Settings(preset="draft", features="embedded", coherence_mm=3.0)  # wider hides the seam by itself
    series = tinted_series(0.08)
    result = colorize(volume, series, settings)
    assert result.report["references_assigned"] == "along the series" and result.report["blended_slices"]
    blended_jumps, elsewhere = jumps(result, anatomy)
    monkeypatch.setattr("MedColorLib.run.engine.neighbours", lambda choice: {})
    plain_jumps, plain_elsewhere = jumps(colorize(volume, series, settings), anatomy)
    assert np.median(plain_jumps) > 5 * np.median(plain_elsewhere)
    assert np.median(blended_jumps) < 3 * np.median(elsewhere)
    assert blended_jumps.max() < 0.4 * plain_jumps.max()


def test_the_plan_says_so(ct):
    small = [cv2.resize(picture, (62, 66), interpolation=cv2.INTER_AREA) for picture in tinted_series(0)]

    def plan(count):
        return make_plan(ct.volume, small[:count], Settings(preset="draft", features="embedded"))

    assert "matched with both" in plan(8).steps["blending"]
    assert "blending" not in plan(3).steps
    assert [e.what for e in plan(3).left_out if "blending" in e.what] == ["blending of neighbouring references"]
    assert not [e for e in plan(8).left_out + plan(1).left_out if "blending" in e.what]
