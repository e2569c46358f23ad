"""The report: one HTML page that needs nothing beside it."""

from __future__ import annotations

import base64
from html import escape
from typing import Any

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1150px; margin: 2em auto; padding: 0 1em; color: #1a1a1a }
table { border-collapse: collapse; font-size: 13px; margin: .6em 0 } caption { text-align: left; font-weight: 600 }
th, td { border-bottom: 1px solid #ddd; padding: .15em .6em; text-align: left; vertical-align: top }
td.number { text-align: right; font-variant-numeric: tabular-nums } img { max-width: 100% }
.FAIL, .no { background: #fbd5d5 } .pass, .yes { background: #dff2e1 } .refused { background: #e8edf7 }
details { margin: .6em 0 } summary { cursor: pointer; font-weight: 600 }
"""
_TITLES = {
    "time": "Error against time",
    "pipeline": "The whole pipeline",
    "quality": "What each improvement brings",
    "smoothing": "Smoothing",
    "correspondence": "Correspondence",
    "features": "Features",
    "profile": "Where the time goes",
    "sidebyside": "Side by side with others",
    "scaling": "Growth",
    "stability": "Stability",
}
_PLOTS = {
    "time": ("error_against_time",),
    "quality": ("seen", "quality"),
    "smoothing": ("smoothing", "rounding"),
    "correspondence": ("correspondence",),
    "profile": ("profile",),
    "scaling": ("scaling",),
}
_OPEN = ("summary", "stability", "regions", "calls", "features", "beaten", "coherence", "seen", "against_time")
_LONG = 60  # rows from which a table is folded


def make_page(data: dict, pictures: dict[str, bytes]) -> str:
    """HTML of checked results (`schema.check_results`) and PNG pictures by name."""
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>MedColor benchmark</title>",
        f"<style>{_STYLE}</style>",
    ]
    parts += ["<h1>MedColor benchmark</h1>", _machine(data)]
    if data["targets"]["rows"]:
        parts += ["<h2>Targets</h2>", _table("targets", data["targets"])]
    for name, suite in data["suites"].items():
        parts.append(f"<h2>{_TITLES[name]}</h2>")
        parts += [_picture(plot, pictures[plot]) for plot in _PLOTS.get(name, ()) if plot in pictures]
        parts.append("<ul>" + "".join(f"<li>{escape(note)}" for note in suite["notes"]) + "</ul>")
        parts += [_table(table, content) for table, content in suite["tables"].items()]
        parts.append(_failures(suite["failures"]))
    return "\n".join(parts) + "\n"


def _machine(data: dict) -> str:
    environment, options = data["environment"], data["options"]
    versions = ", ".join(f"{name} {version}" for name, version in environment["versions"].items())
    load = " and ".join(
        "unknown" if v is None else f"{v:g}" for v in (environment["load_before"], environment["load_after"])
    )
    kind = "quick run" if options["quick"] else "full run"
    lines = (
        f"MedColor {data['medcolor']}, {kind}, seed {options['seed']}, sections: {', '.join(options['sections']) or 'none'}.",
        f"{environment['cpu']}; {environment['machine']}; device {environment['device']}; load before and after {load}.",
        versions,
    )
    return "".join(f"<p>{escape(line)}</p>" for line in lines)


def _picture(name: str, png: bytes) -> str:
    return f'<p><img alt="{name}" src="data:image/png;base64,{base64.b64encode(png).decode()}"></p>'


def _failures(failures: list) -> str:
    if not failures:
        return ""
    rows = "".join(f"<li><b>{escape(what)}</b>: {escape(reason)}" for what, reason in failures)
    return f"<p>Left out or failed, with the reason:</p><ul>{rows}</ul>"


def _table(name: str, table: dict) -> str:
    head = "".join(f"<th>{escape(column.replace('_', ' '))}</th>" for column in table["columns"])
    body = "".join(f"<tr>{''.join(_cell(c, v) for c, v in zip(table['columns'], row))}</tr>" for row in table["rows"])
    content = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    opened = " open" if name in _OPEN or len(table["rows"]) < _LONG else ""
    return f"<details{opened}><summary>{escape(name)} ({len(table['rows'])} rows)</summary>{content}</details>"


def _cell(column: str, value: Any) -> str:
    if value is None:
        return "<td></td>"
    if isinstance(value, bool):
        mark = ("yes" if value else "no") if column == "met" else ""
        return f'<td class="{mark}">{"yes" if value else "no"}</td>'
    if isinstance(value, (int, float)):
        return (
            f'<td class="number">{value:.3g}</td>' if isinstance(value, float) else f'<td class="number">{value}</td>'
        )
    mark = f' class="{value}"' if column == "verdict" else ""
    return f"<td{mark}>{escape(value)}</td>"
