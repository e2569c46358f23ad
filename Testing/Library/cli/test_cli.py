"""The command line, run in this process: what it writes, prints and returns, and that interruption leaves nothing."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from one_signal import sends_once
from volume_samples import save_nrrd

from MedColorLib import __version__, phantom, read_color_volume, read_volume, rendering
from MedColorLib.cli.main import main
from MedColorLib.errors import DeviceError, WeightsError
from MedColorLib.matching import vote
from MedColorLib.parameters import Settings

pytestmark = pytest.mark.usefixtures("small_raster", "without_weights")
ROOT = Path(__file__).resolve().parents[3]
COMMANDS = ("colorize", "batch", "render", "recommend", "library", "weights", "demo", "bench")


@pytest.fixture
def without_weights(monkeypatch, tmp_path_factory):
    """No setting and no weights of the developer's own."""
    monkeypatch.delenv("MEDCOLOR_WEIGHTS", raising=False)
    empty = tmp_path_factory.mktemp("cache")
    monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: empty)


@pytest.fixture
def files(ct, tmp_path, monkeypatch):
    """Working folder with ct.nrrd (5 slices) and section.png; returns the names that lie there now."""
    save_nrrd(tmp_path / "ct.nrrd", ct.volume.array[3:8], ct.volume.ijk_to_ras)
    cv2.imwrite(str(tmp_path / "section.png"), ct.reference[..., ::-1])
    monkeypatch.chdir(tmp_path)
    before = {path.name for path in tmp_path.iterdir()}
    return lambda: {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} - before


def medcolor(*arguments) -> int:
    """Exit status of the command."""
    try:
        return main([str(a) for a in arguments])
    except SystemExit as end:
        return end.code


COLORIZE = ("colorize", "ct.nrrd", "-r", "section.png", "--preset", "draft", "--features", "embedded")


@pytest.fixture(scope="session")
def gl():
    """OpenGL without a display, or a skip."""
    from MedColorLib.rendering import offscreen

    try:
        offscreen.working_window()
    except DeviceError as error:
        pytest.skip(str(error))


class TestColorize:
    @pytest.mark.parametrize("name", ["out.nrrd", "out.nii.gz", "out.nii"])
    def test_volume_and_report(self, files, name, capsys):
        assert medcolor(*COLORIZE, "-o", name, "--report", "report.json") == 0
        assert files() == {name, "report.json"}
        volume, colored = read_volume("ct.nrrd"), read_color_volume(name)
        assert colored.rgb.shape == (*volume.array.shape, 3) and colored.rgb.any()
        if name == "out.nrrd":
            assert colored.ijk_to_ras.tobytes() == volume.ijk_to_ras.tobytes()
        report = json.loads(Path("report.json").read_text(encoding="utf-8"))
        assert len(report["input"]["file_sha256"]) == 64 and report["settings"]["features"] == "embedded"
        printed = capsys.readouterr()
        assert "5 slices with embedded features" in printed.out and "not a measurement" in printed.out
        assert printed.err == ""

    def test_same_as_the_python_call(self, files, ct):
        from MedColorLib import colorize

        assert medcolor(*COLORIZE, "-o", "out.nrrd", "--window", "-200", "300", "--slices", "1:4") == 0
        settings = Settings(preset="draft", features="embedded", window=(-200, 300), slices=(1, 4))
        expected = colorize(read_volume("ct.nrrd"), ["section.png"], settings)
        np.testing.assert_array_equal(read_color_volume("out.nrrd").rgb, expected.rgb)

    def test_every_option_reaches_the_settings(self, files):
        line = (
            "--smoother guided --luminance paper --gamma on --seed 7 --device cpu --plane acquired --slices 1:2 "
            "--window 0 100 --region 0 5 0 64 0 56 --coherence 1.5 --reconstruction warp"
        )
        assert medcolor(*COLORIZE, "-o", "out.nrrd", "--report", "r.json", *line.split()) == 0
        report = json.loads(Path("r.json").read_text())
        expected = Settings(
            preset="draft",
            features="embedded",
            smoother="guided",
            luminance="paper",
            gamma=True,
            seed=7,
            device="cpu",
            plane="acquired",
            slices=(1, 2),
            window=(0, 100),
            region=((0, 5), (0, 64), (0, 56)),
            coherence_mm=1.5,
        )
        assert Settings.from_dict(report["settings"]) == expected

    def test_lightness_is_of_natural_luminance_alone(self, files, capsys):
        assert medcolor(*COLORIZE, "-o", "out.nrrd", "--luminance", "keep", "--lightness", "0.3") == 2
        assert "--lightness belongs to --luminance natural; leave it out with keep" in capsys.readouterr().err
        assert not files()

    def test_gamma_is_the_presets_unless_given(self, files):
        for given, expected in (((), None), (("--gamma", "on"), True), (("--gamma", "off"), False)):
            assert medcolor(*COLORIZE, "-o", "o.nrrd", "--report", "r.json", "--slices", "1:2", *given) == 0
            assert json.loads(Path("r.json").read_text())["settings"]["gamma"] is expected

    def test_several_references_and_a_folder(self, files):
        Path("more").mkdir()
        cv2.imwrite("more/high.png", phantom.section(0.55)[..., ::-1])
        assert medcolor(*COLORIZE, "-r", "more", "-o", "out.nrrd", "--report", "r.json") == 0
        assert [r["name"] for r in json.loads(Path("r.json").read_text())["references"]] == ["section", "high"]

    def test_a_former_result_is_replaced(self, files):
        Path("out.nrrd").write_bytes(b"former")
        assert medcolor(*COLORIZE, "-o", "out.nrrd") == 0
        assert read_color_volume("out.nrrd").rgb.any() and files() == {"out.nrrd"}

    def test_plan_is_printed_and_nothing_written(self, files, capsys):
        assert medcolor(*COLORIZE, "--plan") == 0
        text = capsys.readouterr().out
        assert (
            text.startswith("Plan\n")
            and "Left out\n" in text
            and "MedColor's own network (no download), one layer" in text
        )
        assert not files()


