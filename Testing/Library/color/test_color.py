"""Colour conversions, the gamut and colour differences against definitions and published numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from MedColorLib.color import (
    cie76,
    ciede2000,
    gamma_decode,
    gamma_encode,
    gray_to_lightness,
    lab_to_srgb,
    lab_to_srgb_in_gamut,
    lab_to_xyz,
    lightness_to_gray,
    linear_to_srgb,
    linear_to_xyz,
    srgb_to_lab,
    srgb_to_linear,
    xyz_to_lab,
    xyz_to_linear,
)
from MedColorLib.errors import InputError, SettingsError

# Sharma, Wu, Dalal 2005, table 1: L*, a*, b* of both colours, and CIEDE2000.
SHARMA = """
50 2.6772 -79.7751   50 0 -82.7485   2.0425
50 3.1571 -77.2803   50 0 -82.7485   2.8615
50 2.8361 -74.0200   50 0 -82.7485   3.4412
50 -1.3802 -84.2814   50 0 -82.7485   1.0000
50 -1.1848 -84.8006   50 0 -82.7485   1.0000
50 -0.9009 -85.5211   50 0 -82.7485   1.0000
50 0 0   50 -1 2   2.3669
50 -1 2   50 0 0   2.3669
50 2.4900 -0.0010   50 -2.4900 0.0009   7.1792
50 2.4900 -0.0010   50 -2.4900 0.0010   7.1792
50 2.4900 -0.0010   50 -2.4900 0.0011   7.2195
50 2.4900 -0.0010   50 -2.4900 0.0012   7.2195
50 -0.0010 2.4900   50 0.0009 -2.4900   4.8045
50 -0.0010 2.4900   50 0.0010 -2.4900   4.8045
50 -0.0010 2.4900   50 0.0011 -2.4900   4.7461
50 2.5 0   50 0 -2.5   4.3065
50 2.5 0   73 25 -18   27.1492
50 2.5 0   61 -5 29   22.8977
50 2.5 0   56 -27 -3   31.9030
50 2.5 0   58 24 15   19.4535
50 2.5 0   50 3.1736 0.5854   1.0000
50 2.5 0   50 3.2972 0   1.0000
50 2.5 0   50 1.8634 0.5757   1.0000
50 2.5 0   50 3.2592 0.3350   1.0000
60.2574 -34.0099 36.2677   60.4626 -34.1751 39.4387   1.2644
63.0109 -31.0961 -5.8663   62.8187 -29.7946 -4.0864   1.2630
61.2901 3.7196 -5.3901   61.4292 2.2480 -4.9620   1.8731
35.0831 -44.1164 3.7933   35.0232 -40.0716 1.5901   1.8645
22.7233 20.0904 -46.6940   23.0331 14.9730 -42.5619   2.0373
36.4612 47.8580 18.3852   36.2715 50.5065 21.2231   1.4146
90.8027 -2.0831 1.4410   91.1528 -1.6435 0.0447   1.4441
90.9257 -0.5406 -0.9208   88.6381 -0.8985 -0.7239   1.5381
6.7747 -0.2908 -2.4247   5.8714 -0.0985 -2.2286   0.6377
2.0776 0.0795 -1.1350   0.9033 -0.0636 -0.5514   0.9082
"""


def slow_ciede2000(one, two):
    """One pair in scalar arithmetic, hues as complex numbers: no angle is ever wrapped by hand."""
    (l1, a1, b1), (l2, a2, b2) = one, two
    mean = (math.hypot(a1, b1) + math.hypot(a2, b2)) / 2
    g = 0.5 * (1 - math.sqrt(mean**7 / (mean**7 + 25**7)))
    z1, z2 = complex((1 + g) * a1, b1), complex((1 + g) * a2, b2)
    c1, c2 = abs(z1), abs(z2)
    turn = z2 * z1.conjugate()
    angle = math.atan2(turn.imag, turn.real) if c1 * c2 else 0.0
    dh = 2 * math.sqrt(c1 * c2) * math.sin(angle / 2)
    middle = z1 / c1 + z2 / c2 if c1 * c2 else z1 + z2
    hue = math.degrees(math.atan2(middle.imag, middle.real)) % 360
    t = 1 - 0.17 * math.cos(math.radians(hue - 30)) + 0.24 * math.cos(math.radians(2 * hue))
    t += 0.32 * math.cos(math.radians(3 * hue + 6)) - 0.2 * math.cos(math.radians(4 * hue - 63))
    c, bow = (c1 + c2) / 2, ((l1 + l2) / 2 - 50) ** 2
    dl, dc = (l2 - l1) / (1 + 0.015 * bow / math.sqrt(20 + bow)), (c2 - c1) / (1 + 0.045 * c)
    dh /= 1 + 0.015 * c * t
    r = 2 * math.sqrt(c**7 / (c**7 + 25**7)) * math.sin(math.radians(60 * math.exp(-(((hue - 275) / 25) ** 2))))
    return math.sqrt(dl**2 + dc**2 + dh**2 - r * dc * dh)


def test_ciede2000_on_the_published_pairs():
    pairs = np.array([line.split() for line in SHARMA.split("\n") if line], float)
    assert pairs.shape == (34, 7)
    np.testing.assert_allclose(ciede2000(pairs[:, :3], pairs[:, 3:6]), pairs[:, 6], atol=1e-4)
    np.testing.assert_allclose(ciede2000(pairs[:, 3:6], pairs[:, :3]), pairs[:, 6], atol=1e-4)


def test_ciede2000_against_scalar_arithmetic():
    rng = np.random.default_rng(0)
    one = rng.uniform([0, -100, -100], [100, 100, 100], (3000, 3))
    two = rng.uniform([0, -100, -100], [100, 100, 100], (3000, 3))
    two[::2] = one[::2] + rng.normal(0, 2, (1500, 3))
    one[::7, 1:], two[::11, 1:] = 0, 0
    expected = [slow_ciede2000(a, b) for a, b in zip(one, two)]
    np.testing.assert_allclose(ciede2000(one, two), expected, atol=1e-10)


def test_differences_of_equal_colours_shapes_and_errors():
    rng = np.random.default_rng(1)
    lab = rng.uniform([0, -100, -100], [100, 100, 100], (5, 6, 3))
    assert ciede2000(lab, lab).max() == 0 and cie76(lab, lab).max() == 0
    assert ciede2000(lab, lab[0, 0]).shape == cie76(lab, lab[0, 0]).shape == (5, 6)
    assert cie76([50, 3, 4], [50, 0, 0]) == 5
    for function in (ciede2000, cie76):
        with pytest.raises(InputError):
            function(lab[..., :2], lab[..., :2])


def test_primaries_and_white():
    """CIE's definition worked out by hand for the sRGB primaries: cube roots of the matrix entries over the white."""
    matrix = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    for channel in range(3):
        x, y, z = ((row[channel] / sum(row)) ** (1 / 3) for row in matrix)
        expected = [116 * y - 16, 500 * (x - y), 200 * (y - z)]
        np.testing.assert_allclose(srgb_to_lab(np.eye(3)[channel]), expected, atol=1e-9)
    np.testing.assert_allclose(srgb_to_lab(np.ones(3)), [100, 0, 0], atol=1e-12)
    np.testing.assert_allclose(srgb_to_lab(np.zeros(3)), [0, 0, 0], atol=1e-12)


