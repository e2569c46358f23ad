"""Resume: a run broken off anywhere gives the same bytes when it goes on, and does nothing twice."""

from __future__ import annotations

import dataclasses
import logging
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from resume_samples import broken_off, files_of, half, settings
from safetensors.torch import save_file

import MedColorLib
from MedColorLib import Resume, colorize, forget_run
from MedColorLib.errors import SettingsError
from MedColorLib.matching import analogy
from MedColorLib.phantom import section
from MedColorLib.run import resume as resume_module
from MedColorLib.run.engine import Engine
from MedColorLib.run.prepare import prepare
from MedColorLib.run.resume import RunStore, _code_sha256, run_key

KINDS = {
    "draft": {"preset": "draft"},
    "full": {"preset": "full", "features": "vgg19"},
    "guided": {"preset": "draft", "smoother": "guided"},
    "one by one": {"preset": "draft", "batch": 1},
}


@pytest.fixture
def matched(monkeypatch) -> list[int]:
    """Fills with the number of slices of every batch that is matched for colouring."""
    counts, made, match, match_batch = [], [], Engine._correspondence, Engine.match

    def noted(*arguments):
        made.append(1)
        return match(*arguments)

    def counted(engine, ks, index):
        made.clear()
        try:
            return match_batch(engine, ks, index)
        finally:
            if made:
                counts.append(len(ks))

    monkeypatch.setattr(Engine, "_correspondence", noted)
    monkeypatch.setattr(Engine, "match", counted)
    return counts


