"""Rendering: sections and the sheet."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rendering_samples import (
    OBLIQUE,
    SIDES,
    distance,
    painted,
    six_balls,
    two_colour_ball,
    view,
)

from MedColorLib.errors import DeviceError, InputError, OutputError, SettingsError
from MedColorLib.rendering import (
    contact_sheet,
    offscreen,
    render_to_png,
    sections,
    shaders,
    sheet,
    surface,
)
from MedColorLib.rendering.sections import section_frame
from MedColorLib.volume import ColorVolume, Volume


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
    monkeypatch.setattr(shaders, "CUBE_NORMALS", ("void main()", "this is no shader"))
    with pytest.raises(DeviceError, match="driver failed"):
        view(pair[1])


def test_the_sheet_shows_the_scan_whole(gl, pair):
    """What the colours left out of the body stands beside them: half of a ball is black, the scan's is not."""
    grey, color = pair
    lost = color.rgb.copy()
    lost[:, :, : lost.shape[2] // 2] = 0
    halves = []
    for rgb in (color.rgb, lost):
        picture = contact_sheet(grey, ColorVolume(rgb, color.ijk_to_ras), size=(800, 600), centre=None)
        panels = sheet.Sheet((800, 600), (2, 3), ("a", "b"), "")
        width, height = panels.panel_size
        x, y = panels._corner(3, 0)  # the coronal section of the scan
        part = picture[y : y + height, x : x + width]
        halves.append(np.count_nonzero(part.max(axis=-1) > 60))
    assert halves[1] > 0.9 * halves[0]
