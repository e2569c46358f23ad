"""Body: the outline of the phantom is known; table, padding, markers, NaN and any units must not change it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_fill_holes

from MedColorLib.errors import InputError
from MedColorLib.phantom import labels, sample
from MedColorLib.scan.body import find_body


def dice(body, truth: np.ndarray) -> float:
    mask = np.stack([body.plane(k) > 0.5 for k in range(len(truth))])
    return 2 * (mask & truth).sum() / (mask.sum() + truth.sum())


def corners(shape) -> np.ndarray:
    """What lies outside a scanner's round field of view."""
    rows, cols = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
    return rows**2 + cols**2 > 1.05


@pytest.mark.parametrize("modality", ["ct", "mr"])
def test_phantom(modality, request):
    phantom = request.getfixturevalue(modality)
    assert dice(find_body(phantom.volume.array), phantom.inside) > (0.98 if modality == "ct" else 0.94)


def test_air_inside_belongs_to_the_body(ct):
    sinus = (ct.labels == 0) & ct.inside
    body = find_body(ct.volume.array)
    assert np.mean(np.stack([body.plane(k) > 0.5 for k in range(len(sinus))])[sinus]) == 1


def test_table_bridge_markers_and_noise_are_left_out(rng):
    space = ((0, 0), (6, 26), (20, 20))
    inside = np.stack([binary_fill_holes(plane > 0) for plane in labels()[::4]])
    values = np.pad(sample("ct")[0].array[::4].astype(float), space, constant_values=-1000)
    truth = np.pad(inside, space)
    bottom = np.flatnonzero(truth.any((0, 2)))[-1]
    values[:, bottom + 6 : bottom + 9, 10:140] = -150  # table
    values[:, bottom + 3 : bottom + 6, 40:110] = -700  # foam
    values[:, bottom - 3 : bottom + 7, 74:76] = 100  # a strap
    values[4:7, 60:63, 8:11] = 400  # skin marker
    values += rng.normal(0, 60, values.shape)
    assert dice(find_body(values), truth) > 0.98


@pytest.mark.parametrize("padding", [-1024, -2000, -3024, -32768, np.nan])
def test_padding_outside_the_field_of_view_is_air(ct, padding):
    values = ct.volume.array.astype(np.int16 if np.isfinite(padding) else np.float32)
    values[:, corners(values.shape[1:])] = padding
    assert dice(find_body(values), ct.inside) > 0.98


@pytest.mark.parametrize("padding", [-2000, -32768, np.nan])
def test_padding_may_be_larger_than_the_picture(ct, padding):
    space = ((0, 0), (40, 40), (40, 40))
    values = np.pad(ct.volume.array.astype(np.float32), space, constant_values=padding)
    assert dice(find_body(values), np.pad(ct.inside, space)) > 0.98


@pytest.mark.parametrize("air", [np.nan, -np.inf, -32768])
def test_where_all_air_is_missing(ct, air):
    """Without a measured value of air, Otsu would separate bone from soft tissue."""
    values = np.where(ct.labels > 0, ct.volume.array.astype(np.float32), air)
    assert dice(find_body(values), ct.inside) > 0.98


@pytest.mark.parametrize("air", [np.nan, -np.inf, -32768, 0])
def test_a_cut_out_body_stands_in_nothing(ct, air):
    values = ct.volume.array.astype(np.float32) + (2000 if air == 0 else 0)
    assert dice(find_body(np.where(ct.inside, values, air)), ct.inside) > 0.98


def test_damaged_voxels_do_not_move_the_outline(ct, rng):
    values = ct.volume.array.astype(np.float32)
    chance = rng.random(values.shape)
    values[chance < 0.02] = np.nan
    values[chance > 0.99] = np.inf
    values[chance > 0.995] = -np.inf
    values[5:7, 30:34, 25:29] = 30000  # metal
    assert dice(find_body(values), ct.inside) > 0.95


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30, 1e40, 1e300])
def test_units_do_not_matter(ct, scale):
    values = 3 * ct.volume.array.astype(np.float64)  # Hounsfield units would be known by their numbers
    body = find_body(values * scale)
    np.testing.assert_array_equal(body.coarse, find_body(values).coarse)
    assert np.isclose(body.threshold / scale, find_body(values).threshold)


