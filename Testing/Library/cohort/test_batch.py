"""Batches: every volume once, whatever happens to one of them, to a worker or to the whole."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from batch_samples import DRAFT, GOOD, OPTIONS, assert_whole, expected_states, states, tree

from MedColorLib import Settings, run_batch
from MedColorLib.cli.main import main
from MedColorLib.cohort import batch
from MedColorLib.cohort.batch import Found, color_file, find_volumes, make_tasks
from MedColorLib.errors import InputError, OutputError, SettingsError
from MedColorLib.io.files import _READERS, input_sha256
from MedColorLib.matching import vote
from MedColorLib.run.resume import RunStore


class TestFinding:
    def test_volumes_and_what_is_passed_over(self, cohort):
        found = find_volumes("in", "out")
        assert list(found.volumes) == sorted([*GOOD, "broken.nrrd"]) and found.passed_over == {".txt": 1}

    def test_endings_are_those_of_the_readers(self):
        others = (*batch.TIFF_ENDINGS, *batch.DICOM_ENDINGS, ".png", ".jpg", ".jpeg", ".bmp")
        others += (".hdr", ".img", ".hdr.gz", ".img.gz")  # which count together only
        assert {*batch.VOLUME_ENDINGS, *others} == {*_READERS}

    def test_dicom_folders_and_pages(self, tmp_path):
        import SimpleITK as sitk

        (tmp_path / "in" / "p" / "series").mkdir(parents=True)
        for name in ("p/series/1", "2.dcm"):
            sitk.WriteImage(sitk.GetImageFromArray(np.zeros((4, 4), np.int16)), tmp_path / "in" / "x.dcm")
            (tmp_path / "in" / "x.dcm").rename(tmp_path / "in" / name)
        cv2.imwritemulti(str(tmp_path / "in" / "pages.tif"), [np.zeros((4, 4), np.uint8)] * 3)
        cv2.imwrite(str(tmp_path / "in" / "p" / "flat.tif"), np.zeros((4, 4), np.uint8))
        (tmp_path / "in" / "p" / "damaged.tif").write_bytes(b"II*")
        (tmp_path / "in" / "p" / "link").symlink_to(tmp_path)
        found = find_volumes(tmp_path / "in", tmp_path / "out")
        assert list(found.volumes) == ["in", "p/series", "pages.tif"]
        assert found.passed_over == {".tif": 2, "linked folders": 1}

    def test_results_are_no_input(self, cohort):
        assert run_batch("in", ["section.png"], "in/out", DRAFT).failed == 1
        before = find_volumes("in", "in/out").volumes
        assert list(before) == sorted([*GOOD, "broken.nrrd"])
        elsewhere = find_volumes("in", "out")
        assert elsewhere.volumes == before and elsewhere.passed_over["results of a batch"] == 1

    def test_input_is_hashed_without_what_lies_in_folders_below(self, cohort):
        """Results that are written below a DICOM folder do not make it another input."""
        before = input_sha256("in")
        Path("in/b/more").write_text("x")
        assert input_sha256("in") == before
        Path("in/more").write_text("x")
        assert input_sha256("in") != before
        assert input_sha256("in/a.nrrd") != input_sha256("in/e.nrrd")

    def test_two_volumes_of_one_name(self, cohort):
        shutil.copy("in/a.nrrd", "in/A.nhdr")
        found = Found({name: Path("in", name).resolve() for name in ("A.nhdr", "a.nrrd", "e.nrrd")}, {})
        tasks = make_tasks(found, ["section.png"], "out", DRAFT, 0)
        assert [task.result for task in tasks] == ["A.nhdr-colored.nrrd", "a.nrrd-colored.nrrd", "e-colored.nrrd"]

    @pytest.mark.parametrize(
        ("folder", "output", "message"),
        [
            ("nowhere", "out", "nowhere: is not a folder"),
            ("in/a.nrrd", "out", "is not a folder"),
            ("in", "in", "is or lies inside the output folder"),
            ("in/b", "in", "is or lies inside the output folder"),
            ("empty", "out", "empty: holds no volume"),
        ],
    )
    def test_wrong_folder(self, cohort, folder, output, message):
        Path("empty").mkdir()
        with pytest.raises(InputError, match=message):
            find_volumes(folder, output)


@pytest.mark.usefixtures("small_raster")
class TestBatch:
    def test_all_but_the_broken_one(self, cohort):
        seen = []
        result = run_batch("in", ["section.png"], "out/deep", DRAFT, progress=lambda f, text: seen.append((f, text)))
        assert states(result) == expected_states("done") and result.failed == 1
        assert_whole(Path("out/deep"))
        assert [f for f, _ in seen] == sorted(f for f, _ in seen) and seen[-1] == (1.0, "5 of 5 volumes")
        summary = json.loads(Path("out/deep/batch.json").read_text())
        assert summary["counts"] == {"done": 4, "failed": 1} and summary["passed_over"] == {".txt": 1}
        assert {v["volume"]: v["state"] for v in summary["volumes"]} == expected_states("done")
        broken = next(v for v in summary["volumes"] if v["state"] == "failed")
        assert "cut short or damaged" in broken["reason"]
        assert str(cohort) not in json.dumps(summary)
        assert "broken.nrrd  failed   the voxels are cut short" in result.text()
        assert "Passed over, no volumes: 1 .txt" in result.text()

    def test_a_reference_of_another_part_is_said_of_the_volume(self, cohort, monkeypatch):
        found = [{"reference": "section", "slices": [1, 3], "why": "it is a hand", "remedy": "choose a head"}]
        monkeypatch.setattr("MedColorLib.run.engine.reference_warnings", lambda *_: found)
        text = run_batch("in", ["section.png"], "out", DRAFT).text()
        said = "reference section does not seem to show what slices 1 to 3 show: it is a hand; choose a head"
        assert all(said in line for line in text.splitlines() if " done " in line) and said in text

    def test_second_run_does_nothing(self, cohort, monkeypatch):
        run_batch("in", ["section.png"], "out", DRAFT)
        before = tree(Path("out"))
        monkeypatch.setattr("MedColorLib.pipeline.colorize", None)
        result = run_batch("in", ["section.png"], "out", DRAFT)
        assert states(result) == expected_states("skipped") and "finished before" in result.text()
        del before["batch.json"]
        assert before.items() <= tree(Path("out")).items()

    def test_broken_off_between_the_report_and_the_end(self, cohort, monkeypatch):
        """The volume is finished; the next run has nothing to do but to delete its matches."""
        with monkeypatch.context() as patch:
            patch.setattr(batch, "forget_run", lambda *_: None)
            run_batch("in", ["section.png"], "out", DRAFT)
        assert any(Path("out/.unfinished").rglob("*.safetensors"))
        monkeypatch.setattr("MedColorLib.pipeline.colorize", None)
        assert states(run_batch("in", ["section.png"], "out", DRAFT)) == expected_states("skipped")
        assert_whole(Path("out"))

    @pytest.mark.parametrize(
        ("change", "again"),
        [
            (lambda: shutil.copy("in/e.nrrd", "in/a.nrrd"), {"a.nrrd"}),
            (lambda: shutil.copy("in/e.nrrd", "in/broken.nrrd"), {"broken.nrrd"}),
            (lambda: Path("out/e-colored.nrrd").unlink(), {"e.nrrd"}),
            (lambda: Path("out/e-colored.nrrd").write_bytes(b"cut"), {"e.nrrd"}),
            (lambda: Path("out/e-colored.json").unlink(), {"e.nrrd"}),
            (lambda: Path("out/e-colored.json").write_text("[]"), {"e.nrrd"}),
            (lambda: cv2.imwrite("section.png", cv2.imread("section.png") // 2), set(GOOD)),
            (lambda: None, set()),
        ],
    )
    def test_what_changed_is_done_again(self, cohort, change, again):
        run_batch("in", ["section.png"], "out", DRAFT)
        change()
        result = run_batch("in", ["section.png"], "out", DRAFT)
        assert {name for name, state in states(result).items() if state == "done"} == again

    def test_other_settings_or_version(self, cohort, monkeypatch):
        run_batch("in", ["section.png"], "out", DRAFT)
        other = Settings(preset="draft", features="embedded", device="cpu", luminance="paper")
        assert states(run_batch("in", ["section.png"], "out", other)) == expected_states("done")
        assert_whole(Path("out"), other)
        monkeypatch.setattr(batch, "__version__", "99")
        assert states(run_batch("in", ["section.png"], "out", other)) == expected_states("done")

    def test_a_header_whose_data_changed(self, cohort, ct):
        import SimpleITK as sitk

        shutil.rmtree("in")
        Path("in").mkdir()
        for array, state in (
            (ct.volume.array[3:5], "done"),
            (ct.volume.array[3:5], "skipped"),
            (ct.volume.array[4:6], "done"),
        ):
            sitk.WriteImage(sitk.GetImageFromArray(array), "in/v.mhd")
            result = run_batch("in", ["section.png"], "out", DRAFT)
            assert states(result) == {"v.mhd": state} and result.passed_over == {".raw": 1}

    def test_equal_runs_write_equal_files(self, cohort):
        run_batch("in", ["section.png"], "one", DRAFT)
        run_batch("in", ["section.png"], "two", DRAFT)
        one, two = ({n: d for n, d in tree(Path(f)).items() if n.endswith("nrrd")} for f in ("one", "two"))
        assert one == two and len(one) == 4

    def test_interrupted_inside_a_volume(self, cohort, monkeypatch):
        """The finished one is skipped, the broken-off one goes on from its matches, no temporary file is left."""
        save, calls = RunStore.save, []

        def interrupting(*arguments):
            calls.append(1)
            if len(calls) == 8:  # batches of one slice: the fourth of the second volume
                raise KeyboardInterrupt
            return save(*arguments)

        one_by_one = Settings(preset="draft", features="embedded", device="cpu", batch=1)
        with monkeypatch.context() as patch:
            patch.setattr(RunStore, "save", interrupting)
            with pytest.raises(KeyboardInterrupt):
                run_batch("in", ["section.png"], "out", one_by_one)
        summary = json.loads(Path("out/batch.json").read_text())
        assert summary["counts"] == {"done": 1, "not reached": 4}
        assert not [name for name in tree(Path("out")) if "colored" in name and not name.startswith("a-")]
        result = run_batch("in", ["section.png"], "out", one_by_one)
        by_name = {outcome.volume: outcome for outcome in result.outcomes}
        assert by_name["a.nrrd"].state == "skipped" and by_name["b/c.nrrd"].resumed_slices == 3
        assert "3 slices from an interrupted run" in result.text()
        assert_whole(Path("out"), one_by_one)

    def test_a_bug_in_one_volume_is_listed(self, cohort, monkeypatch):
        def failing(path, **_options):
            raise ZeroDivisionError("by\nzero")

        monkeypatch.setattr(batch, "read_volume", failing)
        result = run_batch("in", ["section.png"], "out", DRAFT)
        assert {outcome.reason for outcome in result.outcomes} == {"ZeroDivisionError: by zero"} and result.failed == 5

    @pytest.mark.parametrize(
        ("changes", "error", "message"),
        [
            ({"references": ["missing.png"]}, InputError, "missing.png"),
            ({"references": ["in/notes.txt"]}, InputError, "not a picture"),
            ({"references": []}, InputError, "references: none given"),
            ({"workers": 0}, SettingsError, "workers: expected a whole number of at least 1, got 0"),
            ({"output_folder": "section.png/out"}, OutputError, "section.png/out: cannot be made"),
        ],
    )
    def test_what_concerns_all_is_said_before_any(self, cohort, changes, error, message):
        arguments = {
            "folder": "in",
            "references": ["section.png"],
            "output_folder": "out",
            "settings": DRAFT,
            **changes,
        }
        with pytest.raises(error, match=message):
            run_batch(**arguments)
        assert not Path("out").exists()

    def test_worker_of_another_version_or_with_other_weights(self, cohort, monkeypatch):
        task = make_tasks(find_volumes("in", "out"), ["section.png"], "out", DRAFT, 0)[0]
        with monkeypatch.context() as patch:
            patch.setattr(batch, "weights_sha256", lambda _: "other")
            with pytest.raises(Exception, match="features embedded: the worker has other weights"):
                color_file(task)
        monkeypatch.setattr(batch, "__version__", "99")
        with pytest.raises(SettingsError, match="the worker has MedColor 99, the batch was started with"):
            color_file(task)


@pytest.mark.usefixtures("small_raster")
class TestCommandLine:
    def test_exit_status_and_table(self, cohort, capsys):
        assert main(["batch", "in", *OPTIONS, "-o", "out"]) == 1
        text = capsys.readouterr().out
        assert "broken.nrrd  failed " in text and "4 of 5 volumes are finished; see out/batch.json" in text
        Path("in/broken.nrrd").unlink()
        assert main(["batch", "in", *OPTIONS, "-o", "out"]) == 0
        assert capsys.readouterr().out.count("finished before") == 4

    def test_options_are_those_of_colorize(self, cohort):
        assert main(["batch", "in", *OPTIONS, "-o", "out", "--window", "-200", "300", "--slices", "1:3"]) == 1
        said = json.loads(Path("out/batch.json").read_text())["settings"]
        assert (said["window"], said["slices"]) == ([-200, 300], [1, 3])

    def test_ctrl_c(self, cohort, monkeypatch, capfd):
        def interrupted(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(vote, "matched_colors", interrupted)
        assert main(["batch", "in", *OPTIONS, "-o", "out"]) == 130
        assert capfd.readouterr().err == "medcolor: interrupted; finished volumes are kept, the same command goes on\n"

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (("--workers", "2", "--scheduler", "x"), "not allowed with argument --workers"),
            (("--workers", "0"), "workers: expected a whole number of at least 1"),
            (("--scheduler", "nowhere"), "scheduler nowhere: no Dask scheduler answers"),
            (("--resume-limit", "-2"), "--resume-limit: expected 0 GB or more, got -2"),
        ],
    )
    def test_wrong_options(self, cohort, options, message, capsys):
        try:
            status = main(["batch", "in", *OPTIONS, "-o", "out", *options])
        except SystemExit as end:
            status = end.code
        assert status == 2 and message in capsys.readouterr().err
