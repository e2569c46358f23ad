"""Benchmark: what a run writes, and whether the stored results hold what the documentation says."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from MedColorLib.bench import pairs, schema, stability, suite_pipeline
from MedColorLib.bench.matched import Matched, Method
from MedColorLib.bench.page import make_page
from MedColorLib.bench.quality import color_errors
from MedColorLib.bench.summary import own_variant
from MedColorLib.bench.tables import Table
from MedColorLib.errors import InputError, MedColorError, MissingPackageError

RESULTS = sorted((Path(__file__).parents[2] / "Benchmark" / "results").glob("*.json"))


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A real file of results: the stability suite, cut to a few cases."""
    from MedColorLib.bench import run, stability_color

    folder = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stability, "all_cases", stability_color.cases)
        written = run.run_bench(folder, stability=True)
    assert [path.name for path in written] == ["bench.html", "bench.json"]
    assert {path.name for path in folder.iterdir()} == {"bench.html", "bench.json"}
    return json.loads((folder / "bench.json").read_text())


class TestSchema:
    def test_written_results_fit(self, results):
        schema.check_results(results)
        assert tuple(results["suites"]) == ("stability",)

    def test_text_is_the_same_data_a_row_a_line(self, results):
        text = schema.to_text(results)
        assert json.loads(text) == results
        rows = results["suites"]["stability"]["tables"]["stability"]["rows"]
        assert sum(line.strip().startswith('["') for line in text.splitlines()) >= len(rows)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda d: d.pop("environment"), "results: expected the keys"),
            (lambda d: d.update(schema=0), "schema 0"),
            (lambda d: d["environment"].pop("cpu"), "environment: expected the keys"),
            (lambda d: _rows(d)[0].pop(), "row 0: 6 values for 7 columns"),
            (lambda d: _rows(d)[1].__setitem__(5, "maybe"), "row 1, verdict: unexpected 'maybe'"),
            (lambda d: _rows(d)[1].__setitem__(5, None), "row 1, verdict: unexpected None"),
            (lambda d: _rows(d).clear(), "no rows"),
            (lambda d: d["suites"]["stability"]["tables"]["stability"]["columns"].append("x"), "other columns"),
            (lambda d: d["suites"]["stability"]["failures"].append(["what", ""]), "a failure must be what and why"),
            (lambda d: d["targets"]["rows"].append(["t", "4", 4.0, True]), "row 0, value: unexpected '4'"),
            (lambda d: d["targets"]["rows"].append(["t", 4.0, 4.0, 1]), "row 0, met: unexpected 1"),
        ],
    )
    def test_other_files_do_not(self, results, change, message):
        wrong = copy.deepcopy(results)
        change(wrong)
        with pytest.raises(InputError, match=re.escape(message)):
            schema.check_results(wrong)

    def test_page_stands_alone_and_escapes(self, results):
        marked = copy.deepcopy(results)
        _rows(marked)[0][4] = "<script>alert(1)</script>"
        page = make_page(marked, {})
        assert "<script" not in page
        assert "&lt;script&gt;" in page
        assert not re.search(r"(src|href)\s*=\s*\"?http", page)


def _rows(data):
    return data["suites"]["stability"]["tables"]["stability"]["rows"]


class TestRun:
    def test_data_folder_without_pictures_is_refused(self, tmp_path):
        from MedColorLib.bench.run import run_bench

        with pytest.raises(InputError, match="--data"):
            run_bench(tmp_path / "out", data=tmp_path)

    def test_folder_that_cannot_be_made_is_refused(self, tmp_path):
        from MedColorLib.bench.run import run_bench

        (tmp_path / "file").write_text("")
        with pytest.raises(MedColorError, match="cannot be made"):
            run_bench(tmp_path / "file", stability=True)

    def test_missing_matplotlib_names_the_remedy(self, tmp_path, monkeypatch):
        from MedColorLib.bench.run import run_bench

        monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
        with pytest.raises(MissingPackageError, match=re.escape("medcolor[bench]")):
            run_bench(tmp_path, stability=True)


