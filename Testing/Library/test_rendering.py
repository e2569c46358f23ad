"""Rendering: colours come out as themselves, from the right side, at the right size, and files are whole or absent."""

from __future__ import annotations

import logging
import subprocess
import sys
from itertools import permutations, product
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from MedColorLib.errors import DeviceError, InputError, OutputError, SettingsError
from MedColorLib.rendering import (
    VIEWS,
    Cut,
    contact_sheet,
    corner_cut,
    grey_color_volume,
    grid,
    offscreen,
    presets,
    render_to_png,
    render_view,
    sections,
    sheet,
    surface,
)
from MedColorLib.rendering.sections import section_frame
from MedColorLib.volume import ColorVolume, Volume

ROOT = Path(__file__).resolve().parents[2]
ORANGE, BLUE = (200, 120, 60), (60, 120, 200)
RAS_DIAGONAL = np.diag([-1.0, -1.0, 1.0, 1.0])  # the usual file: LPS, right-handed


@pytest.fixture(scope="module")
def gl():
    """Skips where nothing can be drawn; the reason names the packages to install."""
    try:
        offscreen.working_window()
    except DeviceError as error:
        pytest.skip(str(error))


def centred(matrix, shape_kji):
    """The matrix with its translation chosen so that the array's middle lies at RAS 0."""
    matrix = np.array(matrix, dtype=float)
    matrix[:3, 3] = -matrix[:3, :3] @ ((np.array(shape_kji[::-1]) - 1) / 2)
    return matrix


def painted(paint, shape_kji, matrix=RAS_DIAGONAL):
    """A volume whose voxel colours are `paint(r, a, s)` at the voxels' RAS positions."""
    matrix = centred(matrix, shape_kji)
    k, j, i = np.meshgrid(*[np.arange(n) for n in shape_kji], indexing="ij")
    r, a, s = (matrix[row, 0] * i + matrix[row, 1] * j + matrix[row, 2] * k + matrix[row, 3] for row in range(3))
    return ColorVolume(paint(r, a, s).astype(np.uint8), matrix)


def two_colour_ball(radius_mm=18.0, left=BLUE, right=ORANGE):
    def paint(r, a, s):
        inside = r**2 + a**2 + s**2 < radius_mm**2
        return np.where(inside[..., None], np.where((r > 0)[..., None], right, left), 0)

    return paint


SIDES = {  # six balls on the axes, each of a colour of its own
    "R": ((1, 0, 0), (230, 60, 60)),
    "L": ((-1, 0, 0), (60, 200, 60)),
    "A": ((0, 1, 0), (90, 90, 240)),
    "P": ((0, -1, 0), (220, 200, 40)),
    "S": ((0, 0, 1), (200, 60, 200)),
    "I": ((0, 0, -1), (60, 200, 200)),
}


def six_balls(r, a, s):
    rgb = np.zeros((*r.shape, 3))
    for axis, colour in SIDES.values():
        centre = 14.0 * np.array(axis)
        rgb[(r - centre[0]) ** 2 + (a - centre[1]) ** 2 + (s - centre[2]) ** 2 < 5.5**2] = colour
    return rgb


def view(volume, name="anterior", size=(120, 120), **kwargs):
    return render_view(volume, name, size, **{"shade": False, **kwargs})


def lit(colour):
    """What a surface that faces the lamp shows: all three Phong terms."""
    share = presets.AMBIENT + presets.DIFFUSE
    return np.minimum(share * np.array(colour) + presets.SPECULAR * 255, 255)


def distance(pixel, colour):
    return np.abs(pixel.astype(int) - np.array(colour)).max()


# --- numbers -----------------------------------------------------------------------------------------------------


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


# --- voxels ------------------------------------------------------------------------------------------------------


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


# --- drawing -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("opacity", [0.7, presets.DEFAULT_OPACITY, 1.0])
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


def directions():
    """Of the 48 storage orders and signs, right- and left-handed, every seventh: enough to meet all axes."""
    chosen = []
    for order, signs in list(product(permutations(range(3)), product((-1, 1), repeat=3)))[::7]:
        matrix = np.zeros((4, 4))
        matrix[3, 3] = 1
        for column, (row, sign) in enumerate(zip(order, signs)):
            matrix[row, column] = sign
        chosen.append(pytest.param(matrix, id=f"{order}{signs}"))
    return chosen


