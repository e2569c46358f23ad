"""What a file of results looks like; checked before it is written, and for every file under Testing/Benchmark/results."""

from __future__ import annotations

import json
from typing import Any

from ..errors import InputError
from . import (
    deconvolution,
    machine,
    measures,
    outline,
    real_volumes,
    regions,
    slabs,
    stability,
    suite_correspondence,
    suite_features,
    suite_pipeline,
    suite_profile,
    suite_quality,
    suite_scaling,
    suite_sidebyside,
    suite_smoothing,
    suite_time,
    summary,
)

SCHEMA = 1
TABLES = {
    "against_time": suite_time.COLUMNS,
    "errors": suite_pipeline.COLUMNS,
    "calls": suite_pipeline.CALL_COLUMNS,
    "regions": regions.COLUMNS,
    "fgs": suite_smoothing.COLUMNS,
    "stiff": suite_smoothing.STIFF_COLUMNS,
    "fields": suite_correspondence.COLUMNS,
    "deconvolution": deconvolution.COLUMNS,
    "features": suite_features.COLUMNS,
    "improvements": suite_quality.COLUMNS,
    "beaten": suite_quality.BEATEN_COLUMNS,
    "coherence": slabs.COLUMNS,
    "seen": measures.COLUMNS,
    "seen_regions": measures.REGION_COLUMNS,
    "reference_warnings": measures.WARNING_COLUMNS,
    "outline": outline.COLUMNS,
    "stages": suite_profile.COLUMNS,
    "machine": machine.COLUMNS,
    "network": suite_profile.NETWORK_COLUMNS,
    "volumes": real_volumes.COLUMNS,
    "sidebyside": suite_sidebyside.COLUMNS,
    "scaling": suite_scaling.COLUMNS,
    "exponents": suite_scaling.EXPONENT_COLUMNS,
    "memory": suite_scaling.MEMORY_COLUMNS,
    "stability": stability.COLUMNS,
    "summary": summary.SUMMARY_COLUMNS,
    "targets": summary.TARGET_COLUMNS,
}
_NOT_FINITE = ("nan", "inf", "-inf")
_VERDICTS = ("pass", "refused", "FAIL")
_TEXT = {
    "section", "remap", "features", "method", "smoother", "what", "region", "scene", "start", "precision", "area", "case",
    "condition", "expected", "got", "verdict", "beside", "target", "baseline", "volume", "stage", "per", "unit",
    "measure", "picture", "said", "scan",
}  # fmt: skip
_FLAGS = {"gamma", "met", "right", "noticed"}


def check_results(data: Any) -> None:
    """Check a file of results.

    Raises:
        InputError: the first thing that is wrong, and where.
    """
    _keys("results", data, {"schema", "medcolor", "options", "environment", "targets", "suites"})
    if data["schema"] != SCHEMA:
        raise InputError(f"results: schema {data['schema']!r}, this program reads {SCHEMA}; measure again")
    _keys("options", data["options"], {"quick", "stability", "seed", "sections"})
    _keys("environment", data["environment"], {"versions", "machine", "device", "cpu", "load_before", "load_after"})
    _table("targets", "targets", data["targets"])
    for name, suite in data["suites"].items():
        _keys(f"suite {name}", suite, {"tables", "failures", "notes", "seconds"})
        for failure in suite["failures"]:
            if len(failure) != 2 or not all(isinstance(part, str) and part for part in failure):
                raise InputError(f"suite {name}: a failure must be what and why, got {failure!r}")
        for table, content in suite["tables"].items():
            _table(f"suite {name}, table {table}", table, content)


def _keys(where: str, data: Any, wanted: set[str]) -> None:
    if not isinstance(data, dict) or set(data) != wanted:
        got = ", ".join(sorted(data)) if isinstance(data, dict) else type(data).__name__
        raise InputError(f"{where}: expected the keys {', '.join(sorted(wanted))}, got {got}")


def _table(where: str, name: str, table: Any) -> None:
    _keys(where, table, {"columns", "rows"})
    if name not in TABLES or tuple(table["columns"]) != TABLES[name]:
        raise InputError(f"{where}: unknown table or other columns: {table['columns']}")
    if not table["rows"] and name not in ("targets",):
        raise InputError(f"{where}: no rows")
    for number, row in enumerate(table["rows"]):
        if len(row) != len(table["columns"]):
            raise InputError(f"{where}, row {number}: {len(row)} values for {len(table['columns'])} columns")
        for column, value in zip(table["columns"], row):
            if not _fits(column, value):
                raise InputError(f"{where}, row {number}, {column}: unexpected {value!r}")


def _fits(column: str, value: Any) -> bool:
    if value is None:
        return column != "verdict"
    if column in _FLAGS:
        return isinstance(value, bool)
    if column in _TEXT:
        return isinstance(value, str) and (column != "verdict" or value in _VERDICTS)
    if isinstance(value, str):
        return value in _NOT_FINITE
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return value > 0 if column.startswith("seconds") or column == "runs" else True


def to_text(data: dict) -> str:
    """JSON with one line per row of a table, so that two files can be compared line by line."""
    rows: list[str] = []

    def marked(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: [_mark(rows, row) for row in v] if k == "rows" else marked(v) for k, v in value.items()}
        return value

    text = json.dumps(marked(data), indent=1)
    for number, row in enumerate(rows):
        text = text.replace(f'"@row {number}@"', row, 1)
    return text + "\n"


def _mark(rows: list[str], row: list) -> str:
    rows.append(json.dumps(row))
    return f"@row {len(rows) - 1}@"
