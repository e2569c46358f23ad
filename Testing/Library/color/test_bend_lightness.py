"""Lightness gives way to chroma: as little as needed, in order, and nothing that fits is touched."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from MedColorLib.color.gamut import bend_lightness, lab_to_srgb_in_gamut
from MedColorLib.color.lab import lab_to_linear, srgb_to_lab

RNG = np.random.default_rng(0)


def outside(lab: np.ndarray) -> np.ndarray:
    linear = lab_to_linear(lab.astype(np.float64))
    return ((linear < -0.003) | (linear > 1.01)).any(-1)


def test_greys_and_dark_colours_stay():
    greys = np.stack([np.linspace(0, 100, 101), np.zeros(101), np.zeros(101)], -1)
    assert bend_lightness(greys)[1] == 0
    np.testing.assert_allclose(bend_lightness(greys)[0], greys, atol=1e-4)
    dark = np.array([[20.0, 15, 15], [40, 20, 10], [50, 10, 30]])
    np.testing.assert_allclose(bend_lightness(dark)[0], dark, atol=1e-4)


def test_chroma_of_lights_is_kept():
    """Cream and flesh at L* 95 to 100, where clipping or drawing in would make them white."""
    lights = np.array(
        [[light, a, b] for light in (95.0, 98.0, 100.0) for a, b in ((5, 25), (15, 20), (0, 35), (20, 10))]
    )
    assert outside(lights).all()
    bent, count = bend_lightness(lights)
    assert count == len(lights)
    assert (bent[:, 0] < lights[:, 0]).all() and (bent[:, 0] > 70).all()
    seen = srgb_to_lab(lab_to_srgb_in_gamut(bent)[0])
    assert np.abs(np.hypot(*seen[:, 1:].T) - np.hypot(*lights[:, 1:].T)).max() < 2.5


@given(a=st.floats(-60, 60), b=st.floats(-60, 60))
def test_order_of_lightness_stays_and_only_falls(a, b):
    lightness = np.linspace(0, 100, 201)
    lab = np.stack([lightness, np.full(201, a), np.full(201, b)], -1)
    bent, _ = bend_lightness(lab)
    assert (np.diff(bent[:, 0]) > -1e-4).all()
    assert (bent[:, 0] <= lightness + 1e-4).all()


def test_few_colours_are_left_that_srgb_lacks_at_the_light_end():
    lab = np.stack([RNG.uniform(60, 100, 4000), RNG.uniform(-5, 35, 4000), RNG.uniform(0, 45, 4000)], -1)
    assert outside(lab).mean() > 0.3
    assert outside(bend_lightness(lab)[0]).mean() < 0.01


def test_nothing_and_any_number():
    assert bend_lightness(np.zeros((0, 3)))[0].shape == (0, 3)
    many = np.tile([[99.0, 10.0, 20.0]], (40_000, 1))
    bent, count = bend_lightness(many)
    assert count == 40_000 and np.ptp(bent[:, 0]) < 1e-3