@pytest.mark.usefixtures("small_raster")
class TestSameBytes:
    @pytest.mark.parametrize("kind", KINDS)
    def test_cancelled_before_any_step(self, volume, references, kind, matched, tmp_path, narrow_vgg19):
        """Steps: prepare, network, then the batches; two references and a repeated slice cut these short."""
        chosen = settings(**KINDS[kind])
        plain = colorize(volume, references, chosen)
        batches, total = list(matched), len(matched)
        chosen_references = len(set(plain.report["reference_of_slice"].values()))
        assert sum(batches) == 8 and chosen_references == 2
        steps = total + 3  # the repeat is a step without a match
        for after in range(steps) if kind == "draft" else (1, steps // 2, steps - 1):
            matched.clear()
            folder = tmp_path / str(after)
            broken_off(after, volume, references, chosen, resume=folder)
            result = colorize(volume, references, chosen, resume=folder)
            assert matched == batches, "nothing twice, and in the batches of the plain run"
            assert result.rgb.tobytes() == plain.rgb.tobytes()
            for name in ("searched", "trusted_fraction", "out_of_gamut_pixels", "contrast_agreement"):
                assert result.report[name] == plain.report[name]
        assert result.report["resumed_slices"] > 4

    @pytest.mark.parametrize("smoother", ["regression", "guided"])
    def test_slices_near_a_change_of_reference(self, volume, matched, smoother, tmp_path):
        """They are matched once, and colour passes over the place where the run was broken off."""
        series, chosen = (
            [half(section(level)) for level in (-0.8, -0.45, 0.1, 0.6)],
            settings(batch=1, smoother=smoother),
        )
        plain = colorize(volume, series, chosen)
        assert sum(matched) == 8 and len(set(plain.report["reference_of_slice"].values())) > 2
        steps = []
        colorize(volume, series, chosen, progress=lambda _, text: steps.append(text))
        for after in range(3, len(steps), 3):
            matched.clear()
            broken_off(after, volume, series, chosen, resume=tmp_path / str(after))
            result = colorize(volume, series, chosen, resume=tmp_path / str(after))
            assert sum(matched) == 8 and result.rgb.tobytes() == plain.rgb.tobytes()
            assert 0 < result.report["resumed_slices"] < 9

    def test_broken_off_again_and_again(self, volume, references, matched, tmp_path):
        plain = colorize(volume, references, settings(batch=1))
        matched.clear()
        for after in (3, 4, 6, 6, 9):
            broken_off(after, volume, references, settings(batch=1), resume=tmp_path)
        result = colorize(volume, references, settings(batch=1), resume=tmp_path)
        assert matched == [1] * 8 and result.rgb.tobytes() == plain.rgb.tobytes()

    def test_ended_by_an_error(self, volume, references, matched, tmp_path, monkeypatch):
        plain, save, calls = colorize(volume, references, settings()), RunStore.save, []
        matched.clear()

        def failing(*arguments):
            calls.append(1)
            if len(calls) == 3:  # matched, and not yet kept
                raise RuntimeError("power cut")
            return save(*arguments)

        monkeypatch.setattr(RunStore, "save", failing)
        with pytest.raises(RuntimeError, match="power cut"):
            colorize(volume, references, settings(), resume=tmp_path)
        result = colorize(volume, references, settings(), resume=tmp_path)
        assert result.rgb.tobytes() == plain.rgb.tobytes()
        assert result.report["resumed_slices"] == sum(matched[:2]) > 0

    def test_nothing_of_a_whole_run_is_matched_again(self, volume, references, matched, tmp_path):
        """Killed while the result was being written, for instance."""
        first = colorize(volume, references, settings(), resume=tmp_path)
        matched.clear()
        second = colorize(volume, references, settings(), resume=tmp_path)
        assert not matched and second.rgb.tobytes() == first.rgb.tobytes()
        assert (first.report["resumed_slices"], second.report["resumed_slices"]) == (0, 8)

    def test_every_value_of_a_match_comes_back(self, tmp_path, rng):
        store = RunStore(Resume(tmp_path), "k" * 64)
        match = analogy.Match(
            layer=3,
            field=torch.from_numpy(rng.integers(0, 65536, (2, 5, 4))),
            similarity=torch.rand(2, 5, 4),
            reverse=torch.from_numpy(rng.integers(0, 65536, (2, 6, 4))),
            searched={5: "exact", 4: "windowed"},
        )
        for changes in ({}, {"reverse": None}, {"similarity": torch.rand(2, 5, 4).to(torch.bfloat16)}):
            given = dataclasses.replace(match, **changes)
            store.save([7, 9], 2, given)
            back = store.load([7, 9], 2, "cpu")
            for field in dataclasses.fields(given):
                one, other = getattr(given, field.name), getattr(back, field.name)
                if isinstance(one, torch.Tensor):
                    assert one.dtype == other.dtype and torch.equal(one, other)
                else:
                    assert one == other
        assert store.load([7, 9], 1, "cpu") is store.load([7, 8], 2, "cpu") is store.load([7], 2, "cpu") is None


@pytest.mark.usefixtures("small_raster")
class TestWhoseMatches:
    @pytest.mark.parametrize(
        "changes",
        [
            {"seed": 1},
            {"window": (-200.0, 300.0)},
            {"smoother": "guided"},
            {"coherence_mm": 0.0},
            {"batch": 3},
            {"preset": "balanced"},
            {"slices": (1, 5)},
            {"region": ((0, 9), (0, 30), (0, 56))},
            {"plane": "acquired"},
        ],
        ids=str,
    )
    def test_another_setting(self, volume, references, changes):
        keys = {run_key(prepare(volume, references, settings(**given))) for given in ({}, {}, changes)}
        assert len(keys) == 2

    def test_another_input(self, volume, references):
        other = volume.array.copy()
        other[0, 0, 0] += 1
        longer = volume.ijk_to_ras @ np.diag([1, 1, 1.01, 1])
        inputs = [
            (volume, references),
            (dataclasses.replace(volume, array=other), references),
            (dataclasses.replace(volume, ijk_to_ras=longer), references),
            (dataclasses.replace(volume, window=(0.0, 80.0)), references),
            (dataclasses.replace(volume, array=volume.array.astype(np.int32)), references),
            (volume, references[::-1]),
            (volume, references[:1]),
        ]
        assert len({run_key(prepare(*given, settings())) for given in inputs}) == len(inputs)
        fortran = dataclasses.replace(volume, array=np.asfortranarray(volume.array), name="other name")
        assert run_key(prepare(fortran, references, settings())) == run_key(prepare(volume, references, settings()))

    @pytest.mark.parametrize("name", ["weights_sha256", "_code_sha256"])
    def test_other_weights_or_code(self, volume, references, name, monkeypatch):
        before = run_key(prepare(volume, references, settings()))
        monkeypatch.setattr(resume_module, name, lambda *_: "other")
        assert run_key(prepare(volume, references, settings())) != before

    @pytest.mark.parametrize("name", ["run/resume.py", "matching/fields/exact.py", "volume.py"])
    def test_code_of_any_folder_counts(self, name, tmp_path):
        library = tmp_path / "library"
        shutil.copytree(Path(MedColorLib.__file__).parent, library, ignore=shutil.ignore_patterns("*.pyc"))
        _code_sha256.cache_clear()
        assert _code_sha256() == _code_sha256(library)
        with (library / name).open("a") as file:
            file.write("# changed\n")
        _code_sha256.cache_clear()
        assert _code_sha256(library) != _code_sha256()

    def test_own_weights_count(self, volume, references, monkeypatch):
        before = run_key(prepare(volume, references, settings()))
        monkeypatch.setattr(resume_module, "own_weights_sha256", lambda: "other")
        assert run_key(prepare(volume, references, settings())) != before

    def test_other_threads_round_differently(self, volume, references, monkeypatch):
        before = run_key(prepare(volume, references, settings()))
        monkeypatch.setattr(torch, "get_num_threads", lambda: 77)
        assert run_key(prepare(volume, references, settings())) != before

    def test_matches_of_other_settings_are_not_taken_up(self, volume, references, tmp_path):
        broken_off(4, volume, references, settings(), resume=tmp_path)
        other = settings(window=(-200.0, 300.0))
        result = colorize(volume, references, other, resume=tmp_path)
        assert result.report["resumed_slices"] == 0
        assert result.rgb.tobytes() == colorize(volume, references, other).rgb.tobytes()


def said_of_resume(caplog) -> list[str]:
    """What the log says of interrupted runs."""
    return [text for text in caplog.messages if text.startswith("resume: ")]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-10] ^= 1
    path.write_bytes(data)