@pytest.fixture(scope="class")
def everything(tmp_path_factory):
    """(folder, files written) of a quick run of all suites on the phantom, without VGG-19, on a raster of 64 pixels.

    Of the stability cases those of colour: `TestStability` asks every one of them.
    """
    from MedColorLib.bench import run, stability_color
    from MedColorLib.parameters import PRESETS

    folder = tmp_path_factory.mktemp("everything")
    with pytest.MonkeyPatch.context() as patch:
        for name, preset in PRESETS.items():
            patch.setitem(PRESETS, name, replace(preset, grid_px=64))
        patch.setattr(run, "_DATA", folder / "nothing")
        patch.setattr(suite_pipeline, "has_network", lambda: False)
        patch.setattr(stability, "all_cases", stability_color.cases)
        written = run.run_bench(folder / "out", quick=True, suites=tuple(run.SUITES))
    return folder / "out", written


@pytest.mark.slow
class TestEverything:
    def test_every_suite_is_written_and_fits(self, everything):
        from MedColorLib.bench import run

        folder, written = everything
        data = json.loads((folder / "bench.json").read_text())
        schema.check_results(data)
        assert tuple(data["suites"]) == tuple(run.SUITES)
        assert {path.name for path in written} == {path.name for path in folder.iterdir()}
        assert [f[0] for f in data["suites"]["pipeline"]["failures"]] == [
            "features vgg19",
            "CT against cryosection by region",
        ]
        improvements = data["suites"]["quality"]["tables"]["improvements"]
        assert len(improvements["rows"]) == 3 + 9 + 3 + 2

    def test_the_page_shows_every_plot(self, everything):
        folder, written = everything
        assert {path.suffix for path in written} == {".html", ".json", ".png"}
        plots = {path.stem for path in written if path.suffix == ".png"}
        assert plots == {
            "error_against_time", "smoothing", "rounding", "correspondence", "quality", "profile", "scaling",
        }  # fmt: skip
        assert (folder / "bench.html").read_text().count("data:image/png") == len(plots)


class TestCommittedResults:
    def test_there_are_some(self):
        assert RESULTS

    @pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
    def test_they_fit_the_schema(self, path):
        data = json.loads(path.read_text(encoding="utf-8"))
        schema.check_results(data)
        version, machine, device = path.stem.split("--")
        assert version == data["medcolor"]
        assert machine
        assert device == data["environment"]["device"]

    @pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
    def test_no_stability_case_failed(self, path):
        table = json.loads(path.read_text(encoding="utf-8"))["suites"]["stability"]["tables"]["stability"]
        assert "FAIL" not in [row[table["columns"].index("verdict")] for row in table["rows"]]

    @pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
    def test_targets_are_met(self, path):
        table = json.loads(path.read_text(encoding="utf-8"))["targets"]
        rows = [dict(zip(table["columns"], row)) for row in table["rows"]]
        assert [row["target"] for row in rows if "CIEDE2000" in row["target"] and row["met"] is False] == []

    @pytest.mark.parametrize("remap", ["as it is", "strong", "inverted"])
    def test_error_has_not_risen(self, phantom, remap):
        stored = _stored(RESULTS[-1]).where(
            section="phantom", remap=remap, features="embedded", method="draft", **own_variant("draft")
        )
        assert _measured(phantom, remap, Method("embedded", "draft")) <= stored[0]["mean"] + 0.1

    @pytest.mark.slow
    @pytest.mark.parametrize("remap", ["as it is", "strong", "inverted"])
    @pytest.mark.parametrize("features", ["embedded", "vgg19"])
    def test_error_has_not_risen_on_the_photograph(self, shared_data, shared_weights, monkeypatch, remap, features):
        monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(shared_weights))
        thorax = pairs.load_sections(shared_data)[0]
        stored = _stored(RESULTS[-1]).where(
            section="thorax", remap=remap, features=features, method="balanced", **own_variant("balanced")
        )
        assert _measured(thorax, remap, Method(features, "balanced")) <= stored[0]["mean"] + 0.1


def _stored(path: Path) -> Table:
    table = json.loads(path.read_text(encoding="utf-8"))["suites"]["pipeline"]["tables"]["errors"]
    return Table(tuple(table["columns"]), [tuple(row) for row in table["rows"]])


def _measured(section_, remap: str, method: Method) -> float:
    pair = pairs.make_pair(section_, remap)
    own = own_variant(method.preset)
    return color_errors(Matched(pair.volume, section_.rgb, method).chroma(own["smoother"], own["gamma"]), pair).mean
