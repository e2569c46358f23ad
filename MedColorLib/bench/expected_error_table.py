"""From a stored result to the table of `MedColorLib.run.expected_error`:

python -m MedColorLib.bench.expected_error_table Testing/Benchmark/results/RESULT.json
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from ..run.expected_error import TABLE
from .schema import check_results
from .summary import BASELINES


def make_table(data: dict, name: str) -> dict:
    """Features, method, smoother, gamma and [lowest, highest mean CIEDE2000, the pairs they belong to, number of pairs].

    Args:
        data: content of a file of results. name: of that file.

    Raises:
        InputError: not such a file.
    """
    check_results(data)
    errors = data["suites"]["pipeline"]["tables"]["errors"]
    pairs: dict[tuple, list[tuple[float, str]]] = {}
    for values in errors["rows"]:
        row = dict(zip(errors["columns"], values))
        if row["method"] not in BASELINES:
            key = (row["features"], row["method"], row["smoother"], row["gamma"])
            pairs.setdefault(key, []).append((row["mean"], f"{row['section']}, {row['remap']}"))
    rows = []
    for key, found in pairs.items():
        (low, easiest), (high, hardest) = min(found), max(found)
        rows.append([*key, [low, high, easiest, hardest, len(found)]])
    return {"made_from": name, "medcolor": data["medcolor"], "rows": rows}


def to_text(table: dict) -> str:
    """JSON with a row a line."""
    rows = ",\n".join("  " + json.dumps(row) for row in table["rows"])
    head = "".join(f' "{name}": {json.dumps(table[name])},\n' for name in ("made_from", "medcolor"))
    return f'{{\n{head} "rows": [\n{rows}\n ]\n}}\n'


def main(path: str) -> None:
    """Write the table made from the results at `path`."""
    source = Path(path)
    table = make_table(json.loads(source.read_text(encoding="utf-8")), source.name)
    temporary = TABLE.with_suffix(".part")
    temporary.write_text(to_text(table), encoding="utf-8")
    os.replace(temporary, TABLE)


if __name__ == "__main__":
    main(sys.argv[1])