def test_gray_stays_gray():
    gray = np.linspace(0, 1, 4097)
    lab = srgb_to_lab(np.repeat(gray[:, None], 3, 1))
    assert np.abs(lab[:, 1:]).max() < 1e-12
    np.testing.assert_allclose(gray_to_lightness(gray), lab[:, 0], atol=1e-12)
    np.testing.assert_allclose(lightness_to_gray(lab[:, 0]), gray, atol=1e-14)
    assert (np.diff(lab[:, 0]) > 0).all()
    as_torch = srgb_to_lab(torch.from_numpy(np.repeat(gray[:, None], 3, 1)))
    assert float(as_torch[:, 1:].abs().max()) < 1e-12


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-13), (np.float32, 3e-5)])
@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_round_trips(dtype, tolerance, kind):
    rng = np.random.default_rng(2)
    srgb = rng.uniform(-0.2, 1.2, (20000, 3)).astype(dtype)
    srgb[:5000] *= 0.05  # both straight pieces
    srgb[5000:20000] = np.linspace(0.04044, 0.04046, 45000).reshape(-1, 3)  # sRGB's knee
    colours = srgb if kind == "numpy" else torch.from_numpy(srgb)
    for there, back in (
        (srgb_to_lab, lab_to_srgb),
        (srgb_to_linear, linear_to_srgb),
        (linear_to_xyz, xyz_to_linear),
        (gray_to_lightness, lightness_to_gray),
    ):
        again = back(there(colours))
        assert type(again) is type(colours) and again.dtype == colours.dtype
        np.testing.assert_allclose(np.asarray(again), srgb, atol=tolerance)
    xyz = linear_to_xyz(srgb_to_linear(colours))
    np.testing.assert_allclose(np.asarray(lab_to_xyz(xyz_to_lab(xyz))), np.asarray(xyz), atol=tolerance)