@pytest.mark.parametrize("matrix", directions())
def test_storage_order_and_handedness_do_not_matter(gl, matrix):
    reference = view(painted(six_balls, (42, 42, 42)), "oblique", (80, 80), shade=True).astype(int)
    picture = view(painted(six_balls, (42, 42, 42), matrix), "oblique", (80, 80), shade=True).astype(int)
    difference = np.abs(picture - reference)
    assert difference.mean() < 0.3
    assert (difference > 8).mean() < 0.002  # single pixels on an edge, where rounding decides


def rotation(axis, degrees):
    axis = np.array(axis, float) / np.linalg.norm(axis)
    cross = np.cross(np.eye(3), axis)
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


OBLIQUE = {
    "rotated": rotation((1, 2, 3), 35),
    "rotated left-handed": rotation((3, -1, 2), 50) @ np.diag([1, 1, -1]),
    "sheared": np.array([[1, 0.3, 0], [0, 1, 0.2], [0, 0, 1]]),
    "anisotropic": rotation((1, 0, 1), 20) @ np.diag([0.7, 0.7, 1.5]),
}


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
    with caplog.at_level(logging.INFO, "MedColor"):
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


# --- cuts --------------------------------------------------------------------------------------------------------


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
        np.testing.assert_array_equal(kept.rgba[..., :3], prepared.rgba[..., :3])
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


# --- sections ----------------------------------------------------------------------------------------------------


def test_sections_of_a_straight_volume_are_its_slices():
    rng = np.random.default_rng(1)
    rgb = rng.integers(1, 256, (9, 11, 13, 3), dtype=np.uint8)  # nothing black: frame = volume
    volume = ColorVolume(rgb, np.eye(4))  # i to the right, j to the front, k to the head
    found = sections(volume)
    np.testing.assert_array_equal(found["transverse"], rgb[4, ::-1, ::-1])
    np.testing.assert_array_equal(found["coronal"], rgb[::-1, 5, ::-1])
    np.testing.assert_array_equal(found["sagittal"], rgb[::-1, ::-1, 6])


def test_sections_are_radiological_whatever_the_grid():
    expected = {"transverse": "RLAP", "coronal": "RLSI", "sagittal": "APSI"}  # left, right, top, bottom
    for directions in (np.diag([-1.0, -1, 1]), *OBLIQUE.values()):
        matrix = np.eye(4)
        matrix[:3, :3] = directions
        found = sections(painted(six_balls, (72, 72, 72), matrix))
        for name, sides in expected.items():
            picture = found[name]
            height, width = picture.shape[:2]
            assert abs(height / width - 1) < 0.06  # voxels at the ends
            away = 14 / 39
            places = [(0.5, 0.5 - away), (0.5, 0.5 + away), (0.5 - away, 0.5), (0.5 + away, 0.5)]
            for side, (y, x) in zip(sides, places):
                pixel = picture[int(y * height), int(x * width)]
                assert distance(pixel, SIDES[side][1]) <= 4, (name, side)


def test_sections_of_thick_slices_have_square_pixels():
    found = sections(painted(two_colour_ball(24.0), (18, 56, 56), np.diag([1.0, 1.0, 3.0, 1.0])))
    for picture in found.values():
        rows, columns = (np.flatnonzero(picture.any(axis=-1).any(axis=axis)) for axis in (1, 0))
        assert abs(np.ptp(rows) - np.ptp(columns)) <= 3


def test_grey_and_colour_share_a_frame():
    color = painted(two_colour_ball(), (40, 40, 40))
    grey = Volume(surface.luminance_alpha(color.rgb).astype(np.int16), color.ijk_to_ras)
    frame = section_frame(color)
    for name, picture in sections(grey, window=(0, 255), frame=frame).items():
        assert picture.shape == sections(color, frame=frame)[name].shape
        assert (picture == picture[..., :1]).all()


