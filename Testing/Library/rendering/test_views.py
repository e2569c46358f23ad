"""Rendering: small, large and cut volumes."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from rendering_samples import (
    BLUE,
    ORANGE,
    RAS_DIAGONAL,
    distance,
    lit,
    painted,
    rotation,
    six_balls,
    two_colour_ball,
    view,
)

from MedColorLib.errors import SettingsError
from MedColorLib.rendering import (
    VIEWS,
    Cut,
    contact_sheet,
    corner_cut,
    grid,
    render_to_png,
    sections,
    surface,
)
from MedColorLib.volume import ColorVolume


def test_black_volumes_give_black_pictures():
    black = ColorVolume(np.zeros((5, 6, 7, 3), np.uint8), np.eye(4))
    assert view(black, size=(40, 30)).shape == (30, 40, 3)
    assert not view(black, size=(40, 30)).any()
    assert all(not picture.any() for picture in sections(black).values())
    sheet_picture = contact_sheet(None, black, (480, 360))
    assert sheet_picture.shape == (360, 480, 3)


@pytest.mark.parametrize("shape", [(1, 24, 24), (24, 1, 24), (24, 24, 1), (1, 1, 1)])
def test_a_single_slice_or_voxel_is_drawn(gl, shape):
    volume = ColorVolume(np.full((*shape, 3), ORANGE, np.uint8), RAS_DIAGONAL)
    thin_axis = {(1, 24, 24): "superior", (24, 1, 24): "anterior"}.get(shape, "left")
    picture = view(volume, thin_axis, (60, 60), opacity=1.0)
    assert distance(picture[30, 30], ORANGE) <= 8
    for name in VIEWS:
        assert view(volume, name, (20, 20)).shape == (20, 20, 3)


def test_above_the_budget_the_volume_is_thinned_and_that_is_logged(gl, caplog):
    volume = painted(two_colour_ball(), (48, 48, 48))
    with caplog.at_level(logging.INFO, "MedColorLib"):
        thin = view(volume, voxel_budget=8000)
    assert "thinned out" in caplog.text
    full = view(volume)
    assert distance(thin[60, 40], ORANGE) <= 8
    assert (np.abs(thin.astype(int) - full).max(axis=-1) > 30).mean() < 0.13  # the outline only


def test_the_same_bytes_twice(gl, tmp_path):
    volume = painted(six_balls, (42, 42, 42))
    assert view(volume, "oblique", shade=True).tobytes() == view(volume, "oblique", shade=True).tobytes()
    first, second = (render_to_png(tmp_path / f"{n}.png", volume, size=(480, 360)).read_bytes() for n in range(2))
    assert first == second


def test_arguments_are_not_changed(gl):
    volume = painted(two_colour_ball(), (24, 24, 24))
    before = volume.rgb.copy()
    view(volume, "oblique", (30, 30), cut=corner_cut((0, 0, 0)))
    np.testing.assert_array_equal(volume.rgb, before)


def fruit(r, a, s):
    """A blue peel around an orange flesh."""
    radius = np.sqrt(r**2 + a**2 + s**2)[..., None]
    return np.where(radius < 14, ORANGE, np.where(radius < 19, BLUE, 0))


@pytest.mark.parametrize("shade", [False, True])
@pytest.mark.parametrize("directions", [np.diag([-1.0, -1, 1]), rotation((1, 2, 3), 35)], ids=["straight", "oblique"])
def test_a_cut_shows_the_inside_in_its_own_colour(gl, directions, shade):
    matrix = np.eye(4)
    matrix[:3, :3] = directions
    volume = painted(fruit, (64, 64, 64), matrix)
    whole = view(volume, shade=shade)
    opened = view(volume, shade=shade, cut=corner_cut((0.0, 0.0, 0.0), (0, 1, 0)))
    peel, flesh = (lit(BLUE), lit(ORANGE)) if shade else (BLUE, ORANGE)  # a lit face, not one left in the dark
    allowed = 20 if shade else 8
    assert distance(whole[60, 60], peel) <= allowed
    seen = opened[40:81, 40:81].reshape(-1, 3)
    assert np.abs(seen - np.array(flesh)).max() <= allowed


def test_cuts_take_a_half_a_quarter_or_an_eighth():
    volume = painted(lambda r, a, s: np.full((*r.shape, 3), 200), (20, 20, 20))
    prepared = grid.prepare_grid(volume)

    def amount(rgba):
        return rgba[..., 3].sum(dtype=np.int64)

    for towards, share in (((1, 0, 0), 1 / 2), ((0, -1, 1), 1 / 4), ((-1, 1, 1), 1 / 8)):
        kept = grid.cut_grid(prepared, corner_cut((0, 0, 0), towards))
        assert amount(kept.rgba) / amount(prepared.rgba) == pytest.approx(1 - share, abs=0.01)
        seen = surface._dilated(kept.rgba[..., 3] > 0)  # what interpolation mixes with visible voxels
        np.testing.assert_array_equal(kept.rgba[seen][:, :3], prepared.rgba[seen][:, :3])
    # Which side: taking the patient's right away leaves nothing at positive R.
    kept = grid.cut_grid(prepared, corner_cut((0, 0, 0), (1, 0, 0)))
    positions = np.argwhere(kept.rgba[..., 3] > 100)[:, ::-1] @ kept.ijk_to_ras[:3, :3].T + kept.ijk_to_ras[:3, 3]
    assert positions[:, 0].max() < 0


def test_a_cut_that_takes_all_leaves_black(gl):
    volume = painted(fruit, (40, 40, 40))
    assert not view(volume, cut=Cut((((0.0, 1.0, 0.0), (0.0, -100.0, 0.0)),))).any()


@pytest.mark.parametrize(
    "planes", [(), (((0, 0, 0), (1, 1, 1)),), (((1, 0), (1, 1, 1)),), (((np.nan, 0, 1), (1, 1, 1)),), ("no",)]
)
def test_a_meaningless_cut_is_refused(planes):
    with pytest.raises(SettingsError):
        Cut(planes)


@pytest.mark.parametrize("towards", [(0, 0, 0), (2, 0, 0), (1, 0)])
def test_a_meaningless_corner_is_refused(towards):
    with pytest.raises(SettingsError):
        corner_cut((0, 0, 0), towards)
