"""Commands that are ended by signals, links and earlier files where results go, and terminals of all kinds."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from one_signal import sends_once
from PIL import Image
from volume_samples import save_nrrd

from MedColorLib import read_color_volume
from MedColorLib.cli.main import main
from MedColorLib.cli.stopping import Stopped, stoppable
from MedColorLib.cohort.batch import find_volumes
from MedColorLib.cohort.terminal import plain
from MedColorLib.errors import InputError, OutputError
from MedColorLib.matching import vote
from MedColorLib.output import atomic_output, check_output_path
from MedColorLib.references.library import add_library
from MedColorLib.references.loading import load_references
from MedColorLib.report import write_report

pytestmark = pytest.mark.usefixtures("small_raster")
ROOT = Path(__file__).resolve().parents[3]
COLORIZE = ("colorize", "ct.nrrd", "-r", "section.png", "--preset", "draft", "--features", "embedded")
SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


@pytest.fixture
def files(ct, tmp_path, monkeypatch):
    """Working folder with ct.nrrd (5 slices) and section.png; returns the names that lie there now."""
    monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: tmp_path.parent / "cache")
    save_nrrd(tmp_path / "ct.nrrd", ct.volume.array[3:8], ct.volume.ijk_to_ras)
    cv2.imwrite(str(tmp_path / "section.png"), ct.reference[..., ::-1])
    monkeypatch.chdir(tmp_path)
    before = {path.name for path in tmp_path.iterdir()}
    return lambda: {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} - before


@pytest.fixture
def default_signals():
    """As in the foreground: under nohup SIGHUP is ignored, and stays so."""
    former = {number: signal.signal(number, signal.SIG_DFL) for number in SIGNALS}
    yield
    for number, handler in former.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("default_signals")
class TestSignals:
    @pytest.mark.parametrize("number", SIGNALS)
    def test_while_computing_and_while_writing(self, files, number, monkeypatch, capfd):
        with monkeypatch.context() as patch:
            patch.setattr(vote, "matched_colors", sends_once(number))
            assert main([*COLORIZE, "-o", "out.nrrd"]) == 128 + number
        assert capfd.readouterr().err == "medcolor: interrupted; nothing was written\n" and not files()

        def interrupted(name, *_, **__):
            Path(name).write_bytes(b"half")
            signal.raise_signal(number)

        Path("out.nrrd").write_bytes(b"former")
        monkeypatch.setattr("nrrd.write", interrupted)
        assert main([*COLORIZE, "-o", "out.nrrd"]) == 128 + number
        assert files() == {"out.nrrd"} and Path("out.nrrd").read_bytes() == b"former"
        assert "replaced" not in capfd.readouterr().err

    @pytest.mark.parametrize("number", SIGNALS)
    def test_as_they_were_afterwards(self, number):
        with pytest.raises(Stopped), stoppable():
            signal.raise_signal(number)
        assert signal.getsignal(number) == signal.SIG_DFL

    def test_who_ignores_them_goes_on(self):
        former = signal.signal(SIGNALS[-1], signal.SIG_IGN)  # as nohup does
        try:
            with stoppable():
                signal.raise_signal(SIGNALS[-1])
        finally:
            signal.signal(SIGNALS[-1], former)

    def test_in_another_thread_nothing_is_touched(self):
        seen = []

        def run():
            with stoppable():
                seen.append(signal.getsignal(SIGNALS[0]))

        thread = threading.Thread(target=run)
        thread.start()
        thread.join()
        assert seen == [signal.SIG_DFL]

    def test_a_process_of_its_own(self, files):
        """From outside: the process ends with 143 and leaves nothing."""
        code = (
            "import os, signal, sys\n"
            "from MedColorLib.matching import analogy\n"
            "once = [True]\n"  # side by side, others may come here, too, while the first signal is being heeded
            "def killed(*_, **__):\n"
            "    if once: once.pop(); os.kill(os.getpid(), signal.SIGTERM)\n"
            "analogy.deep_image_analogy = killed\n"
            "from MedColorLib.cli.main import main\n"
            "sys.exit(main(sys.argv[1:]))"
        )
        command = [sys.executable, "-c", code, *COLORIZE, "-o", "out.nrrd"]
        ended = subprocess.run(
            command, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": str(ROOT)}
        )
        assert ended.returncode == 143 and "interrupted; nothing was written" in ended.stderr and not files()


class TestOutputs:
    def test_a_link_is_followed(self, files, tmp_path):
        (tmp_path / "far").mkdir()
        Path("far/real.nrrd").write_bytes(b"former")
        Path("out.nrrd").symlink_to("far/real.nrrd")
        Path("new.json").symlink_to("far/new.json")
        assert main([*COLORIZE, "-o", "out.nrrd", "--report", "new.json"]) == 0
        assert Path("out.nrrd").is_symlink() and Path("new.json").is_symlink()
        assert read_color_volume("far/real.nrrd").rgb.any() and Path("far/new.json").read_text().startswith("{")
        assert sorted(p.name for p in Path("far").iterdir()) == ["new.json", "real.nrrd"]

    def test_links_that_lead_nowhere(self, tmp_path):
        (tmp_path / "a.nrrd").symlink_to(tmp_path / "b.nrrd")
        (tmp_path / "b.nrrd").symlink_to(tmp_path / "a.nrrd")
        (tmp_path / "c.nrrd").symlink_to(tmp_path / "gone" / "c.nrrd")
        with pytest.raises(OutputError, match=r"a\.nrrd: the link leads to no file"):
            check_output_path(tmp_path / "a.nrrd")
        with pytest.raises(OutputError, match=r"c\.nrrd: the folder .*gone does not exist"):
            check_output_path(tmp_path / "c.nrrd")
        with pytest.raises(OutputError), atomic_output(tmp_path / "a.nrrd") as name:
            name.write_bytes(b"")
        assert (tmp_path / "a.nrrd").is_symlink()

    def test_pictures_and_reports_follow_too(self, tmp_path):
        from MedColorLib.rendering.sheet import write_png

        for name, write in (
            ("p.png", lambda path: write_png(path, np.zeros((4, 4, 3), np.uint8))),
            ("r.json", lambda path: write_report({}, path)),
        ):
            (tmp_path / f"real-{name}").write_bytes(b"former")
            (tmp_path / name).symlink_to(tmp_path / f"real-{name}")
            write(tmp_path / name)
            assert (tmp_path / name).is_symlink() and (tmp_path / f"real-{name}").read_bytes() != b"former"

    @pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the administrator may write anything")
    def test_a_write_protected_file_stays(self, tmp_path):
        (tmp_path / "a.nrrd").write_bytes(b"former")
        (tmp_path / "a.nrrd").chmod(0o444)
        with pytest.raises(OutputError, match="is write-protected"):
            check_output_path(tmp_path / "a.nrrd")

    def test_write_protection_is_asked_for(self, tmp_path, monkeypatch):
        (tmp_path / "a.nrrd").write_bytes(b"former")
        monkeypatch.setattr(os, "access", lambda *_: False)
        with pytest.raises(OutputError, match="is write-protected"):
            check_output_path(tmp_path / "a.nrrd")
        with pytest.raises(OutputError), atomic_output(tmp_path / "a.nrrd") as name:
            name.write_bytes(b"")
        assert (tmp_path / "a.nrrd").read_bytes() == b"former"

    @pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
    def test_a_pipe_is_no_file(self, tmp_path):
        os.mkfifo(tmp_path / "a.nrrd")
        with pytest.raises(OutputError, match="a device or a pipe"):
            check_output_path(tmp_path / "a.nrrd")

    @pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
    @pytest.mark.parametrize("write", [lambda path: write_report({}, path), check_output_path])
    def test_a_pipe_or_a_folder_is_never_replaced(self, write, tmp_path):
        os.mkfifo(tmp_path / "p.nrrd")
        (tmp_path / "l.nrrd").symlink_to("p.nrrd")
        (tmp_path / "d.nrrd").mkdir()
        for name, message in (("p", "a device or a pipe"), ("l", "a device or a pipe"), ("d", "is a folder")):
            with pytest.raises(OutputError, match=message):
                write(tmp_path / f"{name}.nrrd")
        assert (tmp_path / "p.nrrd").is_fifo() and (tmp_path / "l.nrrd").is_symlink() and (tmp_path / "d.nrrd").is_dir()

    @pytest.mark.parametrize("name", ["x" * 300, "a\0b"])
    def test_names_that_no_file_can_have(self, name, tmp_path):
        for call in (write_report, lambda _, path: check_output_path(path, (".json",))):
            with pytest.raises(OutputError, match="cannot be the name of a file"):
                call({}, tmp_path / f"{name}.json")
        for call in (
            lambda path: load_references([path]),
            lambda path: load_references([np.zeros((9, 9, 3), np.uint8)], masks=[path]),
            lambda path: find_volumes(path, "out"),
            lambda path: find_volumes(tmp_path, path),
            add_library,
        ):
            with pytest.raises(InputError, match="cannot be the name of a file or folder"):
                call(str(tmp_path / f"{name}.png"))

    def test_a_folder_that_is_a_file(self, tmp_path):
        (tmp_path / "file").touch()
        with pytest.raises(OutputError, match="Not a directory"):
            write_report({}, tmp_path / "file" / "r.json")

    def test_what_is_replaced_is_said(self, files, capsys):
        Path("out.nrrd").write_bytes(b"former")
        assert main([*COLORIZE, "-o", "out.nrrd", "--report", "r.json"]) == 0
        assert capsys.readouterr().err == "medcolor: out.nrrd: the earlier file of this name was replaced\n"
        assert main([*COLORIZE, "-o", "new.nrrd", "--report", "r.json"]) == 0
        assert capsys.readouterr().err == "medcolor: r.json: the earlier file of this name was replaced\n"

    @pytest.mark.parametrize("options", [[], ["--report", "r.json"]])
    def test_what_a_killed_run_has_left_is_said_and_stays(self, options, files, capsys):
        names = [".0123abcd-unfinished-out.nrrd", ".0123abcd-unfinished-r.json"]
        others = [".0123abcd-unfinished-out2.nrrd", "0123abcd-unfinished-out.nrrd", ".x-unfinished-out.nrrd"]
        for name in (*names, *others):
            Path(name).write_bytes(b"half")
        assert main([*COLORIZE, "-o", "out.nrrd", *options]) == 0
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1 + bool(options) and f"{names[0]}: left by a run that was killed" in said[0]
        assert {*names, *others, "out.nrrd"} <= files()

    def test_in_a_batch_too(self, files, capsys):
        Path("scans").mkdir()
        Path("ct.nrrd").rename("scans/ct.nrrd")
        line = ["batch", "scans", "-r", "section.png", "--preset", "draft", "--features", "embedded", "-o", "out"]
        Path("out").mkdir()
        Path("out/ct-colored.nrrd").write_bytes(b"former")
        assert main(line) == 0
        assert "s, an earlier file of this name was replaced" in capsys.readouterr().out
        assert main(line) == 0
        assert "replaced" not in capsys.readouterr().out
        Path("out/batch.json").write_text('{"mine": 1}')
        assert main(line) == 2
        assert "is no summary of a batch and would be replaced" in capsys.readouterr().err
        assert Path("out/batch.json").read_text() == '{"mine": 1}'

    def test_what_is_read_is_never_replaced(self, files, capsys, ct):
        assert main([*COLORIZE, "-o", "atlas.nrrd"]) == 0
        os.link("atlas.nrrd", "same.nrrd")
        Path("link.nrrd").symlink_to("atlas.nrrd")
        content = Path("atlas.nrrd").read_bytes()
        for name in ("atlas.nrrd", "same.nrrd", "link.nrrd"):
            line = [
                "colorize",
                "ct.nrrd",
                "-r",
                "atlas.nrrd",
                "--preset",
                "draft",
                "--features",
                "embedded",
                "-o",
                name,
            ]
            assert main(line) == 2
            assert f"{name} is a reference; the result would replace it" in capsys.readouterr().err
        assert Path("atlas.nrrd").read_bytes() == content


class TestTerminals:
    @pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
    def test_any_encoding_in_this_process(self, files, encoding, monkeypatch):
        folder = os.fsdecode(b"M\xfcller \xe5\x88\x87")
        Path(folder).mkdir()
        Path("section.png").rename(Path(folder, "Schnitt ä 切.png"))
        said = [io.TextIOWrapper(io.BytesIO(), encoding=encoding) for _ in range(2)]
        monkeypatch.setattr(sys, "stdout", said[0])
        monkeypatch.setattr(sys, "stderr", said[1])
        draft = ("--preset", "draft", "--features", "embedded")
        for arguments in (
            ["library", "add", folder, "--name", "atlas", "--credit", "© Müller 切"],
            ["library", "list"],
            ["colorize", "ct.nrrd", "-r", "atlas", "-r", folder, "--plan", *draft],
            ["colorize", "ct.nrrd", "-r", "atlas", "-o", f"{folder}/ö.nrrd", *draft],
        ):
            assert main(arguments) == 0
        assert main(["colorize", "切\udcff.nrrd", "-r", folder, "-o", "o.nrrd", *draft]) == 2
        said[0].flush()
        assert b"ller" in said[0].buffer.getvalue() and Path(folder, "ö.nrrd").is_file()

    @pytest.mark.slow
    @pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
    def test_any_encoding(self, files, encoding):
        """Names with letters of other scripts, a credit with a sign, and a byte that is no UTF-8."""
        folder = os.fsdecode(b"M\xfcller \xe5\x88\x87")
        Path(folder).mkdir()
        Path("section.png").rename(Path(folder, "Schnitt ä 切.png"))
        env = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": encoding, "LANG": "C", "LC_ALL": "C"}
        env.update(XDG_CACHE_HOME=str(Path.cwd() / "cache"), HOME=str(Path.cwd()))
        line = [sys.executable, "-m", "MedColorLib"]
        for arguments in (
            ["colorize", "ct.nrrd", "-r", folder, "--plan", "--preset", "draft", "--features", "embedded"],
            ["library", "add", folder, "--name", "atlas", "--credit", "© Müller 切"],
            ["library", "list"],
            [
                "colorize",
                "ct.nrrd",
                "-r",
                "atlas",
                "--preset",
                "draft",
                "--features",
                "embedded",
                "-o",
                f"{folder}/ö.nrrd",
            ],
            ["colorize", "--help"],
        ):
            ended = subprocess.run([*line, *arguments], capture_output=True, check=False, env=env)
            assert ended.returncode == 0 and b"Traceback" not in ended.stderr, ended.stderr[-800:]
        assert Path(folder, "ö.nrrd").is_file()

    def test_control_sequences_are_made_visible(self, files, capfd):
        Path("atlas").mkdir()
        Image.open("section.png").save("atlas/a\x1b[31mred.png")
        Path("atlas/b\x1b]0;title\x07.png").write_bytes(b"broken")
        assert main(["library", "add", "atlas", "--credit", "me\x1b[2J\x9b2J\r\u202eevil"]) == 0
        assert main(["library", "list"]) == 0
        assert (
            main(["colorize", "ct.nrrd", "-r", "atlas", "--plan", "--preset", "draft", "--features", "embedded"]) == 0
        )
        assert main(["colorize", "gone\x1b[2J.nrrd", "-r", "atlas", "-o", "o.nrrd"]) == 2
        told = capfd.readouterr()
        for text in (told.out, told.err):
            assert not set(text) & set("\x1b\x07\x9b\r\u202e")
        assert "me\\x1b[2J\\x9b2J\\r\\u202eevil" in told.out and "gone\\x1b[2J.nrrd" in told.err

    def test_ordinary_text_is_left_alone(self):
        assert plain("Müller 切\n\tok") == "Müller 切\n\tok"
