"""What suites hand over: tables of plain values, and what failed with its reason."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Table:
    """Rows of plain values (text, numbers, booleans, None) under named columns."""

    columns: tuple[str, ...]
    rows: list[tuple] = field(default_factory=list)

    def add(self, **values: Any) -> None:
        """Append a row; columns not named are None, floats are kept to six significant digits."""
        unknown = set(values) - set(self.columns)
        if unknown:
            raise KeyError(f"no column {', '.join(sorted(unknown))}")
        self.rows.append(tuple(_plain(values.get(name)) for name in self.columns))

    def where(self, **wanted: Any) -> list[dict]:
        """Rows, as dictionaries, whose columns have the values wanted."""
        rows = (dict(zip(self.columns, row)) for row in self.rows)
        return [row for row in rows if all(row[name] == value for name, value in wanted.items())]

    def to_dict(self) -> dict:
        """JSON-ready."""
        return {"columns": list(self.columns), "rows": [list(row) for row in self.rows]}


@dataclass
class Suite:
    """What one suite measured.

    Attributes:
        tables: by name. failures: (what, reason), also for times that do not count.
        notes: how it was measured, one sentence each.
    """

    tables: dict[str, Table] = field(default_factory=dict)
    failures: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def to_dict(self) -> dict:
        """JSON-ready."""
        tables = {name: table.to_dict() for name, table in self.tables.items()}
        return {"tables": tables, "failures": [list(f) for f in self.failures], "notes": self.notes}


@dataclass(frozen=True)
class Seconds:
    """Run time: median and quartiles of `runs` runs after a warm-up."""

    median: float
    low: float
    high: float
    runs: int

    def columns(self) -> dict[str, float | int]:
        """As the columns that tables use."""
        return {"seconds": self.median, "seconds_low": self.low, "seconds_high": self.high, "runs": self.runs}


_SLOW_S = 5.0
TIME_COLUMNS = ("seconds", "seconds_low", "seconds_high", "runs")


def timed(call: Callable[[], Any], runs: int, least_s: float = 0.0, warm: bool = False) -> tuple[Any, Seconds]:
    """Result of the first call, which is the warm-up, and the time of the following ones.

    Args:
        warm: the warm-up has taken place; every call counts, and the result is None.
        runs: at least this many, and more (up to ten times as many) until `least_s` seconds are spent; one where a call
            takes more than 5 s.
    """
    result = None if warm else call()
    seconds: list[float] = []
    while len(seconds) < (1 if seconds and seconds[0] > _SLOW_S else runs) or (
        sum(seconds) < least_s and len(seconds) < 10 * runs
    ):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return result, seconds_of(seconds)


def seconds_of(measured: list[float]) -> Seconds:
    """Median and quartiles of one or more run times."""
    if len(measured) < 2:
        return Seconds(measured[0], measured[0], measured[0], 1)
    low, median, high = statistics.quantiles(measured, n=4, method="inclusive")
    return Seconds(median, low, high, len(measured))


def _plain(value: Any) -> Any:
    if isinstance(value, bool) or value is None or isinstance(value, (str, int)):
        return value
    number = float(value)
    return float(f"{number:.6g}") if math.isfinite(number) else str(number)
