"""Body on scans of every kind, made by formula: tissue is known and must not be lost; table and noise are no tissue."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from MedColorLib.scan.body import WARN_FROM, find_body, given_body, ranges_text, whole_body

SHAPE = (16, 160, 200)


def ellipsoid(centre, radii, shape=SHAPE) -> np.ndarray:
    z, y, x = np.ogrid[: shape[0], : shape[1], : shape[2]]
    (cz, cy, cx), (rz, ry, rx) = centre, radii
    return ((z - cz) / rz) ** 2 + ((y - cy) / ry) ** 2 + ((x - cx) / rx) ** 2 < 1


def head(skin=0.9, muscle=0.4, bone=0.04, brain=0.35) -> tuple[np.ndarray, np.ndarray]:
    """Signal 0..1 and body: bright fat around dark bone around brain, as in T1 with contrast agent."""
    inside = ellipsoid((8, 80, 100), (40, 62, 55))
    signal = np.zeros(SHAPE, np.float32)
    for level, shrink in ((skin, 0), (muscle, 7), (bone, 10), (brain, 14)):
        signal[ellipsoid((8, 80, 100), (40, 62 - shrink, 55 - shrink))] = level
    return gaussian_filter(signal, (0, 0.6, 0.6)), inside


def rician(signal: np.ndarray, sigma: float, rng) -> np.ndarray:
    """Magnitude MR with noise of one coil."""
    return np.hypot(signal + rng.normal(0, sigma, signal.shape), rng.normal(0, sigma, signal.shape)).astype(np.float32)


def chest(rng) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """CT in HU with two lungs, separate arms, a table, a mattress and sheets; body; what is not body."""
    trunk = ellipsoid((8, 75, 100), (60, 45, 55))
    values = np.full(SHAPE, -1000, np.float32)
    values[trunk] = -100
    values[ellipsoid((8, 75, 100), (60, 40, 50))] = 45
    for side in (-1, 1):
        values[ellipsoid((8, 72, 100 + 24 * side), (50, 28, 16))] = -860
    arms = ellipsoid((8, 80, 22), (60, 14, 12)) | ellipsoid((8, 80, 178), (60, 14, 12))
    values[arms] = 40
    rows, cols = np.mgrid[: SHAPE[1], : SHAPE[2]]
    table = (np.abs(rows - 130 - 0.001 * (cols - 100) ** 2) < 1.6) & (np.abs(cols - 100) < 92)
    mattress = (rows > 119) & (rows < 128) & (np.abs(cols - 100) < 80)
    sheet = np.abs(rows - 24 - 4 * np.sin(cols / 9)) < 1
    body = trunk | arms
    for level, part in ((-930, mattress), (150, table), (-650, sheet)):
        values[np.broadcast_to(part, SHAPE) & ~body] = level
    beside = np.broadcast_to(table | sheet | mattress, SHAPE) & ~body
    return gaussian_filter(values, (0, 0.6, 0.6)) + rng.normal(0, 15, SHAPE), body, beside


def found(values: np.ndarray, pixel_mm=(1.0, 1.0)) -> np.ndarray:
    """(k, j, i) bool: what would be coloured."""
    body = find_body(values, pixel_mm)
    return np.stack([body.painted(k, plane) for k, plane in enumerate(values)])


def lost(mask: np.ndarray, tissue: np.ndarray) -> float:
    """Share of the tissue that is not coloured, in the worst slice."""
    return max(float((t & ~m).sum() / t.sum()) for m, t in zip(mask, tissue) if t.any())


def beside(mask: np.ndarray, tissue: np.ndarray) -> float:
    """Coloured voxels more than three pixels from tissue, as a share of all coloured ones."""
    near = gaussian_filter(tissue.astype(np.float32), (0, 2, 2)) > 0.01
    return float((mask & ~near).sum() / mask.sum())


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05, 0.1])
def test_bright_fat_does_not_hide_the_brain(noise, rng):
    signal, tissue = head(skin=1.0, brain=0.2)
    mask = found(1000 * rician(signal, noise, rng))
    assert lost(mask, tissue) < 0.03 and beside(mask, tissue) < 0.01


@pytest.mark.parametrize("axis", [1, 2])
def test_coil_shading_of_one_to_ten(axis, rng):
    signal, tissue = head(skin=0.9, brain=0.5, bone=0.2)
    ramp = np.exp(np.linspace(np.log(0.1), 0, SHAPE[axis]))
    signal = signal * ramp[:, None] if axis == 1 else signal * ramp
    mask = found(rician(signal, 0.005, rng))
    assert lost(mask, tissue) < 0.05 and beside(mask, tissue) < 0.01


def units() -> dict:
    return {
        "as they are": lambda v: np.rint(v).astype(np.int16),
        "plus 1024": lambda v: np.rint(np.maximum(v + 1024, 0)).astype(np.uint16),
        "0 to 1": lambda v: ((v + 1000) / 3000).astype(np.float32),
        "8 bit, wide": lambda v: np.rint(np.clip((v + 1000) / 16, 0, 255)).astype(np.uint8),
        "8 bit, soft tissue": lambda v: np.rint(np.clip((v + 160) / 400, 0, 1) * 255).astype(np.uint8),
        "8 bit, lung": lambda v: np.rint(np.clip((v + 1350) / 1500, 0, 1) * 255).astype(np.uint8),
        "clipped in HU": lambda v: np.rint(np.clip(v, -200, 300)).astype(np.int16),
    }


@pytest.mark.parametrize("unit", units())
def test_ct_in_any_unit_without_table_and_with_separate_arms(unit, rng):
    values, tissue, other = chest(rng)
    bone = ellipsoid((8, 100, 100), (60, 9, 8))
    mask = found(units()[unit](np.where(bone, 700, values)))
    assert lost(mask, tissue & (values > -190)) < 0.03  # the rim of partial volume is clipped to black
    assert (mask & other)[:, 120:].sum() / mask.sum() < 0.01 and beside(mask, tissue) < 0.02


@pytest.mark.parametrize("padding", [-2000, -3024, -32768])
def test_a_round_field_of_view_with_a_table_in_it(padding, rng):
    values, tissue, _ = chest(rng)
    rows, cols = np.mgrid[-1 : 1 : SHAPE[1] * 1j, -1 : 1 : SHAPE[2] * 1j]
    outside = rows**2 + cols**2 > 1
    values[:, outside] = padding
    mask = found(np.rint(values).astype(np.int16))
    assert lost(mask, tissue & ~outside) < 0.03 and beside(mask, tissue) < 0.02


def test_a_holder_that_touches_the_head_is_left_out_and_said(rng):
    tissue = head()[1]
    values = np.where(tissue, 40, -1000).astype(np.float32)
    values[ellipsoid((8, 80, 100), (40, 55, 48))] = 800
    values[ellipsoid((8, 80, 100), (40, 48, 41))] = 35
    rows, cols = np.mgrid[: SHAPE[1], : SHAPE[2]]
    shell = ((rows - 80) / 66) ** 2 + ((cols - 100) / 59) ** 2
    cradle = np.broadcast_to((shell < 1) & (rows > 90), SHAPE) & ~tissue
    wings = np.broadcast_to((np.abs(rows - 92) < 3) & (np.abs(cols - 100) < 95), SHAPE) & ~tissue & ~cradle
    values[cradle | wings] = 60
    body = find_body(np.rint(values + rng.normal(0, 10, SHAPE)).astype(np.int16))
    mask = np.stack([body.plane(k) > 0.5 for k in range(SHAPE[0])])
    assert lost(mask, tissue) < 0.02
    assert (mask & wings).sum() < 0.2 * wings.sum()
    assert body.left_outside.plates > 0.01
    assert "--body all" in body.left_outside.warning() and "0 to 15" in body.left_outside.warning()


@pytest.mark.parametrize("kind", ["brain MR", "abdomen CT", "abdomen CT, 8 bit"])
def test_without_air_everything_is_body_and_that_is_said(kind, rng):
    shape = (10, 90, 90)
    texture = gaussian_filter(rng.normal(0, 1, shape), (1, 6, 6))
    texture /= texture.std()
    values = {
        "brain MR": lambda: rician(np.clip(500 + 160 * texture, 60, 1200), 20, rng),
        "abdomen CT": lambda: np.rint(np.where(texture > 0.8, -100, 40) + rng.normal(0, 15, shape)).astype(np.int16),
        "abdomen CT, 8 bit": lambda: np.clip(
            np.rint((np.where(texture > 0.8, -100, 40) + rng.normal(0, 15, shape) + 160) * 0.64), 0, 255
        ).astype(np.uint8),
    }[kind]()
    body = find_body(values)
    assert body.coarse.all()
    assert "CT in Hounsfield units" in body.text or "no air found" in body.text


@pytest.mark.parametrize("background", [0, 37, -5, np.nan])
def test_a_skull_stripped_brain_on_an_exact_background(background, rng):
    """Fluid in the brain may be as dark as a thousandth: what was cut out is the background, nothing else."""
    inside = ellipsoid((8, 80, 100), (30, 50, 40))
    values = np.where(inside, 100 + 25 * gaussian_filter(rng.normal(0, 1, SHAPE), 2) * 10, 0).astype(np.float32)
    values[ellipsoid((8, 50, 100), (30, 22, 4)) & inside] = 3
    values = np.where(inside, np.maximum(values, 2) + (background if background == 37 else 0), background)
    mask = found(values.astype(np.float32))
    assert lost(mask, inside) < 0.03 and beside(mask, inside) < 0.005


def test_a_normalised_brain_whose_background_lies_amid_its_values(rng):
    inside = ellipsoid((8, 80, 100), (30, 50, 40))
    values = np.where(inside, rng.normal(0, 1, SHAPE), 0).astype(np.float32)
    mask = found(values)
    assert lost(mask, inside) < 0.03 and beside(mask, inside) < 0.005


@pytest.mark.parametrize("modality", ["MR", "noisy MR", "CT"])
@pytest.mark.parametrize("count", [1, 4])
def test_mice_in_a_large_frame(modality, count, rng):
    tissue = np.zeros(SHAPE, bool)
    for row, col in [(50, 60), (50, 140), (110, 60), (110, 140)][:count]:
        tissue |= ellipsoid((8, row, col), (30, 17, 13))
    if modality == "CT":
        values = np.rint(np.where(tissue, 20, -1000) + rng.normal(0, 30, SHAPE)).astype(np.int16)
    else:
        values = rician(600 * tissue.astype(np.float32), 60 if modality == "noisy MR" else 12, rng)
    mask = found(values)
    assert lost(mask, tissue) < 0.03 and beside(mask, tissue) < 0.01


def test_two_legs_stay_two(rng):
    tissue = ellipsoid((8, 80, 52), (60, 50, 44)) | ellipsoid((8, 80, 148), (60, 50, 44))
    mask = found(rician(500 * tissue.astype(np.float32), 10, rng))
    assert lost(mask, tissue) < 0.02
    assert mask[:, 75:85, 98:102].mean() < 0.2  # the gap between them is no tissue


def test_single_and_thick_slices(rng):
    signal, tissue = head(skin=1.0, brain=0.2)
    values = rician(1000 * signal, 10, rng)
    for part in (np.s_[8:9], np.s_[::8]):
        assert lost(found(values[part]), tissue[part]) < 0.03


@pytest.mark.parametrize("ct", [False, True])
def test_slices_across_an_acquisition_of_thick_slices(ct, rng):
    """A transverse slice of a sagittal series has columns six times as far apart as rows."""
    if ct:
        values, tissue, _ = chest(rng)
        values = np.rint(values).astype(np.int16)
    else:
        signal, tissue = head(skin=1.0, brain=0.2)
        values = rician(1000 * signal, 10, rng)
    mask = found(values[:, :, ::6], (1.0, 6.0))
    assert lost(mask, tissue[:, :, ::6]) < 0.06


def test_negative_values_and_signed_noise(rng):
    signal, tissue = head(skin=1.0, brain=0.3)
    values = rician(1000 * signal, 10, rng)
    assert lost(found((values - values.mean()) / values.std()), tissue) < 0.03
    noisy = (100 * tissue + rng.normal(0, 5, SHAPE)).astype(np.float32)
    mask = found(noisy)
    assert lost(mask, tissue) < 0.03 and beside(mask, tissue) < 0.01


def test_two_per_cent_of_metal_do_not_hide_tissue(rng):
    signal, tissue = head(skin=0.9, brain=0.4)
    values = rician(100 * signal, 1, rng)
    values[:, 70:90, 85:115] = 30_000
    assert lost(found(values), tissue) < 0.03


def test_what_is_left_out_is_counted_and_named(rng):
    values, tissue, _ = chest(rng)
    left = find_body(np.rint(values).astype(np.int16)).left_outside
    assert left.share > WARN_FROM and left.plates > 0.5 * left.share
    assert left.slices == list(range(SHAPE[0]))
    assert left.warning().startswith("left out of the body: ")
    assert "table" in left.describe()
    clean = find_body(np.where(tissue, 40, -1000).astype(np.int16)).left_outside
    assert clean.share == 0 and clean.warning() is None


def test_the_result_is_the_same_every_time(rng):
    values = rician(1000 * head()[0], 20, rng)
    first, second = find_body(values), find_body(values.copy())
    np.testing.assert_array_equal(first.coarse, second.coarse)
    assert first.threshold == second.threshold


def test_bodies_that_are_given():
    labels = np.zeros((3, 300, 400), np.uint8)
    labels[1, 20:70, 33:44] = 4
    body = given_body(labels, "seg")
    assert list(body.slices) == [1] and body.boxes[1].tolist() == [20, 70, 33, 44]
    np.testing.assert_array_equal(body.painted(1, labels[1]), labels[1] > 0)
    np.testing.assert_array_equal(body.plane(1), (labels[1] > 0).astype(np.float32))
    whole = whole_body((3, 300, 400))
    assert list(whole.slices) == [0, 1, 2] and whole.painted(2, labels[2]).all() and whole.left_outside is None


def test_ranges_of_slices_in_words():
    assert ranges_text([]) == ""
    assert ranges_text([3]) == "3"
    assert ranges_text([0, 1, 2, 5, 7, 8]) == "0 to 2, 5, 7 to 8"
    assert ranges_text(list(range(0, 40, 2)), most=3) == "0, 2, 4 and 17 more"
