"""The head made by formula: one truth behind CT, MR and photograph, laid out as a head is, with the same bits everywhere."""

from __future__ import annotations

import subprocess
import sys
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from MedColorLib.phantom import SERIES_LEVELS, TISSUES, labels, sample, scan, section, section_labels, series
from MedColorLib.phantom.noise import grain, hashed, lumps, sine

NAMES = list(TISSUES)
SHAPE = (48, 128, 112)
CHECKSUMS = [115590037, 1297331224, 735996703, 1099768752, 4081849783]


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return labels(SHAPE)


def of(truth: np.ndarray, *names: str) -> np.ndarray:
    return np.isin(truth, [NAMES.index(name) for name in names])


def checksum(array: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(array).tobytes())


def test_the_same_bits_on_every_machine(truth):
    """Sums of what any machine must make; a change of the sample changes them on purpose."""
    made = [truth, sample("ct")[0].array, sample("mr")[0].array, section(), section(0.2, scale=2)]
    assert [checksum(array) for array in made] == CHECKSUMS


def test_no_more_than_numpy_is_loaded():
    code = (
        "import sys; from MedColorLib.phantom import sample, series; sample('mr'); "
        "print([name for name in ('torch', 'scipy', 'cv2', 'SimpleITK', 'PIL') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_tissue_is_there(truth):
    counts = np.bincount(truth.ravel(), minlength=len(NAMES))
    assert (counts[1:] > 30).all(), dict(zip(NAMES, counts))


@pytest.mark.parametrize(("modality", "column"), [("ct", 0), ("mr", 1)])
def test_scans_show_the_truth(truth, modality, column):
    """In the middle of each tissue, where no neighbour reaches, its own value; air and bone exact, the rest but for noise."""
    array = scan(modality).array
    for number, name in enumerate(NAMES):
        core = ndimage.binary_erosion(truth == number, np.ones((3, 3, 3)))
        if core.sum() > 50:
            assert np.median(array[core]) == pytest.approx(TISSUES[name][column], abs=6), name


def test_brain_lies_in_fluid_in_bone_in_soft_tissue(truth):
    """From outside: air, skin, fat; no brain touches skin, muscle or fat in the vault."""
    vault = truth[26:]
    brain = of(vault, "grey matter", "white matter")
    around = ndimage.binary_dilation(brain, np.ones((3, 3, 3))) & ~brain
    assert not of(vault, "air", "skin", "fat", "muscle")[around].any()
    outside = truth == 0
    outer, count = ndimage.label(np.pad(outside, 1, constant_values=True))
    surface = ndimage.binary_dilation(outer == outer[0, 0, 0])[1:-1, 1:-1, 1:-1] & ~outside
    assert count > 1 and of(truth, "skin")[1:][surface[1:]].mean() > 0.9  # but where the neck is cut off


def test_grey_matter_is_a_folded_ribbon_over_white_matter(truth):
    """Far more of it than a smooth shell would have, and thin: hardly a voxel is 4 mm away from other tissue."""
    vault = labels((95, 128, 112))[55:]
    grey, white = of(vault, "grey matter"), of(vault, "white matter")
    assert 0.6 < grey.sum() / white.sum() < 2
    brain = ndimage.binary_fill_holes(of(vault, "grey matter", "white matter", "fluid", "blood", "fibrous tissue"))
    spacing = (2, 1.6, 1.6)
    deep = ndimage.distance_transform_edt(brain, spacing)
    assert (grey & (deep > 8)).sum() > 0.25 * grey.sum()  # in the sulci
    assert (ndimage.distance_transform_edt(grey, spacing) > 4.5).sum() < 0.03 * grey.sum()


def test_left_and_right_are_alike_but_not_the_same(truth):
    same = (truth == truth[:, :, ::-1])[truth > 0].mean()
    assert 0.7 < same < 0.97


def test_a_section_shows_the_tissues_in_their_colours():
    """Medians of what lies away from edges, by the photograph's own truth."""
    picture, here = section(0.2), section_labels(0.2)
    for name in ("grey matter", "white matter", "bone", "marrow", "fluid", "fat", "skin"):
        core = ndimage.binary_erosion(here == NAMES.index(name))
        assert np.abs(np.median(picture[core], 0) - TISSUES[name][2]).max() < 25, name
    corner = picture[10:40, 40:80].reshape(-1, 3).mean(0)
    assert corner[2] > 2 * corner[0]  # blue gelatin


def test_sections_at_twice_the_scale_show_the_same():
    once, twice = section(0.1).astype(float), section(0.1, scale=2).astype(float)
    smaller = twice.reshape(264, 2, 248, 2, 3).mean((1, 3))
    assert twice.shape == (528, 496, 3) and np.abs(smaller - once)[20:-40, 20:-20].mean() < 8


def test_a_series_is_one_head():
    volume, pictures = series()
    assert volume.array.shape == (80, 144, 126) and volume.array.dtype == np.uint16
    assert len(pictures) == len(SERIES_LEVELS) and all(p.shape == (264, 248, 3) for p in pictures)
    np.testing.assert_allclose(volume.spacing_mm, (1.42, 1.42, 2.38), atol=0.01)
    np.testing.assert_array_equal(pictures[1], section(SERIES_LEVELS[1]))


def test_seeds_change_noise_and_texture_alone(truth):
    (one, picture), (other, texture) = sample("ct", 0), sample("ct", 1)
    difference = one.array.astype(int) - other.array
    assert 0 < np.abs(difference).max() < 80 and abs(difference.mean()) < 0.2
    assert 0 < np.abs(picture.astype(int) - texture).mean() < 25


class TestNoise:
    @given(st.floats(-50, 50))
    @settings(max_examples=200, deadline=None)
    def test_sine(self, turns):
        assert sine(np.float64(turns)) == pytest.approx(np.sin(2 * np.pi * turns), abs=2e-3)

    def test_grain_is_nearly_normal(self):
        values = grain((200, 300), 3)
        assert abs(values.mean()) < 0.02 and abs(values.std() - 1) < 0.02
        assert abs(np.corrcoef(values[:, :-1].ravel(), values[:, 1:].ravel())[0, 1]) < 0.02

    def test_hashes_of_neighbours_share_half_of_their_bits(self):
        first, second = hashed(np.arange(5000), seed=1), hashed(np.arange(1, 5001), seed=1)
        differing = np.unpackbits((first ^ second).view(np.uint8)).mean()
        assert abs(differing - 0.5) < 0.01 and len(np.unique(first)) > 4990

    def test_lumps_are_smooth_and_the_same_wherever_the_grid_begins(self):
        line = np.arange(-40, 40, dtype=np.float32)
        whole = lumps((line, line), 8.0, 5)
        np.testing.assert_array_equal(whole[20:50, 30:], lumps((line[20:50], line[30:]), 8.0, 5))
        assert np.abs(np.diff(whole, axis=0)).max() < 2 * 1.5 / 8 + 0.01 and whole.std() > 0.3
