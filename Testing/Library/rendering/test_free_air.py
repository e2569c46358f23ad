"""Rays pass free air in leaps and see the same; lamps stand where they should, however a volume is stored."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendering_samples import OBLIQUE, directions, painted, two_colour_ball, view

from MedColorLib.errors import DeviceError
from MedColorLib.rendering import corner_cut, free_air, lights, render_view, shaders
from MedColorLib.volume import ColorVolume


def nearest(seen: np.ndarray) -> np.ndarray:
    """(k, j, i) chessboard distance in voxels to the nearest voxel that can be seen, by its definition."""
    places = np.argwhere(seen)
    every = np.stack(np.indices(seen.shape), axis=-1).reshape(-1, 3)
    return np.abs(every[:, None] - places[None]).max(axis=-1).min(axis=1).reshape(seen.shape)


@settings(deadline=None, max_examples=30)
@given(shape=st.tuples(*[st.integers(1, 26)] * 3), seed=st.integers(0, 999), count=st.integers(1, 3))
def test_no_leap_ends_in_tissue_and_colour_beside_tissue_stays(shape, seed, count):
    rng = np.random.default_rng(seed)
    rgba = np.zeros((*shape, 4), np.uint8)
    rgba[..., :3] = rng.integers(0, 2, (*shape, 3)) * 90  # colour that goes on in air, red alone among it
    for _ in range(count):
        rgba[tuple(rng.integers(0, n) for n in shape)] = (200, 120, 60, 137)
    before = rgba.copy()
    free_air.mark_free_air(rgba)
    distance = nearest(before[..., 3] > 0)
    marked = (rgba[..., 1:] == 0).all(axis=-1)
    # Interpolation mixes the voxels around a place: tissue counts from one voxel before it.
    assert (rgba[marked][:, 0].astype(int) <= np.maximum(distance[marked] - 1, 0)).all()
    kept = distance < free_air.BLOCK
    assert np.abs(rgba[kept].astype(int) - before[kept]).max() <= 1
    np.testing.assert_array_equal(rgba[..., 3], before[..., 3])


def test_all_air_is_one_leap():
    rgba = np.zeros((9, 9, 9, 4), np.uint8)
    free_air.mark_free_air(rgba)
    assert (rgba[..., 0] > 200).all()
    assert not rgba[..., 1:].any()


@pytest.mark.parametrize("text", [shaders.NORMAL, shaders.SKIP_AIR[0], *(text for text, _ in shaders.SHADOWS)])
def test_vtk_writes_the_text_that_is_replaced(gl, monkeypatch, text):
    """Else nothing would be replaced, and pictures would only be slower or rougher: nobody would know."""
    monkeypatch.setattr(shaders, "SKIP_AIR", (text, "this is no shader"))
    monkeypatch.setattr(shaders, "SHADOWS", ())
    monkeypatch.setattr(shaders, "CUBE_NORMALS", ("not in the text", ""))
    with pytest.raises(DeviceError, match="driver failed"):
        render_view(painted(two_colour_ball(14.0), (48, 48, 48)), "anterior", (60, 60), light="realistic")


@pytest.mark.parametrize("light", lights.LIGHTS)
@pytest.mark.parametrize("cut", [None, (-1, 1, 1)])
def test_leaps_do_not_change_the_picture(gl, monkeypatch, light, cut):
    volume = painted(two_colour_ball(14.0), (64, 60, 56))
    region = None if cut is None else corner_cut((0.0, 0.0, 0.0), cut)
    with_leaps = render_view(volume, "oblique", (90, 90), light=light, cut=region).astype(int)
    monkeypatch.setattr(shaders, "SKIP_AIR", ("not in the text", ""))
    monkeypatch.setattr(shaders, "SHADOWS", shaders.SHADOWS[1:])
    without = render_view(volume, "oblique", (90, 90), light=light, cut=region).astype(int)
    assert with_leaps.any()
    assert (np.abs(with_leaps - without) > 4).mean() < 0.002


@pytest.mark.parametrize("matrix", [*directions(), *OBLIQUE.values()])
def test_the_lamp_is_at_the_upper_left(gl, matrix):
    """With two lamps VTK turns normals wrongly where a volume has a matrix of its own."""
    affine = np.eye(4)
    affine[:3, :3] = np.asarray(matrix)[:3, :3]
    volume = painted(two_colour_ball(18.0, (200, 180, 160), (200, 180, 160)), (72, 72, 72), affine)
    for name in ("anterior", "left", "superior"):
        picture = render_view(volume, name, (80, 80), opacity=1.0, light="realistic").astype(float).mean(axis=-1)
        upper_left, lower_right = picture[20:32, 24:34].mean(), picture[48:60, 46:56].mean()
        assert upper_left > 1.15 * lower_right, name


def test_pure_red_is_not_taken_for_a_distance(gl):
    ball = two_colour_ball(14.0, (255, 0, 0), (255, 0, 0))
    picture = view(painted(ball, (48, 48, 48)), size=(60, 60), opacity=1.0)
    assert picture[30, 30, 0] > 245
    black = ColorVolume(np.zeros((4, 4, 4, 3), np.uint8), np.eye(4))
    assert not view(black, size=(8, 8)).any()