@pytest.mark.parametrize("function", [srgb_to_linear, linear_to_srgb, gray_to_lightness, lightness_to_gray])
def test_curves_are_continuous_and_increasing_through_zero_and_their_knees(function):
    top = 100.0 if function is lightness_to_gray else 1.0
    x = np.linspace(-0.1, 1.0, 200_001) * top
    y = function(x)
    steps = np.diff(y)
    assert np.isfinite(y).all() and (steps > 0).all()
    assert steps.max() < 20 * steps.min() + 1e-3 * (y[-1] - y[0])
    if function is not lightness_to_gray:
        assert abs(float(function(np.zeros(1))[0])) < 1e-14


def test_bytes():
    bytes_ = np.arange(256, dtype=np.uint8)
    floats = bytes_ / 255.0
    np.testing.assert_allclose(srgb_to_linear(bytes_), srgb_to_linear(floats), rtol=1e-6)
    np.testing.assert_allclose(srgb_to_linear(torch.from_numpy(bytes_)).numpy(), srgb_to_linear(floats), rtol=1e-6)
    np.testing.assert_allclose(gray_to_lightness(bytes_), gray_to_lightness(floats), atol=1e-4)
    levels = np.r_[0:256:15, 1, 2, 254].astype(np.uint8)
    cube = np.stack(np.meshgrid(levels, levels, levels), -1)
    for colours in (cube, torch.from_numpy(cube)):
        again, changed = lab_to_srgb_in_gamut(srgb_to_lab(colours))
        assert changed == 0
        np.testing.assert_array_equal(np.asarray(again), cube)


def test_numpy_and_torch_agree():
    lab = np.random.default_rng(3).uniform([-5, -120, -120], [105, 120, 120], (4000, 3))
    np.testing.assert_allclose(lab_to_srgb(torch.from_numpy(lab)).numpy(), lab_to_srgb(lab), atol=1e-12)
    ours, changed = lab_to_srgb_in_gamut(lab)
    theirs, changed_too = lab_to_srgb_in_gamut(torch.from_numpy(lab))
    assert changed == changed_too
    np.testing.assert_array_equal(theirs.numpy(), ours)


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(
    lightness=st.floats(-50, 150),
    chroma=st.floats(0, 300),
    hue=st.floats(0, 2 * math.pi),
)
def test_gamut_keeps_lightness_and_hue(lightness, chroma, hue):
    lab = np.array([[lightness, chroma * math.cos(hue), chroma * math.sin(hue)]])
    before = lab.copy()
    rgb, changed = lab_to_srgb_in_gamut(lab)
    np.testing.assert_array_equal(lab, before)
    again = srgb_to_lab(rgb / 255.0)[0]
    assert abs(again[0] - min(max(lightness, 0), 100)) < 0.8  # rounding to bytes, and half a level over the edge
    new_chroma = math.hypot(*again[1:])
    assert new_chroma < chroma + 2
    if new_chroma > 15:
        turned = math.atan2(again[2], again[1]) - hue
        assert abs((turned + math.pi) % (2 * math.pi) - math.pi) * new_chroma < 2.5
    wanted = lab_to_srgb(lab)
    inside = (wanted >= -0.5 / 255).all() and (wanted <= 1 + 0.5 / 255).all() and lightness > 0
    assert changed == (0 if inside else 1) or lightness <= 0
    if inside:
        np.testing.assert_array_equal(rgb, np.round(np.clip(wanted, 0, 1) * 255))


