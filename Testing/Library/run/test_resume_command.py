"""Resume: what is said of an interrupted run, and the command line."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from resume_samples import broken_off, files_of, settings
from volume_samples import save_nrrd

from MedColorLib import colorize, make_plan, read_color_volume
from MedColorLib.cli.main import main
from MedColorLib.run.resume import RunStore

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.usefixtures("small_raster")
class TestSaid:
    def test_in_plan_log_and_report(self, volume, references, tmp_path, caplog):
        def left_out(plan):
            return [entry.saving for entry in plan.left_out if entry.what == "matching done before"]

        assert left_out(make_plan(volume, references, settings(), tmp_path)) == []
        broken_off(4, volume, references, settings(), resume=tmp_path)
        assert left_out(make_plan(volume, references, settings(), tmp_path)) == ["3 of 9 slices"]
        assert left_out(make_plan(volume, references, settings())) == []
        with caplog.at_level(logging.INFO, "MedColorLib"):
            report = colorize(volume, references, settings(), resume=tmp_path).report
        assert "an interrupted run left 3 slices matched" in caplog.text
        assert report["resumed_slices"] == 3 and report["resume_problem"] is None
        assert [e["saving"] for e in report["plan"]["left_out"] if e["what"] == "matching done before"] == [
            "3 of 9 slices"
        ]

    def test_without_resume_nothing_is_kept(self, volume, references, tmp_path, monkeypatch):
        monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: tmp_path / "weights")
        report = colorize(volume, references, settings()).report
        assert not files_of(tmp_path)
        assert (report["resumed_slices"], report["resume_run"], report["resume_problem"]) == (0, None, None)


@pytest.fixture
def case(ct, tmp_path, monkeypatch) -> Path:
    """Working folder with a volume, a reference and a cache of its own."""
    save_nrrd(tmp_path / "ct.nrrd", ct.volume.array, ct.volume.ijk_to_ras)
    cv2.imwrite(str(tmp_path / "section.png"), ct.reference[..., ::-1])
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("MEDCOLOR_WEIGHTS", raising=False)
    monkeypatch.setattr(
        "MedColorLib.features.weights.cache_folder", lambda: tmp_path / "cache" / "MedColor" / "weights"
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


LINE = ("colorize", "ct.nrrd", "-r", "section.png", "--preset", "draft", "--features", "embedded", "--device", "cpu")


@pytest.mark.usefixtures("small_raster")
class TestCommandLine:
    def test_ctrl_c_and_on(self, case, monkeypatch, capfd):
        save, calls = RunStore.save, []

        def interrupting(*arguments):
            calls.append(1)
            if len(calls) == 2:  # the second batch is matched, and not yet kept
                raise KeyboardInterrupt
            return save(*arguments)

        assert main([*LINE, "-o", "plain.nrrd"]) == 0
        monkeypatch.setattr(RunStore, "save", interrupting)
        assert main([*LINE, "-o", "out.nrrd", "--resume"]) == 130
        assert capfd.readouterr().err == (
            "medcolor: interrupted; nothing was written; the same command goes on from there (--resume)\n"
        )
        assert main([*LINE, "--resume", "--plan"]) == 0
        assert "saves 4 of 12 slices" in capfd.readouterr().out
        assert main([*LINE, "-o", "out.nrrd", "--resume", "--report", "r.json"]) == 0
        assert "4 slices were matched in an interrupted run before" in capfd.readouterr().out
        assert json.loads(Path("r.json").read_text())["resumed_slices"] == 4
        assert Path("out.nrrd").read_bytes() == Path("plain.nrrd").read_bytes()
        assert not files_of(case / "cache")

    def test_kept_until_the_result_is_written(self, case, monkeypatch):
        def interrupted(*_, **__):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr("nrrd.write", interrupted)
            assert main([*LINE, "-o", "out.nrrd", "--resume"]) == 130
        assert main([*LINE, "-o", "out.nrrd", "--resume", "--report", "r.json"]) == 0
        assert json.loads(Path("r.json").read_text())["resumed_slices"] == 12

    @pytest.mark.parametrize("limit", ["-1", "nan", "inf"])
    def test_wrong_limit(self, case, limit, capfd):
        assert main([*LINE, "-o", "out.nrrd", "--resume", f"--resume-limit={limit}"]) == 2
        assert "--resume-limit: expected 0 GB or more" in capfd.readouterr().err


# by itself, since another process cannot be sure to strike between two batches
KILLED_AFTER_THE_FIRST_MATCH = """
import os, signal, sys
from MedColorLib.cli.main import main
from MedColorLib.run.resume import RunStore
save = RunStore.save
RunStore.save = lambda *arguments: (save(*arguments), os.kill(os.getpid(), signal.SIGKILL))
main(sys.argv[1:])
"""


@pytest.mark.slow
def test_killed_in_the_middle(case):
    """SIGKILL leaves no time to tidy up; the real command, three processes."""
    command = [sys.executable, "-m", "MedColorLib", *LINE]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([*command, "-o", "plain.nrrd"], check=True, env=environment)
    killed = subprocess.run(
        [sys.executable, "-c", KILLED_AFTER_THE_FIRST_MATCH, *LINE, "-o", "out.nrrd", "--resume"],
        check=False,
        env=environment,
    )
    assert killed.returncode == -signal.SIGKILL and not Path("out.nrrd").exists()
    done = subprocess.run([*command, "-o", "out.nrrd", "--resume", "--report", "r.json"], check=True, env=environment)
    assert done.returncode == 0 and 0 < json.loads(Path("r.json").read_text())["resumed_slices"] < 12
    np.testing.assert_array_equal(read_color_volume("out.nrrd").rgb, read_color_volume("plain.nrrd").rgb)
    assert not list((case / "cache").rglob("*.safetensors"))
