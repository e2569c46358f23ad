"""The benchmark's table of measures on real images: what is run, what is kept, what the page and the targets make of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from MedColorLib import Settings
from MedColorLib.bench import measures, schema, seen, trivial
from MedColorLib.bench.measures import DEFAULT, Figure
from MedColorLib.bench.pairs import SECTIONS
from MedColorLib.bench.summary import ALL_TOGETHER, all_targets
from MedColorLib.bench.tables import Suite, Table
from MedColorLib.errors import InputError


def lower(run):
    yield Figure("CT slice 122", "10 regions", 5.0, 11.0, 6.0, 12.0)
    yield Figure("CT slice 122", "10 regions, exposure as it is", 7.0, 13.0)


def higher(run):
    yield Figure("detail, correlation", "CT head", 0.8, limit=0.85)


def broken(run):
    raise InputError("no body; choose another volume")


@pytest.fixture
def folder(tmp_path) -> Path:
    """Stands for the real images, which the measures of these tests do not read."""
    for name in (*SECTIONS.values(), seen.CT_FILE, seen.CHEST_FILE):
        (tmp_path / name).write_bytes(b"")
    return tmp_path


@pytest.fixture
def suite(monkeypatch, folder) -> Suite:
    every = (DEFAULT, *trivial.METHODS)
    monkeypatch.setattr(measures, "MEASURES", {lower: every, higher: every, broken: (DEFAULT,)})
    found = Suite()
    measures.run(found, folder, False, lambda fraction, text: None)
    return found


class TestTable:
    def test_every_method_has_its_row_and_only_what_is_promised_is_judged(self, suite):
        table = suite.tables["seen"]
        assert [row["method"] for row in table.where(measure="detail, correlation")] == [DEFAULT, *trivial.METHODS]
        judged = {(row["method"], row["measure"]): row["met"] for row in table.where() if row["met"] is not None}
        assert judged == {
            (DEFAULT, "CT slice 122"): True,
            (DEFAULT, "detail, correlation"): False,
            (trivial.REFERENCE_END, "CT slice 122"): True,  # of detail nothing is promised there
        }

    def test_trivial_methods_have_no_features(self, suite):
        features = {row["method"]: row["features"] for row in suite.tables["seen"].where()}
        assert {name for name, value in features.items() if not value} == set(trivial.WITHOUT_FEATURES)

    def test_a_measure_that_fails_is_said_with_its_reason(self, suite):
        assert suite.failures == [("seen: broken, default", "no body; choose another volume")]

    def test_without_the_images_the_missing_ones_are_named(self, folder):
        for data in (None, folder / "nothing"):
            found = Suite()
            measures.run(found, data, False, lambda fraction, text: None)
            assert not found.tables
            assert seen.CHEST_FILE in found.failures[0][1]

    def test_a_quick_run_takes_no_more_than_a_full_one(self):
        for measure, names in measures._QUICK.items():
            assert set(names) <= set(measures.MEASURES[measure])

    def test_the_schema_knows_its_tables(self, suite):
        tables = {"seen": suite.tables["seen"]}
        tables["seen_regions"] = Table(measures.REGION_COLUMNS)
        tables["seen_regions"].add(measure="CT slice 122", method=DEFAULT, features="embedded", region="eye", error=3.0)
        tables["reference_warnings"] = Table(measures.WARNING_COLUMNS)
        tables["reference_warnings"].add(volume="a", picture="wood", right=False, noticed=True, said="refused: x")
        for name, table in tables.items():
            schema._table(name, name, table.to_dict())

    def test_the_slider_is_judged_by_its_own_limits(self):
        slider = trivial.REFERENCE_END
        table = Table(measures.COLUMNS)
        for name, measure in (
            (DEFAULT, "pairs seen"),
            (slider, "pairs seen"),
            (slider, "chest CT"),
            ("keep", "pairs seen"),
        ):
            own = measures.Run(name, None, Path(), Settings(features="embedded"), Suite())
            measures._add(table, own, Figure(measure, "inverted", 3.0, limit=None if name == DEFAULT else 4.0))
        assert [row["met"] for row in table.where()] == [None, True, None, None]
        rows = all_targets({"quality": Suite({"seen": table})}).where()
        assert [row["target"] for row in rows] == [f"pairs seen, inverted, {slider}"]

    def test_both_ends_of_the_slider_have_limits(self, monkeypatch, folder):
        result = seen.Regions(seen.Seen(5, 10, 1, 5, 10), {}, {}, {})
        monkeypatch.setattr(seen, "head_ct", lambda *_: result)
        met = {}
        for name in measures.JUDGED:
            own = measures.Run(name, None, folder, Settings(features="embedded"), Suite())
            met[name] = next(iter(measures.head_ct(own))).met
        assert met == {DEFAULT: True, trivial.REFERENCE_END: False}


class TestFigure:
    def test_limits(self):
        assert Figure("chest CT", "x", 7, 13, 8, 14).met is True
        assert Figure("chest CT", "x", 7, 15, 8, 14).met is False
        assert Figure("chest CT", "x", 9, 13, 8, 14).met is False
        assert Figure("chest CT, fat to muscle", "x", 31, limit=30).met is True
        assert Figure("chest CT, fat to muscle", "x", 29, limit=30).met is False
        assert Figure("detail, noise", "x", 3).met is None
        assert Figure("front against back", "x", float("nan"), limit=2.5).met is False


class TestTargets:
    def test_they_follow_from_the_table(self, suite):
        rows = {row["target"]: row for row in all_targets({"quality": suite}).where()}
        assert rows["CT slice 122, 10 regions"]["met"] is True
        assert rows["CT slice 122, 10 regions, worst"]["limit"] == 12
        assert rows["detail, correlation, CT head, at least"]["met"] is False
        slider = [name for name in rows if trivial.REFERENCE_END in name]
        assert slider == [f"CT slice 122, 10 regions, {trivial.REFERENCE_END}{end}" for end in ("", ", worst")]
        assert len(rows) == 3 + len(slider)

    def test_a_measure_without_a_number_is_not_met(self):
        table = Table(measures.COLUMNS)
        table.add(measure="front against back", what="x", method=DEFAULT, value=float("nan"), limit=2.5, met=False)
        rows = all_targets({"quality": Suite({"seen": table})}).where()
        assert [(row["value"], row["met"]) for row in rows] == [("nan", False)]

    def test_time_of_a_slice_is_the_defaults(self, suite):
        from MedColorLib.bench.suite_quality import COLUMNS

        own = next(iter({row["features"] for row in suite.tables["seen"].where(method=DEFAULT)}))
        table = suite.tables["improvements"] = Table(COLUMNS)
        table.add(section="thorax", remap="as it is", features="another", method=ALL_TOGETHER, seconds=0.5)
        table.add(section="thorax", remap="as it is", features=own, method=ALL_TOGETHER, seconds=0.09)
        found = [row for row in all_targets({"quality": suite}).where() if "seconds" in row["target"]]
        assert [(row["value"], row["met"]) for row in found] == [(0.09, True)]


def test_diagram_is_drawn(suite):
    pytest.importorskip("matplotlib")
    from MedColorLib.bench.plots_suites import seen as draw

    assert draw(suite).startswith(b"\x89PNG")