def test_gamut_gives_the_largest_chroma_that_fits():
    lab = np.array([[50.0, 150.0, 20.0], [80.0, -10.0, 200.0], [30.0, 10.0, -150.0]])
    rgb, changed = lab_to_srgb_in_gamut(lab)
    assert changed == 3
    kept = np.hypot(*(srgb_to_lab(rgb)[:, 1:] / lab[:, 1:].max(axis=1, keepdims=True)).T)
    assert (kept > 0.2).all()
    for colour, bytes_ in zip(lab, rgb):
        assert bytes_.min() == 0 or bytes_.max() == 255, colour  # on the gamut's surface


def test_black_white_and_rounding():
    lab = np.array([[0.0, 60.0, -60.0], [0.0, 0.0, 0.0], [-3.0, 2.0, 2.0], [100.0, 0.0, 0.0], [130.0, 0.0, 0.0]])
    rgb, changed = lab_to_srgb_in_gamut(lab)
    np.testing.assert_array_equal(rgb, [[0, 0, 0], [0, 0, 0], [0, 0, 0], [255, 255, 255], [255, 255, 255]])
    assert changed == 3
    half = srgb_to_lab(np.array([[100.6, 100.4, 99.6]]) / 255)
    np.testing.assert_array_equal(lab_to_srgb_in_gamut(half)[0], [[101, 100, 100]])
    assert lab_to_srgb_in_gamut(np.zeros((0, 3)))[0].shape == (0, 3)
    assert lab_to_srgb_in_gamut(np.zeros((4, 5, 3), np.float32))[0].dtype == np.uint8


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e7])
def test_unusable_lab_is_counted(bad):
    lab = np.full((4, 5, 3), 50.0)
    lab[1, 2, 0] = lab[3, 4, 1] = bad
    for colours in (lab, torch.from_numpy(lab)):
        with pytest.raises(InputError, match="2 of 60"):
            lab_to_srgb_in_gamut(colours)


def test_wrong_colours_are_refused():
    for wrong in (np.zeros((4, 4)), np.zeros((4, 3), int), torch.zeros(2, 2), np.zeros(())):
        with pytest.raises(InputError):
            xyz_to_lab(wrong)
    for wrong in (np.zeros((4, 2), np.uint8), [[1.0, 2.0, 3.0]], np.zeros((4, 3), np.int64)):
        with pytest.raises(InputError):
            srgb_to_lab(wrong)


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_gamma(kind):
    values = np.array([-1e-9, -3.0, 0.0, 1e-12, 0.25, 1.0, 1.7])
    given_values = values if kind == "numpy" else torch.from_numpy(values)
    encoded = gamma_encode(given_values)
    np.testing.assert_allclose(np.asarray(encoded), np.sqrt(np.maximum(values, 0)))
    np.testing.assert_allclose(np.asarray(gamma_decode(encoded)), np.maximum(values, 0), atol=1e-15)
    np.testing.assert_allclose(np.asarray(gamma_decode(gamma_encode(given_values, 0.4), 0.4)), np.maximum(values, 0))
    for wrong in (0.0, -1.0, float("nan"), float("inf"), "2", True):
        for function in (gamma_encode, gamma_decode):
            with pytest.raises(SettingsError, match="gamma"):
                function(given_values, wrong)