def strange(path: Path) -> None:
    save_file({"field": torch.zeros(2, 16, 16, dtype=torch.int32)}, str(path))


@pytest.mark.usefixtures("small_raster")
class TestStore:
    @pytest.mark.parametrize(
        "damage",
        [truncate, flip, strange, lambda path: path.write_bytes(b""), lambda path: path.write_bytes(b"{" * 99)],
    )
    def test_damaged_file_is_matched_again(self, volume, references, damage, matched, tmp_path, caplog):
        plain = colorize(volume, references, settings())
        broken_off(5, volume, references, settings(), resume=tmp_path)
        first = files_of(tmp_path)[0]
        damage(first)
        matched.clear()
        with caplog.at_level(logging.WARNING, "MedColorLib"):
            result = colorize(volume, references, settings(), resume=tmp_path)
        (said,) = said_of_resume(caplog)
        assert "slices 0 to 1 are matched again" in said and "damaged" in said and str(tmp_path) not in caplog.text
        assert result.rgb.tobytes() == plain.rgb.tobytes()
        assert result.report["resumed_slices"] == 8 - sum(matched) == 3
        again = colorize(volume, references, settings(), resume=tmp_path)
        assert again.report["resumed_slices"] == 8, "the damaged file was replaced"

    def test_folder_that_cannot_be_written(self, volume, references, tmp_path, caplog):
        (tmp_path / "file").write_text("in the way")
        plain = colorize(volume, references, settings())
        with caplog.at_level(logging.WARNING, "MedColorLib"):
            result = colorize(volume, references, settings(), resume=tmp_path / "file")
        assert said_of_resume(caplog) == [
            "resume: the folder of unfinished runs cannot be written (Not a directory); what is matched from here on "
            "cannot be resumed"
        ]
        assert "cannot be written" in result.report["resume_problem"]
        assert result.rgb.tobytes() == plain.rgb.tobytes()

    def test_disk_full_leaves_no_part(self, volume, references, tmp_path, monkeypatch, caplog):
        def full(*_):
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(resume_module.os, "replace", full)
            result = colorize(volume, references, settings(), resume=tmp_path)
        assert "No space left" in result.report["resume_problem"] and not files_of(tmp_path)

    def test_limit_ends_the_keeping(self, volume, references, tmp_path, caplog):
        broken_off(3, volume, references, settings(), resume=tmp_path / "one")
        size = files_of(tmp_path / "one")[0].stat().st_size
        limited = Resume(tmp_path / "limited", int(2.5 * size))
        with caplog.at_level(logging.WARNING, "MedColorLib"):
            result = colorize(volume, references, settings(), resume=limited)
        assert sum("limit" in record.getMessage() for record in caplog.records) == 1
        assert "limit" in result.report["resume_problem"]
        kept = files_of(limited.folder)
        assert kept and sum(path.stat().st_size for path in kept) <= limited.max_bytes
        assert colorize(volume, references, settings(), resume=limited).report["resumed_slices"] > 0

    def test_limit_deletes_the_oldest_run_first(self, volume, references, tmp_path, caplog):
        limits = [settings(seed=seed) for seed in range(3)]
        keys = [run_key(prepare(volume, references, given)) for given in limits]
        for age, key, given in zip((300, 200), keys, limits):
            broken_off(4, volume, references, given, resume=tmp_path)
            then = time.time() - age
            os.utime(tmp_path / key, (then, then))
        total = sum(path.stat().st_size for path in files_of(tmp_path))
        with caplog.at_level(logging.WARNING, "MedColorLib"):
            broken_off(3, volume, references, limits[2], resume=Resume(tmp_path, total))
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(keys[1:])
        assert "an older interrupted run was deleted" in caplog.text

    def test_another_run_makes_room_meanwhile(self, tmp_path):
        store = RunStore(Resume(tmp_path / "runs"), "k" * 64)
        match = analogy.Match(3, torch.zeros(1, 2, 2, dtype=torch.int64), torch.zeros(1, 2, 2), None, {3: "exact"})
        store.save([1], 0, match)
        shutil.rmtree(tmp_path / "runs")
        store.save([2], 0, match)
        assert store.problem is None and store.load([2], 0, "cpu") is not None

    def test_forgotten_when_the_result_is_safe(self, volume, references, tmp_path):
        broken_off(4, volume, references, settings(seed=5), resume=tmp_path)
        result = colorize(volume, references, settings(), resume=tmp_path)
        forget_run(result.report, tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == [run_key(prepare(volume, references, settings(seed=5)))]
        forget_run(result.report, tmp_path)
        forget_run(colorize(volume, references, settings()).report, tmp_path)
        assert len(list(tmp_path.iterdir())) == 1

    def test_no_name_in_it(self, volume, references, tmp_path):
        broken_off(5, volume, references, settings(), resume=tmp_path)
        assert files_of(tmp_path)
        for path in files_of(tmp_path):
            assert b"Doe" not in path.read_bytes() and "Doe" not in str(path.relative_to(tmp_path))

    def test_small_beside_the_volume(self, volume, references, tmp_path):
        """At layer 3 of 64 pixels: 16 x 16 positions each way in 4 bytes, their similarity, one header a batch."""
        colorize(volume, references, settings(batch=1), resume=tmp_path)
        assert all(path.stat().st_size < 16 * 16 * 4 * 4 + 1000 for path in files_of(tmp_path))

    @pytest.mark.parametrize("limit", [-1, 1.5, True, None])
    def test_wrong_limit(self, limit):
        with pytest.raises(SettingsError, match="resume: expected a limit of 0 bytes or more"):
            Resume(max_bytes=limit)

    def test_default_folder_is_beside_the_weights(self, monkeypatch, tmp_path):
        monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: tmp_path / "weights")
        assert Resume().root == tmp_path / "runs" and Resume(tmp_path).root == tmp_path


