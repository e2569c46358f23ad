"""Light, single views and turns from the command line."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from rendering_samples import ORANGE, SOLID, centred, painted, six_balls, two_colour_ball

from MedColorLib import read_color_volume, write_color_volume
from MedColorLib.cli import options, pictures
from MedColorLib.cli.main import main
from MedColorLib.errors import MissingPackageError, OutputError, SettingsError
from MedColorLib.rendering import VIEWS, lights, render_view, turntable
from MedColorLib.volume import ColorVolume

SMALL = (48, 48)


def read(path):
    import cv2

    return cv2.imread(str(path))[..., ::-1]


def read_film(path):
    """Its pictures, by another library than the one that writes them."""
    import cv2

    film, frames = cv2.VideoCapture(str(path)), []
    while True:
        there, frame = film.read()
        if not there:
            film.release()
            return frames
        frames.append(frame)


@pytest.fixture
def ball():
    return painted(two_colour_ball(), (48, 48, 48))


def test_realistic_light_is_as_bright_and_comes_from_one_side(gl, ball):
    plain, lit = (render_view(ball, size=(96, 96), opacity=SOLID, light=light) for light in lights.LIGHTS)
    seen = plain.max(axis=-1) > 8
    assert lit[seen].mean() == pytest.approx(plain[seen].mean(), rel=0.08)
    upper, lower = lit[20:36, 40:56].mean(), lit[60:76, 40:56].mean()
    assert upper > 1.1 * lower
    assert abs(plain[20:36, 40:56].mean() - plain[60:76, 40:56].mean()) < 8


def test_realistic_light_without_shadows_in_old_versions(gl, ball, monkeypatch, caplog):
    monkeypatch.setattr(lights, "has_shadows", lambda mapper: False)
    caplog.set_level("INFO", "MedColorLib")
    picture = render_view(ball, size=SMALL, opacity=SOLID, light="realistic")
    assert picture.max() > 100
    assert "no shadows" in caplog.text


def test_unknown_light_is_refused():
    with pytest.raises(SettingsError, match="plain, realistic"):
        lights.check_light("sun")


def test_turn_begins_at_the_view_and_comes_round(gl, tmp_path):
    body = painted(six_balls, (44, 44, 44))
    folder = turntable(tmp_path / "turn", body, "anterior", SMALL, frames=4, opacity=SOLID)
    frames = [read(path).astype(int) for path in sorted(folder.iterdir())]
    assert [path.name for path in sorted(folder.iterdir())] == [f"frame-{n:04d}.png" for n in range(4)]
    for frame, side in zip(frames, ((90, 90, 240), (60, 200, 60), (220, 200, 40), (230, 60, 60))):
        centre = frame[20:28, 20:28].reshape(-1, 3).mean(axis=0)
        assert (
            np.argmax(centre) == np.argmax(side)
            or np.abs(centre / centre.max() - np.array(side) / max(side)).max() < 0.2
        )


@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_films_can_be_read_again(gl, tmp_path, ball, kind):
    pytest.importorskip("imageio.v2", reason="imageio is not installed")
    path = turntable(tmp_path / f"turn.{kind}", ball, size=SMALL, frames=5, opacity=SOLID)
    frames = read_film(path)
    assert len(frames) == 5
    assert frames[0].shape[:2] == SMALL
    assert frames[0][..., :3].max() > 100
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("name", "options_", "error"),
    [
        ("a.avi", {}, OutputError),
        ("absent/a.mp4", {}, OutputError),
        ("a.mp4", {"size": (47, 48)}, SettingsError),
        ("a.mp4", {"frames": 1}, SettingsError),
        ("full", {}, OutputError),
    ],
)
def test_turns_that_cannot_be_written(tmp_path, ball, name, options_, error):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "something").touch()
    with pytest.raises(error):
        turntable(tmp_path / name, ball, **{"size": SMALL, **options_})


def test_without_imageio_the_remedy_is_said(tmp_path, ball, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio", None)
    monkeypatch.setitem(sys.modules, "imageio.v2", None)
    with pytest.raises(MissingPackageError, match=r"medcolor\[film\].*folder"):
        turntable(tmp_path / "a.gif", ball, size=SMALL)


def test_stopped_turn_leaves_nothing(gl, tmp_path, ball):
    class Stop(Exception):
        pass

    def stop(fraction, _text):
        if fraction > 0.3:
            raise Stop

    with pytest.raises(Stop):
        turntable(tmp_path / "turn", ball, size=SMALL, frames=4, progress=stop)
    assert not list(tmp_path.iterdir())


def test_black_volume_cannot_turn(gl, tmp_path):
    black = ColorVolume(np.zeros((4, 4, 4, 3), np.uint8), centred(np.eye(4), (4, 4, 4)))
    with pytest.raises(SettingsError, match="nothing to see"):
        turntable(tmp_path / "turn", black, size=SMALL)


# --- the command --------------------------------------------------------------------------------------------------------


@pytest.fixture
def file(tmp_path, ball):
    write_color_volume(ball, tmp_path / "ball.nrrd")
    return str(tmp_path / "ball.nrrd")


def test_single_view_with_cut_opacity_and_light(gl, tmp_path, file, capsys):
    out = tmp_path / "view.png"
    command = ["render", file, "-o", str(out), "--view", "anterior", "--size", "80", "60", "--opacity", "0.9"]
    assert main([*command, "--cut", "left", "--light", "realistic"]) == 0
    picture = read(out)
    assert picture.shape == (60, 80, 3)
    assert picture[30, 30].max() > 60
    seen = picture.reshape(-1, 3)[picture.max(axis=-1).ravel() > 60].astype(float)
    hue = seen / seen.max(axis=1, keepdims=True)
    assert np.abs(hue.mean(axis=0) - np.array(ORANGE) / max(ORANGE)).max() < 0.15, "the patient's right is what is left"
    assert str(out) in capsys.readouterr().out


def test_turntable_alone(gl, tmp_path, file):
    assert main(["render", file, "--turntable", str(tmp_path / "turn"), "--size", "32", "32"]) == 0
    assert len(list((tmp_path / "turn").iterdir())) == 72


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "-o OUT.png"),
        (["-o", "x.jpg", "--view", "left"], "PNG"),
        (["-o", "x.png", "--cut", "left", "right"], "both sides"),
        (["-o", "x.png", "--view", "left", "--titles", "a", "b"], "belong to the sheet"),
        (["-o", "x.png", "--view", "left", "--opacity", "2"], "opacity"),
        (["-o", "x.png", "--view", "left", "--size", "9", "99999"], "picture size"),
    ],
)
def test_wrong_arguments_are_one_line(file, arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["render", file, *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error


def test_choices_are_those_of_the_library(ball, file):
    assert tuple(VIEWS) == options._VIEWS
    assert {pictures.cut_from([side], ball).planes[0][0] for side in pictures.SIDES} == {
        tuple(float(n) for n in sign * np.eye(3)[axis]) for axis, sign in pictures.SIDES.values()
    }
    assert read_color_volume(file).rgb.shape == ball.rgb.shape
