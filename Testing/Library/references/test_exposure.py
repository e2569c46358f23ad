"""Exposure: dark, bright, warm and cold photographs come out alike; what is right already is left; a series gets one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from MedColorLib import Settings
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.lab import linear_to_srgb, srgb_to_lab, srgb_to_linear
from MedColorLib.errors import SettingsError
from MedColorLib.phantom import section
from MedColorLib.references.exposure import BRIGHTEST, Exposure, expose, exposed, neutral_balance
from MedColorLib.references.loading import load_references
from MedColorLib.references.photograph import Reference, prepare_reference
from MedColorLib.references.pictures import read_picture
from MedColorLib.references.tissue_mask import tissue_mask

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def lit(rgb: np.ndarray, factors) -> np.ndarray:
    """The picture in another light: factors on linear red, green, blue."""
    linear = srgb_to_linear(rgb.astype(np.float64) / 255) * factors
    return np.rint(255 * linear_to_srgb(np.clip(linear, 0, 1))).astype(np.uint8)


def with_grey_scale(picture: np.ndarray) -> np.ndarray:
    """The picture with sixteen grey patches, third of a stop apart, below it."""
    steps = np.rint(255 * linear_to_srgb(0.8 * 2.0 ** (-np.arange(16) / 3))).astype(np.uint8)
    patches = np.repeat(np.resize(np.repeat(steps, 15), picture.shape[1])[None, :, None], 16, 0).repeat(3, 2)
    gelatin = np.full((10, picture.shape[1], 3), (28, 74, 120), np.uint8)
    return np.concatenate([picture, gelatin, patches, gelatin])


def reference(rgb: np.ndarray, tissue: np.ndarray) -> Reference:
    return prepare_reference(rgb, "mine", tissue)


def difference(one: Reference, other: Reference) -> float:
    inside = one.mask & other.mask
    return float(
        ciede2000(srgb_to_lab(one.rgb.astype(float) / 255), srgb_to_lab(other.rgb.astype(float) / 255))[inside].mean()
    )


@pytest.mark.parametrize("gain", [0.2, 0.35, 0.6])
def test_dark_pictures_come_back(gain):
    picture = section()
    tissue = tissue_mask(picture)
    (right,), (dark,) = (expose([reference(lit(picture, f), tissue)], "auto") for f in (0.9, 0.9 * gain))
    assert difference(right, dark) < 2 < difference(right, reference(lit(picture, 0.9 * gain), tissue))


@pytest.mark.parametrize("factors", [(1.15, 1, 0.8), (0.85, 1, 1.15), (0.6, 0.5, 0.36)])
def test_warm_and_cold_pictures_come_back_by_a_grey_scale(factors):
    picture = with_grey_scale(lit(section(), 0.85))
    tissue = tissue_mask(picture)
    (right,), (other,) = (expose([reference(lit(picture, f), tissue)], "auto") for f in (1, factors))
    assert right.exposure.white == (1.0, 1.0, 1.0)
    assert difference(right, other) < 3 < difference(right, reference(lit(picture, factors), tissue))


def test_white_paper_tells_the_light():
    picture, tissue = section(), tissue_mask(section())
    picture = np.where(tissue[..., None], picture, 235).astype(np.uint8)
    red, green, blue = neutral_balance(lit(picture, (1.0, 0.9, 0.8)), tissue)
    assert red < green < blue and red * 1.0 == pytest.approx(blue * 0.8, rel=0.03)
    assert neutral_balance(picture, tissue) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("surroundings", [(28, 74, 120), (225, 205, 160), (150, 75, 55), (20, 20, 20)])
def test_gelatin_is_no_white(surroundings):
    picture, tissue = section(), tissue_mask(section())
    noise = np.random.default_rng(0).normal(0, 4, picture.shape)
    picture = np.where(tissue[..., None], picture, np.clip(surroundings + noise, 0, 255)).astype(np.uint8)
    assert neutral_balance(picture, tissue) == (1.0, 1.0, 1.0)


def test_twice_is_once():
    tissue = tissue_mask(section())
    (once,) = expose([reference(lit(section(), 0.3), tissue)], "auto")
    (twice,) = expose([once], "auto")
    assert once.exposure.changes and not twice.exposure.changes and twice.rgb is once.rgb


def test_a_picture_as_bright_as_usual_is_left():
    (left,) = expose([reference(section(), tissue_mask(section()))], "auto")
    assert not left.exposure.changes and left.exposure.describe() == ""


def test_tissue_reaches_the_stated_brightness():
    (found,) = load_references([lit(section(), 0.3)])
    bright = np.percentile((srgb_to_linear(found.rgb.astype(float) / 255) @ LUMINANCE)[found.mask], 99.5)
    assert bright == pytest.approx(BRIGHTEST, abs=0.06)


def test_muscle_alone_is_not_made_as_bright_as_fat():
    rng = np.random.default_rng(1)
    picture = np.clip(np.array([90, 36, 30]) + rng.normal(0, 6, (80, 90, 1)), 0, 255).astype(np.uint8)
    (found,) = expose([reference(picture, np.ones((80, 90), bool))], "auto")
    lightness = srgb_to_lab(found.rgb.astype(float) / 255)[..., 0].mean()
    assert 45 < lightness < 65


def test_lights_are_rolled_off_and_keep_their_order_and_hue():
    ramp = np.arange(256, dtype=np.uint8)
    picture = np.stack([ramp, (0.8 * ramp).astype(np.uint8), (0.5 * ramp).astype(np.uint8)], -1)[None]
    out = exposed(picture, Exposure(3.0))
    luminance = srgb_to_linear(out[0].astype(float) / 255) @ LUMINANCE
    assert (np.diff(luminance) > -0.004).all()
    assert (out[0, :, 0] >= out[0, :, 1]).all() and (out[0, :, 1] >= out[0, :, 2]).all()
    below = srgb_to_linear(picture[0].astype(float) / 255) * 3 @ LUMINANCE < 0.5
    exact = 255 * linear_to_srgb(srgb_to_linear(picture[0, below].astype(float) / 255) * 3)
    assert np.abs(out[0, below] - np.minimum(exact, 255)).max() <= 1


def test_a_series_gets_one_exposure():
    tissue = tissue_mask(section())
    members = [replace(reference(lit(section(), f), tissue), group="folder") for f in (0.2, 0.3, 0.45)]
    found = expose(members, "auto")
    assert len({r.exposure for r in found}) == 1 and found[0].exposure.gain == pytest.approx(
        0.75 / 0.3 / 0.784, rel=0.1
    )
    alone = expose([replace(r, group="") for r in members], "auto")
    assert len({r.exposure for r in alone}) == 3


def test_off_and_a_gain(ct):
    off, twice = (load_references([ct.reference], setting)[0] for setting in ("off", 0.5))
    assert not off.exposure.changes and twice.exposure == Exposure(0.5)
    half = srgb_to_linear(off.rgb[off.mask].astype(float) / 255).mean() / 2
    assert srgb_to_linear(twice.rgb[off.mask].astype(float) / 255).mean() == pytest.approx(half, rel=0.01)


@pytest.mark.parametrize("value", ["bright", 0, -1, 100, float("nan"), True, None])
def test_settings(value):
    with pytest.raises(SettingsError, match="exposure: expected auto, off or a gain"):
        Settings(exposure=value)


@pytest.mark.parametrize(("name", "gain"), [("head", (1.8, 2.5)), ("thorax", (1.1, 1.35))])
def test_real_photographs(name, gain, shared_data):
    """The head is dark; the thorax nearly right, and its grey scale asks for no other white."""
    picture = read_picture(str(shared_data / f"vhf_{name}_cryosection.png"))
    (found,) = load_references([picture])
    assert gain[0] < found.exposure.gain < gain[1] and found.exposure.white == (1.0, 1.0, 1.0)
    if name == "thorax":
        tissue = tissue_mask(picture)
        (other,) = expose([reference(lit(picture, (0.575, 0.5, 0.425)), tissue)], "auto")
        (same,) = expose([reference(picture, tissue)], "auto")
        assert difference(same, other) < 1.5