@pytest.mark.parametrize(("low", "high", "dtype"), [(0, 1, "u1"), (-32768, 32767, "i2"), (-1.7e308, 1.7e308, "f8")])
def test_two_values(ct, low, high, dtype):
    values = np.where(ct.inside, high, low).astype(dtype)
    assert dice(find_body(values), ct.inside) > 0.98


@pytest.mark.parametrize("part", [np.s_[6:7], np.s_[6:7, 30:31], np.s_[:, 30:31], np.s_[6:7, :, 25:26]])
def test_thin_volumes(ct, part):
    values, truth = ct.volume.array[part], ct.inside[part]
    body = find_body(values)
    assert body.shape == values.shape and dice(body, truth) > 0.95


def test_empty_slices_and_boxes(ct):
    values = ct.volume.array.copy()
    values[[0, 1, 5, 11]] = -1000
    body = find_body(values)
    filled = [k for k in range(12) if k not in (0, 1, 5, 11) and ct.inside[k].any()]
    assert list(body.slices) == filled
    assert not body.boxes[5].any()
    for k in filled:
        rows, cols = (np.flatnonzero(ct.inside[k].any(axis)) for axis in (1, 0))
        expected = [rows[0], rows[-1] + 1, cols[0], cols[-1] + 1]
        assert np.abs(body.boxes[k] - expected).max() <= 1


def test_boxes_hold_the_whole_mask_when_the_outline_is_found_at_reduced_size(rng):
    values = rng.normal(0, 5, (2, 700, 530))
    values[:, 123:601, 77:434] += 100
    body = find_body(values)
    assert body.coarse.shape[1:] == (256, 194)
    for k in range(2):
        rows, cols = (np.flatnonzero((body.plane(k) > 0.5).any(axis)) for axis in (1, 0))
        j0, j1, i0, i1 = body.boxes[k]
        assert j0 <= rows[0] and rows[-1] < j1 and i0 <= cols[0] and cols[-1] < i1
        assert np.abs(np.array([j0, j1, i0, i1]) - (123, 601, 77, 434)).max() <= 4


def test_painted_is_the_body_and_the_tissue_that_its_coarse_outline_missed():
    rows, cols = np.mgrid[-1:1:700j, -1:1:700j]
    truth = rows**2 + 1.3 * cols**2 < 0.5
    values = np.where(truth, 100, 0)[None].astype(np.float32)
    values[0, 300:400, 5:15] = 100  # something beside it
    values[0, 350, 350] = np.nan
    body = find_body(values)
    painted, coarse = body.painted(0, values[0]), body.plane(0) > 0.5
    assert (painted | ~coarse).all() and not painted[:, :20].any()
    assert (painted != truth).sum() < (coarse != truth).sum()
    assert (values[0][painted & ~coarse] > body.threshold).all()


def test_two_arms_beside_the_trunk_are_kept():
    values = np.zeros((1, 60, 120))
    values[0, 10:50, 35:85] = values[0, 20:40, 5:20] = values[0, 20:40, 100:115] = 100
    assert find_body(values).boxes[0].tolist() == pytest.approx([10, 50, 5, 115], abs=1)


def test_nothing_but_single_pixels_is_refused():
    values = np.zeros((1, 1, 1))
    with pytest.raises(InputError, match="nothing stands out"):
        find_body(values)


def test_real_ct_and_mr(shared_data):
    """The head fills what anatomy says, in one piece, and no slice of the MR is lost."""
    from MedColorLib import read_volume

    ct = read_volume(shared_data / "vhf_head_ct.nrrd")
    body = find_body(ct.array[100:140:8])
    assert len(body.slices) == 5
    area_mm2 = (body.plane(2) > 0.5).sum() * ct.spacing_mm[0] * ct.spacing_mm[1]
    assert 15_000 < area_mm2 < 40_000
    mr = read_volume(shared_data / "mr_head_t1_dicom")
    area = find_body(mr.array).coarse.mean((1, 2))
    assert area.min() > 0.05 and area.max() < 0.7