class TestOnlyItsOwn:
    """A folder of runs may be any folder; what is not MedColor's stays."""

    def matches(self, store: RunStore, count: int = 1) -> None:
        for number in range(count):
            match = analogy.Match(3, torch.zeros(1, 16, 16, dtype=torch.int64), torch.zeros(1, 16, 16), None, {})
            store.save((number,), 0, match)

    def test_a_folder_with_a_name_as_long_as_a_key(self, tmp_path):
        for name in ("x" * 64, "0123456789abcdef" * 4):
            (tmp_path / name).mkdir()
            (tmp_path / name / "thesis.txt").write_text("mine")
            (tmp_path / name / "000000-000003-4-0.safetensors").write_bytes(bytes(5000))
        store = RunStore(Resume(tmp_path, 6000), "f" * 64)
        self.matches(store, 4)
        for name in ("x" * 64, "0123456789abcdef" * 4):
            assert sorted(p.name for p in (tmp_path / name).iterdir()) == [
                "000000-000003-4-0.safetensors",
                "thesis.txt",
            ]

    def test_what_lies_in_a_run_and_is_not_of_it_stays(self, tmp_path):
        self.matches(RunStore(Resume(tmp_path), "a" * 64), 2)
        (tmp_path / ("a" * 64) / "notes.txt").write_text("mine")
        forget_run({"resume_run": "a" * 64}, tmp_path)
        assert [p.name for p in (tmp_path / ("a" * 64)).iterdir()] == ["notes.txt"]

    def test_matches_of_another_run_are_not_of_this_one(self, tmp_path):
        self.matches(RunStore(Resume(tmp_path), "a" * 64))
        (tmp_path / ("a" * 64)).rename(tmp_path / ("b" * 64))
        forget_run({"resume_run": "b" * 64}, tmp_path)
        assert len(files_of(tmp_path)) == 1

    def test_links_are_not_followed(self, tmp_path):
        self.matches(RunStore(Resume(tmp_path / "elsewhere"), "a" * 64))
        (tmp_path / "runs").mkdir()
        (tmp_path / "runs" / ("a" * 64)).symlink_to(tmp_path / "elsewhere" / ("a" * 64))
        (tmp_path / "runs" / ("b" * 64)).mkdir()
        (tmp_path / "runs" / ("b" * 64) / "000000-000000-1-0.safetensors").symlink_to(
            files_of(tmp_path / "elsewhere")[0]
        )
        self.matches(RunStore(Resume(tmp_path / "runs", 10), "c" * 64))
        for key in ("a" * 64, "b" * 64):
            forget_run({"resume_run": key}, tmp_path / "runs")
        assert len(files_of(tmp_path / "elsewhere")) == 1 and (tmp_path / "runs" / ("a" * 64)).is_symlink()

    @pytest.mark.parametrize("key", ["..", "../elsewhere", "", "A" * 64])
    def test_a_report_that_names_no_run(self, key, tmp_path):
        (tmp_path / "elsewhere").mkdir()
        (tmp_path / "elsewhere" / "mine").write_text("mine")
        (tmp_path / "runs").mkdir()
        forget_run({"resume_run": key}, tmp_path / "runs")
        assert (tmp_path / "elsewhere" / "mine").exists() and (tmp_path / "runs").exists()
