"""The error told before a run: the stored benchmark's, for these settings; and when a probe is unlike its pairs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from MedColorLib import Settings
from MedColorLib.bench import expected_error_table
from MedColorLib.bench.expected_error_table import make_table, to_text
from MedColorLib.errors import InputError
from MedColorLib.run.estimate import Estimate, estimate
from MedColorLib.run.expected_error import LEAST_TRUSTED, NOT_MEASURED, TABLE, ExpectedError, expected_error

RESULTS = Path(__file__).parents[2] / "Benchmark" / "results"
BALANCED = Settings(preset="balanced", features="embedded", device="cpu")


def stored() -> dict:
    return json.loads(TABLE.read_text(encoding="utf-8"))


def test_table_is_the_stored_benchmarks():
    """Made anew by `python -m MedColorLib.bench.expected_error_table Testing/Benchmark/results/RESULT.json`."""
    source = RESULTS / stored()["made_from"]
    table = make_table(json.loads(source.read_text(encoding="utf-8")), source.name)
    assert to_text(table) == TABLE.read_text(encoding="utf-8")


@pytest.mark.parametrize("preset", ["draft", "balanced"])
def test_range_is_that_of_the_pairs(preset):
    """Against a plain look through the stored rows."""
    results = json.loads((RESULTS / stored()["made_from"]).read_text(encoding="utf-8"))
    table = results["suites"]["pipeline"]["tables"]["errors"]
    rows = [dict(zip(table["columns"], row)) for row in table["rows"]]
    wanted = {"features": "embedded", "method": preset, "smoother": "regression", "gamma": False}
    means = [row["mean"] for row in rows if wanted.items() <= row.items()]
    found = expected_error(replace(BALANCED, preset=preset), "embedded")
    assert (found.low, found.high, found.pairs) == (min(means), max(means), len(means))
    assert f"{min(means):.1f}" in found.text() and f"{max(means):.1f}" in found.text()
    assert f"{len(means)} pairs" in found.text()


@pytest.mark.parametrize(
    "changes",
    [{"luminance": "paper"}, {"smoother_options": {"bins": 16}}, {"reconstruction": "lbfgs"}],
    ids=["luminance", "options", "reconstruction"],
)
def test_nothing_is_said_of_what_was_not_measured(changes):
    assert expected_error(BALANCED, "embedded") is not None
    assert expected_error(replace(BALANCED, **changes), "embedded") is None
    assert expected_error(BALANCED, "gray-vgg19") is None


def test_writing_the_table(tmp_path, monkeypatch):
    monkeypatch.setattr(expected_error_table, "TABLE", tmp_path / "table.json")
    expected_error_table.main(str(RESULTS / stored()["made_from"]))
    assert json.loads((tmp_path / "table.json").read_text(encoding="utf-8")) == stored()
    assert [file.name for file in tmp_path.iterdir()] == ["table.json"]
    with pytest.raises(InputError, match="results"):
        make_table({"schema": 0}, "no.json")


class TestText:
    RANGE = ExpectedError(1.0, 4.0, "thorax, as it is", "thorax, extreme", 5)

    def text(self, trusted: float | None, error: ExpectedError | None = RANGE) -> str:
        return Estimate(1.0, 1.0, 1.0, 1, 1.0, error, trusted, 0.55).error_text()

    def test_probe_like_the_pairs(self):
        assert self.text(0.8).endswith("80 % of the probe's matches can be trusted, as on these pairs")

    def test_probe_matched_worse_than_every_pair(self):
        assert "only 20 % can be trusted, on these pairs at least 55 %: expect more" in self.text(0.2)

    def test_probe_without_trust_gives_the_range_alone(self):
        assert self.text(None) == self.RANGE.text()

    def test_not_measured(self):
        assert self.text(0.8, None) == NOT_MEASURED

    def test_one_pair_is_no_range(self):
        text = replace(self.RANGE, high=1.0, pairs=1).text()
        assert text == "mean CIEDE2000 1.0 on the one pair of the benchmark (thorax, as it is)"


def test_estimate_looks_at_this_volume(ct):
    found = estimate(ct.volume, [ct.reference], replace(BALANCED, preset="draft"))
    assert found.error == expected_error(replace(BALANCED, preset="draft"), "embedded")
    assert 0 < found.trusted_fraction <= 1 and found.least_trusted == LEAST_TRUSTED["embedded"]
    alone = estimate(
        ct.volume, [ct.reference], Settings(preset="full", features="embedded", device="cpu", slices=(5, 6))
    )
    assert alone.trusted_fraction is None


@pytest.mark.slow
def test_pairs_are_trusted_as_much_as_is_said():
    from MedColorLib import colorize
    from MedColorLib.bench.matched import Method
    from MedColorLib.bench.pairs import REMAPS, load_sections, make_pair

    section = load_sections(None)[0]
    for remap in REMAPS:
        pair = make_pair(section, remap)
        report = colorize(pair.volume, [section.rgb], Method("embedded", "balanced").settings(device="cpu")).report
        assert report["trusted_fraction"]["0"] >= LEAST_TRUSTED["embedded"]


def test_command_line_tells_it_before_the_run(ct, tmp_path, capsys):
    import cv2
    from volume_samples import save_nrrd

    from MedColorLib.cli.main import main

    save_nrrd(tmp_path / "scan.nrrd", ct.volume.array, ct.volume.ijk_to_ras, encoding="raw")
    cv2.imwrite(str(tmp_path / "section.png"), ct.reference[..., ::-1])
    options = ["--preset", "draft", "--features", "embedded", "--device", "cpu", "--slices", "4:6", "--plan"]
    assert main(["colorize", str(tmp_path / "scan.nrrd"), "-r", str(tmp_path / "section.png"), *options]) == 0
    expected = expected_error(replace(BALANCED, preset="draft"), "embedded").text()
    assert f"Colour error to expect: {expected}" in capsys.readouterr().out