@pytest.fixture
def interruptible():
    """Ctrl-C raises KeyboardInterrupt, also where the tests were started in the background, which ignores it."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


@pytest.mark.usefixtures("interruptible")
class TestInterruption:
    def test_ctrl_c_while_computing(self, files, monkeypatch, capfd):
        monkeypatch.setattr(vote, "matched_colors", sends_once(signal.SIGINT))
        assert medcolor(*COLORIZE, "-o", "out.nrrd", "--report", "report.json") == 130
        assert capfd.readouterr().err == "medcolor: interrupted; nothing was written\n"
        assert not files()

    def test_ctrl_c_while_writing(self, files, monkeypatch, capfd):
        Path("out.nrrd").write_bytes(b"former")

        def interrupted(name, *_, **__):
            Path(name).write_bytes(b"half")
            signal.raise_signal(signal.SIGINT)

        monkeypatch.setattr("nrrd.write", interrupted)
        assert medcolor(*COLORIZE, "-o", "out.nrrd", "--report", "report.json") == 130
        assert files() == {"out.nrrd"} and Path("out.nrrd").read_bytes() == b"former"

    def test_the_reader_of_the_output_went_away(self, files, monkeypatch):
        def closed(*_, **__):
            raise BrokenPipeError

        monkeypatch.setattr("builtins.print", closed)
        assert medcolor(*COLORIZE, "--plan") == 0


class TestRender:
    def test_picture(self, files, gl):
        assert medcolor(*COLORIZE, "-o", "out.nrrd") == 0
        assert medcolor("render", "out.nrrd", "-o", "sheet.png", "--grey", "ct.nrrd", "--size", "480", "360") == 0
        picture = cv2.imread("sheet.png")
        assert picture.shape == (360, 480, 3) and np.ptp(picture) > 100
        assert files() == {"out.nrrd", "sheet.png"}


class TestRecommend:
    def test_best_first(self, files, ct, capsys):
        Path("library").mkdir()
        for name, level in (("eyes", -0.45), ("top", 0.75)):
            cv2.imwrite(f"library/{name}.png", phantom.section(level)[..., ::-1])
        options = ("--features", "embedded", "--device", "cpu", "--top", "2", "--slice", "1")
        assert medcolor("recommend", "ct.nrrd", "--library", "library", *options) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [Path(line.split()[1]).stem for line in lines] == ["eyes", "top"]
        scores = [float(line.split()[0]) for line in lines]
        assert 1 >= scores[0] > scores[1]


class TestWeights:
    def test_status(self, capsys):
        assert medcolor("weights", "status") == 0
        text = capsys.readouterr().out
        assert "vgg19" in text and "gray-vgg19" in text and "not here" in text and "MEDCOLOR_WEIGHTS" in text

    def test_fetch(self, monkeypatch, capsys, tmp_path):
        def fetch(network, progress):
            progress(5, 10)
            return tmp_path / f"{network}.safetensors"

        monkeypatch.setattr("MedColorLib.features.weights.fetch_weights", fetch)
        assert medcolor("weights", "fetch") == 0
        assert capsys.readouterr().out == f"{tmp_path / 'vgg19.safetensors'}\n"

    def test_failed_fetch(self, monkeypatch, capsys):
        def fetch(network, progress):
            raise WeightsError("vgg19: the server is away; try again later")

        monkeypatch.setattr("MedColorLib.features.weights.fetch_weights", fetch)
        assert medcolor("weights", "fetch", "vgg19") == 2
        assert capsys.readouterr().err == "medcolor: vgg19: the server is away; try again later\n"


class TestDemo:
    def test_everything_is_written_without_any_download(self, ct, tmp_path, monkeypatch, capsys, gl):
        monkeypatch.setattr(
            phantom, "series", lambda: (ct.volume, [phantom.section(level) for level in phantom.SERIES_LEVELS])
        )
        small = partial(rendering.render_to_png, size=(480, 360))
        monkeypatch.setattr(rendering, "render_to_png", small)
        assert medcolor("demo", "-o", tmp_path / "new" / "demo") == 0
        said = capsys.readouterr()
        written = [Path(line).name for line in said.out.splitlines()]
        assert sorted(written) == sorted(p.name for p in (tmp_path / "new" / "demo").iterdir())
        assert all(name in said.err for name in written)  # what to see in which
        assert {"photograph_1.png", "photograph_5.png", "colored.nrrd", "report.json", "picture.png"} <= set(written)
        assert read_color_volume(tmp_path / "new" / "demo" / "colored.nrrd").rgb.any()

    def test_folder_that_cannot_be_made(self, tmp_path, capsys):
        (tmp_path / "file").write_text("in the way")
        assert medcolor("demo", "-o", tmp_path / "file") == 2
        assert "demo folder" in capsys.readouterr().err


class TestHelp:
    def test_version(self, capsys):
        assert medcolor("--version") == 0
        assert capsys.readouterr().out == f"medcolor {__version__}\n"

    @pytest.mark.parametrize(
        "command", [(), *((name,) for name in COMMANDS), ("weights", "fetch"), ("weights", "status")]
    )
    def test_help_of_every_command(self, command, capsys):
        assert medcolor(*command, "--help") == 0
        text = capsys.readouterr().out
        assert text.startswith(f"usage: {' '.join(('medcolor', *command))}")
        if not command:
            assert all(name in text for name in COMMANDS)

    def test_as_a_module(self):
        done = subprocess.run(
            [sys.executable, "-m", "MedColorLib", "--version"], capture_output=True, text=True, cwd=ROOT, check=False
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, f"medcolor {__version__}\n", "")

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ((), "the following arguments are required: COMMAND"),
            (("paint",), "invalid choice: 'paint'"),
            (("colorize", "ct.nrrd"), "the following arguments are required: -r"),
            (("colorize", "a", "-r", "b", "--preset", "best"), "argument --preset: invalid choice: 'best'"),
            (("colorize", "a", "-r", "b", "--window", "1"), "argument --window: expected 2 arguments"),
            (("colorize", "a", "-r", "b", "--window", "x", "2"), "invalid float value: 'x'"),
            (("colorize", "a", "-r", "b", "--slices", "3"), "expected A:B with whole numbers, got '3'"),
            (("colorize", "a", "-r", "b", "--slices", "-1:3"), "--slices"),
            (("colorize", "a", "-r", "b", "--bogus"), "unrecognized arguments: --bogus"),
            (("render",), "the following arguments are required: VOLUME"),
            (("weights", "fetch", "resnet"), "invalid choice: 'resnet'"),
        ],
    )
    def test_wrong_arguments_in_one_line(self, arguments, message, capsys):
        assert medcolor(*arguments) == 2
        printed = capsys.readouterr()
        assert printed.out == "" and printed.err.count("\n") == 1
        assert printed.err.startswith("medcolor") and message in printed.err and "--help" in printed.err
