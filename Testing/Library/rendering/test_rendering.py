"""Rendering: colours come out as themselves, from the right side, at the right size, and files are whole or absent."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rendering_samples import (
    BLUE,
    OBLIQUE,
    ORANGE,
    SIDES,
    directions,
    distance,
    lit,
    painted,
    six_balls,
    two_colour_ball,
    view,
)

from MedColorLib.errors import SettingsError
from MedColorLib.rendering import (
    VIEWS,
    grey_color_volume,
    grid,
    offscreen,
    presets,
    surface,
)
from MedColorLib.volume import ColorVolume, Volume

ROOT = Path(__file__).resolve().parents[3]


@given(low=st.integers(0, 255), high=st.integers(0, 255), alpha=st.integers(0, 255), opacity=st.floats(0, 1, width=32))
def test_opacity_points_undo_the_shift_of_vtks_axis(low, high, alpha, opacity):
    low, high = min(low, high), max(low, high)
    alpha = min(max(alpha, low), high)
    wanted = np.interp(alpha, *zip(*presets.opacity_curve(opacity)))
    points = presets.opacity_points(low, high, opacity)
    # The table spans low..high and is read at alpha / 255; a table of one value has no width.
    read_at = low + alpha / 255 * (high - low)
    assert np.interp(read_at, *zip(*points)) == pytest.approx(wanted, abs=1e-9)
    assert all(first[0] < second[0] for first, second in zip(points, points[1:]))


def test_opacity_is_zero_in_air_solid_at_one_and_grows_with_the_slider():
    alphas = np.arange(256)
    curves = [np.interp(alphas, *zip(*presets.opacity_curve(o))) for o in np.linspace(0, 1, 11)]
    assert all((curve[:12] == 0).all() for curve in curves)
    assert (np.diff(curves, axis=0) >= 0).all()
    assert (np.diff(curves, axis=1) >= 0).all()
    assert (curves[0] == 0).all()
    assert (curves[-1][48:] == 1).all()


@pytest.mark.parametrize("arguments", [(0, 255, 1.1), (0, 255, -0.1), (0, 255, np.nan), (9, 8, 0.5), (0, 256, 0.5)])
def test_opacity_points_refuse_what_has_no_meaning(arguments):
    with pytest.raises(SettingsError):
        presets.opacity_points(*arguments)


def test_unit_distance_is_tied_to_the_body():
    assert presets.unit_distance_mm(400.0) == pytest.approx(1.0)
    with pytest.raises(SettingsError):
        presets.unit_distance_mm(0.0)


def test_nothing_heavy_is_imported_with_the_package():
    code = (
        "import sys, MedColorLib.rendering;"
        "heavy = {'vtk', 'vtkmodules', 'cv2', 'scipy', 'torch', 'SimpleITK'} & set(sys.modules);"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_luminance_is_that_of_vtk():
    vtk_core = pytest.importorskip("vtkmodules.vtkImagingColor")
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData

    grey = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    rgb = np.concatenate([np.random.default_rng(0).integers(0, 256, (4096, 3), dtype=np.uint8), grey])
    image = vtkImageData()
    image.SetDimensions(len(rgb), 1, 1)
    image.GetPointData().SetScalars(numpy_to_vtk(rgb))
    luminance = vtk_core.vtkImageLuminance()
    luminance.SetInputData(image)
    luminance.Update()
    theirs = vtk_to_numpy(luminance.GetOutput().GetPointData().GetScalars())
    np.testing.assert_array_equal(surface.luminance_alpha(rgb), theirs)


def test_colour_goes_on_outside_tissue_and_the_inside_is_untouched():
    rgb = np.zeros((9, 9, 9, 3), np.uint8)
    rgb[2:7, 2:7, 2:7] = ORANGE
    rgba = surface.surface_rgba(rgb)
    assert rgba.shape == (15, 15, 15, 4)
    np.testing.assert_array_equal(rgba[3:12, 3:12, 3:12][2:7, 2:7, 2:7, :3], rgb[2:7, 2:7, 2:7])
    assert (rgba[6:9, 6:9, 6:9, 3] == 137).all()  # all but the outermost layer
    seen = surface._dilated(rgba[..., 3] > 0)  # all that interpolation mixes with visible voxels
    assert (rgba[seen][:, :3] == ORANGE).all()
    assert (rgba[[0, -1]] == 0).all()


def test_a_half_filled_voxel_takes_the_colour_of_its_inner_neighbours():
    rgb = np.zeros((9, 9, 9, 3), np.uint8)
    rgb[1:8, 1:8, 1:8] = np.array(ORANGE) // 3  # partial volume
    rgb[2:7, 2:7, 2:7] = ORANGE
    rgba = surface.surface_rgba(rgb)[3:12, 3:12, 3:12]
    assert (rgba[1:8, 1:8, 1:8, :3] == ORANGE).all()


def test_a_thin_bright_skin_keeps_its_colour():
    rgb = np.zeros((9, 9, 9, 3), np.uint8)
    rgb[1:8, 1:8, 1:8] = (250, 230, 200)
    rgb[2:7, 2:7, 2:7] = (120, 40, 30)
    rgba = surface.surface_rgba(rgb)[3:12, 3:12, 3:12]
    assert (rgba[1, 1:8, 1:8, :3] == (250, 230, 200)).all()


def test_grey_volume_is_windowed_rounded_and_nan_is_black():
    values = np.array([[[-50.0, 0.0, 50.4, 100.0, 500.0, np.nan]]], dtype=np.float32)
    volume = Volume(values, window=(0.0, 100.0))
    grey = grey_color_volume(volume)
    np.testing.assert_array_equal(grey.rgb[0, 0, :, 0], [0, 0, 129, 255, 255, 0])
    assert (grey.rgb == grey.rgb[..., :1]).all()
    np.testing.assert_array_equal(grey_color_volume(volume, (50.0, 150.0)).rgb[0, 0, :, 1], [0, 0, 1, 128, 255, 0])
    with pytest.raises(SettingsError):
        grey_color_volume(volume, (5.0, 5.0))


@given(
    shape=st.tuples(*[st.integers(1, 40)] * 3),
    budget=st.integers(1, 3000),
    spacing=st.tuples(*[st.floats(0.1, 5)] * 3),
)
@settings(deadline=None, max_examples=40)
def test_thinning_stays_within_the_budget_and_in_place(shape, budget, spacing):
    rgb = np.full((*shape, 3), 100, np.uint8)
    matrix = np.diag([*spacing, 1.0])
    matrix[:3, 3] = (7, -3, 2)
    volume = ColorVolume(rgb, matrix)
    thin = grid.prepare_grid(volume, budget)
    inner = thin.rgba[3:-3, 3:-3, 3:-3]
    assert np.prod(inner.shape[:3]) <= budget
    factors = np.rint(np.linalg.norm(thin.ijk_to_ras[:3, :3], axis=0) / spacing).astype(int)
    assert tuple(-(-n // f) for n, f in zip(shape[::-1], factors)) == inner.shape[2::-1]
    # The first voxel's outer corner stays where it was.
    corner = thin.ijk_to_ras @ [2.5, 2.5, 2.5, 1]
    np.testing.assert_allclose(corner, matrix @ [-0.5, -0.5, -0.5, 1], atol=1e-9)


def test_a_huge_slice_is_thinned_to_what_drivers_take():
    volume = ColorVolume(np.full((1, 3, 9000, 3), 100, np.uint8), np.eye(4))
    assert max(grid.prepare_grid(volume).rgba.shape) <= 2006


@pytest.mark.parametrize("opacity", [0.82, 0.88, 1.0])
def test_colours_come_out_as_themselves_up_to_the_rim(gl, opacity):
    picture = view(painted(two_colour_ball(), (48, 48, 48)), opacity=opacity)
    # Seen from the front the patient's right is on the left. The ball fills 94 % of 120 pixels; the colours mix at
    # the seam only, within the three voxels that the colour goes on outside.
    y, x = np.mgrid[:120, :120] - 59.5
    radius = np.hypot(x, y)
    inside = radius < 0.9 * 0.47 * 120
    for colour, side in ((ORANGE, x < -9), (BLUE, x > 9)):
        errors = np.abs(picture[inside & side].astype(int) - colour)
        assert errors.max() <= 8
        assert distance(picture[60, 60 + (20 if colour == BLUE else -20)], colour) <= 2
    assert (picture[radius > 58.5] == 0).all()


def test_without_the_continued_colour_there_would_be_a_dark_rim(gl, monkeypatch):
    """Control: the test above can fail."""
    monkeypatch.setattr(surface, "_dress", lambda rgba: None)
    picture = view(painted(two_colour_ball(), (48, 48, 48)), opacity=1.0)
    assert distance(picture[60, 40], ORANGE) > 40


@pytest.mark.parametrize(("threshold", "dim_is_seen"), [(100.0, True), (120.0, False)])
def test_opacity_axis_is_right_when_luminance_ends_at_137(gl, monkeypatch, threshold, dim_is_seen):
    volume = painted(two_colour_ball(), (48, 48, 48))
    prepared = grid.prepare_grid(volume)
    assert prepared.rgba[..., 3].max() == 137
    assert surface.luminance_alpha(np.array(BLUE)) == 110
    step = [(0.0, 0.0), (threshold, 0.0), (threshold + 1.0, 1.0), (255.0, 1.0)]
    monkeypatch.setattr(presets, "opacity_curve", lambda opacity: step)
    picture = view(volume)
    assert distance(picture[60, 35], ORANGE) <= 8
    assert distance(picture[60, 85], BLUE if dim_is_seen else (0, 0, 0)) <= 8


def test_a_constant_alpha_gets_its_own_opacity(gl):
    """Straight to VTK: a box without any margin of air, as a scene may hold one."""
    rgba = np.full((8, 8, 8, 4), 137, np.uint8)
    for alpha, seen in ((137, True), (5, False)):
        rgba[..., 3] = alpha
        box = grid.Grid(rgba, np.eye(4), 14.0)
        camera = offscreen.Camera(np.full(3, 3.5), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 6.0, 40.0)
        with offscreen.Stage((32, 32)) as stage:
            stage.show(box, 1.0, shade=False)
            assert distance(stage.draw(camera)[16, 16], (137,) * 3 if seen else (0,) * 3) <= 2


def test_the_slider_goes_from_nothing_to_solid(gl):
    volume = painted(two_colour_ball(), (32, 32, 32))
    sums = [int(view(volume, size=(60, 60), opacity=o).sum()) for o in (0.0, 0.2, 0.4, 0.6, 1.0)]
    assert sums[0] == 0
    assert all(first < second for first, second in zip(sums, sums[1:]))


@pytest.mark.parametrize("colour", [(40, 220, 40), (220, 60, 60)])
def test_shading_follows_alpha_and_not_red(gl, colour):
    """Bright where the surface faces the lamp, dim at the limb; the green ball has next to no red."""
    picture = view(painted(two_colour_ball(left=colour, right=colour), (48, 48, 48)), shade=True).astype(float)
    channel = picture[60, 60:, int(np.argmax(colour))]
    assert channel[:8].mean() > lit(colour).max() - 12
    assert channel[45:50].mean() < 0.75 * channel[:8].mean()
    # From ring to ring it only gets dimmer.
    y, x = np.mgrid[:120, :120] - 59.5
    rings = [picture[(np.hypot(x, y) >= r) & (np.hypot(x, y) < r + 8)].mean() for r in range(0, 48, 8)]
    assert all(inner > outer for inner, outer in zip(rings, rings[1:]))


FROM = {  # view: what is seen in the middle, left, right, top, bottom of the picture
    "anterior": "ARLSI",
    "posterior": "PLRSI",
    "left": "LAPSI",
    "right": "RPASI",
    "superior": "SLRAP",
    "inferior": "IRLAP",
}


def check_six_sides(volume, name, **kwargs):
    picture = view(volume, name, (100, 100), **kwargs)
    half_extent = 14 + 5.5
    offset = round(14 / half_extent * 0.94 * 50)
    places = [(50, 50), (50, 50 - offset), (50, 50 + offset), (50 - offset, 50), (50 + offset, 50)]
    for side, place in zip(FROM[name], places):
        assert distance(picture[place], SIDES[side][1]) <= 8, (name, side, picture[place])
    return picture


@pytest.mark.parametrize("name", list(FROM))
def test_each_view_sees_its_side(gl, name):
    check_six_sides(painted(six_balls, (42, 42, 42)), name)


def test_the_oblique_view_is_from_the_front_left_above(gl):
    picture = view(painted(six_balls, (42, 42, 42)), "oblique").astype(int)

    def place(side):
        return np.argwhere(np.abs(picture - SIDES[side][1]).max(axis=-1) <= 8).mean(axis=0)

    (a_row, a_column), (s_row, _), (_, l_column) = place("A"), place("S"), place("L")
    assert a_column < l_column
    assert s_row < a_row
    assert VIEWS["oblique"][0][0] < 0 < min(VIEWS["oblique"][0][1:])


@pytest.mark.parametrize("matrix", directions())
def test_storage_order_and_handedness_do_not_matter(gl, matrix):
    reference = view(painted(six_balls, (42, 42, 42)), "oblique", (80, 80), shade=True).astype(int)
    picture = view(painted(six_balls, (42, 42, 42), matrix), "oblique", (80, 80), shade=True).astype(int)
    difference = np.abs(picture - reference)
    assert difference.mean() < 0.3
    assert (difference > 8).mean() < 0.002  # single pixels on an edge, where rounding decides


@pytest.mark.parametrize("name", ["anterior", "superior"])
@pytest.mark.parametrize("directions", list(OBLIQUE.values()), ids=list(OBLIQUE))
def test_oblique_grids_show_the_same_body(gl, directions, name):
    matrix = np.eye(4)
    matrix[:3, :3] = directions
    check_six_sides(painted(six_balls, (72, 72, 72), matrix), name)


def test_the_look_does_not_depend_on_the_voxel_size(gl):
    ball = two_colour_ball(24.0)
    for opacity, shade in ((0.35, False), (0.8, True)):
        means = []
        for spacing in ((1, 1, 1), (0.6, 0.6, 0.6), (0.8, 0.8, 2.4), (2.4, 0.8, 0.8)):
            shape = tuple(int(np.ceil(56 / s)) for s in spacing[::-1])
            picture = view(painted(ball, shape, np.diag([*spacing, 1.0])), opacity=opacity, shade=shade)
            means.append(picture[40:80, 15:45].mean(axis=(0, 1)))
        np.testing.assert_allclose(means, np.broadcast_to(means[0], (4, 3)), atol=8)


def test_a_body_twice_as_large_looks_the_same(gl):
    pictures = [
        view(painted(two_colour_ball(18.0 * scale), (40, 40, 40), np.diag([scale] * 3 + [1.0])), opacity=0.4)
        for scale in (1.0, 2.0)
    ]
    assert np.abs(pictures[0].astype(int) - pictures[1]).max() <= 2


def test_thick_slices_keep_the_body_round(gl):
    volume = painted(two_colour_ball(24.0), (28, 56, 56), np.diag([1.0, 1.0, 2.0, 1.0]))
    seen = view(volume, size=(150, 120)).any(axis=-1)
    rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
    height, width = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert abs(height / width - 1) < 0.08  # 2 mm more on both sides of 48 mm, against a factor of 2


def test_a_ramp_of_three_voxels_shows_no_terraces(gl):
    """A skin mixed with air over three voxels: the surface passes from one to the next, its colour does not change."""
    k, j, i = np.mgrid[:48, :48, :48] - 23.5
    share = np.clip(-(np.sqrt(k**2 + j**2 + i**2) - 19) / 3, 0.12, 1) * (np.sqrt(k**2 + j**2 + i**2) < 19)
    rgb = np.rint(np.array(ORANGE) * share[..., None]).astype(np.uint8)
    picture = view(ColorVolume(rgb, np.eye(4)), opacity=0.9).astype(int)
    y, x = np.mgrid[:120, :120] - 59.5
    inside = np.hypot(x, y) < 42
    assert np.abs(picture[inside] - ORANGE).max() <= 16


@pytest.mark.parametrize("dtype", ["u1", "i1", "<i2", ">i2", "<u2", "<i4", "<f4"])
def test_values_by_table_are_those_of_the_function(dtype, rng):
    kind = np.dtype(dtype)
    ends = (-1e4, 1e4) if kind.kind == "f" or kind.itemsize > 2 else (np.iinfo(kind).min, np.iinfo(kind).max)
    values = rng.uniform(*ends, (40, 30)).astype(kind)
    values[0, :2] = ends
    shown = grid.by_table(lambda some: np.rint(some.astype(np.float64) / 7).astype(np.int32), kind)
    np.testing.assert_array_equal(shown(values), np.rint(values.astype(np.float64) / 7))
