"""Contrast: an inverted scan is recognised as such, and without evidence the histogram match stays."""

from __future__ import annotations

import math

import numpy as np
import pytest

from MedColorLib.matching.contrast import Contrast, coarse_luminance, match_contrast, regression_curve
from MedColorLib.phantom import section
from MedColorLib.references.photograph import on_grid, prepare_reference
from MedColorLib.scan.grid import choose_grid
from MedColorLib.scan.intensity import histogram_match_curve


@pytest.fixture(scope="module")
def reference():
    """Grey and mask (96, 96) of the phantom's section."""
    grey, _, mask = on_grid(prepare_reference(section()), choose_grid(96))
    return grey, mask


def seen_as(remap, reference):
    grey, mask = reference
    return (remap(grey) * mask)[None].astype(np.float32), mask[None]


def agreement(reference):
    """A network that sees contrast: correlation with the reference where target and reference lie alike."""
    grey, mask = reference
    return lambda greys: float(np.corrcoef(greys[0][mask], grey[mask])[0, 1])


def levels(greys, masks):
    """The middle of the distribution: where a curve is known."""
    return np.quantile(greys[masks], [0.1, 0.3, 0.5, 0.7, 0.9])


def at(curve, grey):
    return np.interp(grey, np.linspace(0, 1, len(curve)), curve)


class TestMatchContrast:
    def test_an_inverted_scan_gets_a_decreasing_curve(self, reference):
        greys, masks = seen_as(lambda g: 1 - g, reference)
        contrast = match_contrast(greys, masks, *reference, agreement(reference))
        middle = levels(greys, masks)
        assert contrast.kind == "learned from a coarse correspondence" and contrast.gain > 1
        assert (np.diff(at(contrast.curve, middle)) < 0).all()
        np.testing.assert_allclose(at(contrast.curve, middle), 1 - middle, atol=0.05)
        assert contrast.trust == 1

    def test_the_same_contrast_keeps_the_histogram_match(self, reference):
        greys, masks = seen_as(lambda g: g, reference)
        contrast = match_contrast(greys, masks, *reference, agreement(reference))
        assert contrast.kind == "histogram match" and contrast.explained > 0.5
        middle = levels(greys, masks)
        np.testing.assert_allclose(at(contrast.curve, middle), middle, atol=0.02)

    def test_noise_is_no_evidence(self, reference, rng):
        greys, masks = seen_as(lambda g: rng.random(g.shape), reference)
        called = []
        contrast = match_contrast(greys, masks, *reference, called.append)
        assert contrast.kind == "histogram match" and contrast.explained < 0.1 and contrast.trust == 0
        expected = histogram_match_curve(greys[masks], reference[0][reference[1]])
        np.testing.assert_array_equal(contrast.curve, expected)
        assert not called  # the network is not asked for nothing

    @pytest.mark.parametrize("gain", [0.0, -0.5])
    def test_a_learned_curve_must_help_the_network(self, reference, gain):
        greys, masks = seen_as(lambda g: 1 - g, reference)
        answers = iter((0.5 + gain, 0.5))
        contrast = match_contrast(greys, masks, *reference, lambda _: next(answers))
        assert contrast.kind == "histogram match" and contrast.gain == pytest.approx(gain)

    def test_a_constant_scan(self, reference):
        greys, masks = seen_as(lambda g: np.full_like(g, 0.4), reference)
        contrast = match_contrast(greys, masks, *reference, agreement(reference))
        assert contrast.kind == "histogram match" and np.isfinite(contrast.curve).all()

    def test_arguments_are_not_altered(self, reference):
        greys, masks = seen_as(lambda g: 1 - g, reference)
        before = greys.copy(), masks.copy(), reference[0].copy()
        match_contrast(greys, masks, *reference, agreement(reference))
        for now, then in zip((greys, masks, reference[0]), before):
            np.testing.assert_array_equal(now, then)

    @pytest.mark.parametrize(("explained", "trust"), [(0, 0), (0.1, 0), (0.2, 0.5), (0.3, 1), (0.9, 1)])
    def test_trust(self, explained, trust):
        contrast = Contrast(np.zeros(256), "histogram match", explained, 0)
        assert contrast.trust == pytest.approx(trust)
        assert f"{100 * explained:.0f} %" in contrast.describe()


class TestCoarseLuminance:
    @pytest.mark.parametrize("remap", [lambda g: g, lambda g: 1 - g], ids=["as it is", "inverted"])
    def test_sees_the_reference_whatever_the_contrast(self, reference, remap):
        greys, masks = seen_as(remap, reference)
        seen = coarse_luminance(greys, masks, *reference)
        assert seen.shape == greys.shape
        assert np.corrcoef(seen[masks], reference[0][reference[1]])[0, 1] > 0.8


class TestRegressionCurve:
    def test_follows_its_definition(self, rng):
        grey = rng.beta(2, 3, 400)
        seen = np.sin(5 * grey) + rng.normal(0, 0.2, 400)
        curve = regression_curve(grey, seen)
        level = np.rint(grey * 31)
        for node in (3, 10, 17, 24):
            weight = np.array([math.exp(-((b - node) ** 2) / (2 * 1.2**2)) if abs(b - node) <= 5 else 0 for b in level])
            assert at(curve, node / 31) == pytest.approx((weight * seen).sum() / weight.sum(), abs=5e-3)

    def test_recovers_a_function_that_is_not_monotone(self, rng):
        grey = rng.random(20000)
        curve = regression_curve(grey, (grey - 0.4) ** 2 + rng.normal(0, 0.3, grey.size))
        inner = np.linspace(0.1, 0.9, 50)
        np.testing.assert_allclose(at(curve, inner), (inner - 0.4) ** 2, atol=0.03)

    def test_empty_levels_are_interpolated(self):
        curve = regression_curve(np.repeat([0.0, 1.0], 50), np.repeat([0.2, 0.8], 50))
        assert np.isfinite(curve).all() and (np.diff(curve) >= -1e-9).all()
        assert curve[0] == pytest.approx(0.2) and curve[-1] == pytest.approx(0.8)

    def test_one_level(self):
        np.testing.assert_allclose(regression_curve(np.full(9, 0.5), np.full(9, 0.3)), 0.3)