def test_the_centre_can_be_chosen():
    color = painted(six_balls, (42, 42, 42))
    top = sections(color, frame=section_frame(color, (0.5, 0.5, 0.88)))["transverse"]
    height, width = top.shape[:2]
    assert distance(top[height // 2, width // 2], SIDES["S"][1]) <= 2
    with pytest.raises(SettingsError):
        section_frame(color, (0.5, 0.5, 1.5))


# --- the sheet ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pair():
    color = painted(lambda r, a, s: two_colour_ball()(r + 4, a, s), (32, 32, 40))
    scalars = surface.luminance_alpha(color.rgb).astype(np.int16) + 100
    return Volume(scalars, color.ijk_to_ras, window=(100, 300)), color


def test_the_sheet_shows_grey_beside_colour(gl, pair):
    picture = contact_sheet(*pair, size=(800, 600))
    assert picture.shape == (600, 800, 3)
    panels = sheet.Sheet((800, 600), (2, 3), ("a", "b"), "")
    width, height = panels.panel_size
    for cell in range(6):
        for panel, coloured in ((0, False), (1, True)):
            x, y = panels._corner(cell, panel)
            part = picture[y : y + height, x : x + width].astype(int)
            assert part[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3].max() > 40
            chroma = np.ptp(part, axis=-1).max()
            assert chroma > 50 if coloured else chroma <= 20  # labels are not quite neutral


def test_a_sheet_without_grey_has_six_panels(gl, pair):
    assert contact_sheet(None, pair[1], size=(640, 480)).shape == (480, 640, 3)


def test_the_sheet_refuses_volumes_that_do_not_belong_together(pair):
    grey, color = pair
    with pytest.raises(InputError, match="voxels"):
        contact_sheet(Volume(grey.array[1:], grey.ijk_to_ras), color)
    moved = np.array(grey.ijk_to_ras)
    moved[0, 3] += 1
    with pytest.raises(InputError, match="places"):
        contact_sheet(Volume(grey.array, moved), color)
    with pytest.raises(InputError):
        contact_sheet(grey.array, color)


@pytest.mark.parametrize("arguments", [{"size": (100, 100)}, {"opacity": 2.0}, {"centre": (0, 0, 9)}])
def test_the_sheet_refuses_settings_out_of_range(pair, arguments):
    with pytest.raises(SettingsError):
        contact_sheet(*pair, **arguments)


def test_the_file_is_the_sheet(gl, pair, tmp_path):
    grey, color = pair
    path = render_to_png(tmp_path / "a.png", color, grey, (480, 360))
    written = cv2.imread(str(path))[..., ::-1]
    np.testing.assert_array_equal(written, contact_sheet(grey, color, (480, 360)))
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize("problem", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_nothing_unfinished_is_left(tmp_path, monkeypatch, problem):
    target = tmp_path / "a.png"
    target.write_bytes(b"older")

    def fail(*_):
        raise problem

    monkeypatch.setattr(sheet.os, "replace", fail)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        sheet.write_png(target, np.zeros((4, 4, 3), np.uint8))
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    assert target.read_bytes() == b"older"


@pytest.mark.parametrize("name", ["a.jpg", "a", "missing/a.png"])
def test_names_that_cannot_be_written_are_refused_before_drawing(tmp_path, monkeypatch, pair, name):
    monkeypatch.setattr(sheet, "contact_sheet", lambda *_, **__: pytest.fail("drawn first"))
    with pytest.raises(OutputError):
        render_to_png(tmp_path / name, pair[1])


# --- trouble -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments", [{"name": "front"}, {"size": (0, 5)}, {"size": (9, 99999)}, {"opacity": 3.0}, {"voxel_budget": 0}]
)
def test_views_refuse_settings_out_of_range(arguments):
    with pytest.raises(SettingsError):
        view(painted(six_balls, (42, 42, 42)), **arguments)


def test_without_opengl_the_error_names_the_packages(monkeypatch, pair):
    """EGL without any driver ends the probing process; ours goes on."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", "/nonexistent")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(offscreen, "_window_names", lambda: ["vtkEGLRenderWindow"])
    offscreen.working_window.cache_clear()
    try:
        with pytest.raises(DeviceError, match="libegl1 libgl1 libgl1-mesa-dri"):
            view(pair[1])
    finally:
        offscreen.working_window.cache_clear()


def test_an_error_of_the_driver_is_raised(gl, monkeypatch, pair):
    """VTK would go on and leave a black picture."""
    monkeypatch.setattr(presets, "NORMAL_FROM_COMPONENT", "void main()")
    monkeypatch.setattr(presets, "NORMAL_FROM_ALPHA", "this is no shader")
    with pytest.raises(DeviceError, match="driver failed"):
        view(pair[1])
