"""Diagrams of the suites quality, profile and scaling. Needs matplotlib."""

from __future__ import annotations

import numpy as np

from .figures import COLORS, MARKERS, figure_of, png_of
from .measures import SEEN_BARS
from .suite_profile import PER_SLICE
from .tables import Suite


def quality(suite: Suite) -> bytes:
    """Bars of the error of every mode on the first pair, and the same errors against time."""
    table = suite.tables["improvements"]
    first = table.where()[0]
    rows = table.where(section=first["section"], remap=first["remap"])
    names = [f"{row['method']} ({row['features']})" if row["features"] else row["method"] for row in rows]
    places = np.arange(len(rows))[::-1]
    figure, (bars, plane) = figure_of(2, 6.0, 0.8 + 0.26 * len(rows))
    bars.set(xscale="linear", yscale="linear")  # before the ticks, which a change of scale takes away
    plane.set(yscale="linear")
    bars.barh(places, [row["mean"] for row in rows], color=[COLORS[0] if row["features"] else "0.6" for row in rows])
    for row, place in zip(rows, places):
        if row["seconds"] is None:
            continue
        plane.errorbar(
            row["seconds"], place, xerr=_around(row), marker="o", color=COLORS[1], linestyle="none", markersize=4
        )
    bars.set_yticks(places, names, fontsize=7)
    bars.set(xlabel="mean CIEDE2000", title=f"{first['section']}, luminance {first['remap']}")
    plane.set(xlabel="seconds per slice of 256 x 256", title="seconds of the same lines")
    _plain_ticks(plane.xaxis)
    return png_of(figure)


def seen(suite: Suite) -> bytes:
    """Error against detail on the CT head, and a bar a method for what a viewer sees, with the limits of the defaults."""
    table = suite.tables["seen"]
    wanted = (row for row in table.where() if row["measure"] in SEEN_BARS and row["limit"] is not None)
    bars_of = list({(row["measure"], row["what"]): row for row in reversed([*wanted])}.values())[::-1]
    methods = list(dict.fromkeys(row["method"] for row in table.where()))
    figure, (plane, bars) = figure_of(2, 6.0, 1.2 + 0.13 * len(bars_of) * (len(methods) + 1), shared=False)
    for axis in (plane, bars):
        axis.set(xscale="linear", yscale="linear")
    for number, method in enumerate(methods):
        error = table.where(measure="CT slice 122", method=method)
        detail = table.where(measure="detail, correlation", what="CT head", method=method)
        style = {"color": (*COLORS, "#F0E442", "0.6")[number], "label": method}
        if error and detail:
            plane.plot(detail[0]["value"], error[0]["value"], MARKERS[number % len(MARKERS)], **style)
        for place, wanted in enumerate(bars_of):
            row = table.where(measure=wanted["measure"], what=wanted["what"], method=method)
            height = len(bars_of) - 1 - place - 0.8 * number / len(methods)
            if row:
                bars.barh(height, row[0]["value"], height=0.8 / len(methods), color=style["color"])
    for place, wanted in enumerate(bars_of):
        top = len(bars_of) - 1 - place
        bars.plot([wanted["limit"]] * 2, [top + 0.1, top - 0.8], color="black", linewidth=1)
    names = [f"{row['measure']}, {row['what']}" for row in bars_of]
    bars.set_yticks(np.arange(len(bars_of))[::-1] - 0.35, names, fontsize=7)
    bars.set(xlabel="mean CIEDE2000; the line is the limit", title="what a viewer sees")
    plane.set(
        xlabel="detail: mean local correlation",
        ylabel="error: mean CIEDE2000 of the regions",
        title="CT head, slice 122",
    )
    if plane.has_data():
        plane.set_ylim(bottom=0)
        plane.legend(fontsize=7)
    return png_of(figure)


def error_against_time(suite: Suite) -> bytes:
    """The error that is seen above that of colour alone, a column a scan; a colour and a marker for each method."""
    table = suite.tables["against_time"]
    scans, methods = (list(dict.fromkeys(row[name] for row in table.where())) for name in ("scan", "method"))
    figure, axes = figure_of(len(scans), 4.4, 3.4, shared="row", rows=2)
    for number, axis in enumerate(axes):
        scan, column = scans[number % len(scans)], ("seen", "chroma")[number // len(scans)]
        axis.set(yscale="linear", xlabel="seconds of a core a slice", title=scan if column == "seen" else None)
        if number % len(scans) == 0:
            axis.set_ylabel(f"mean CIEDE2000,\n{_ERRORS[column]}")
            axis.set_ylim(0, 1.1 * max(row[column] or 0 for row in table.where()))
        for row in table.where(scan=scan):
            if row[column] is not None:
                bar = None if row["runs"] is None else _around(row)
                axis.errorbar(row["seconds"], row[column], xerr=bar, **_style(methods.index(row["method"])))
        axis.set_xlim(*_ends([row["seconds"] for row in table.where()]))
        _plain_ticks(axis.xaxis, (1,))
        axis.tick_params(labelsize=7)
    handles = [axes[0].plot([], [], label=method, **_style(n))[0] for n, method in enumerate(methods)]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(5, len(handles)), fontsize=8)
    return png_of(figure)


_ERRORS = {"seen": "lightness included", "chroma": "of a*, b* alone"}


def _ends(values: list[float]) -> tuple[float, float]:
    """Of a logarithmic axis for positive values, with some room."""
    return min(values) / 2, 2 * max(values)


def _style(number: int) -> dict:
    """How the points of a method look; filled, then hollow."""
    color, marker = COLORS[number % len(COLORS)], MARKERS[number % len(MARKERS)]
    fill = color if number < len(COLORS) else "none"
    return {"color": color, "marker": marker, "markerfacecolor": fill, "linestyle": "none", "markersize": 8}


def _around(row: dict) -> list[list[float]]:
    """Horizontal error bar of a row: median to the quartiles."""
    return [[row["seconds"] - row["seconds_low"]], [row["seconds_high"] - row["seconds"]]]


def _plain_ticks(side, steps: tuple[int, ...] = (1, 2, 5)) -> None:
    """1, 2, 5 and their decades as plain numbers along a logarithmic axis."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    side.set_major_locator(LogLocator(subs=steps, numticks=30))
    side.set_major_formatter(FormatStrFormatter("%g"))
    side.set_minor_formatter(NullFormatter())


def profile(suite: Suite) -> bytes:
    """Stacked bars: the share of every stage in the time of a slice."""
    table = suite.tables["stages"]
    kinds = list(dict.fromkeys((row["features"], row["method"], row["side_px"]) for row in table.where()))
    figure, (axis,) = figure_of(1, 9.0, 1.4 + 0.4 * len(kinds))
    axis.set(xscale="linear", yscale="linear", xlabel="seconds per slice")
    places = np.arange(len(kinds))[::-1]
    left = np.zeros(len(kinds))
    for color, stage in zip((*COLORS, "#F0E442", "0.6"), PER_SLICE):
        taken = []
        for features, method, side in kinds:
            rows = table.where(features=features, method=method, side_px=side, stage=stage)
            taken.append(rows[0]["seconds"] if rows else 0.0)  # the own features have no descent
        axis.barh(places, taken, left=left, color=color, label=stage)
        left += taken
    axis.set_yticks(places, [f"{features} {method}, {side} px" for features, method, side in kinds], fontsize=8)
    axis.legend(fontsize=7, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return png_of(figure)


def scaling(suite: Suite) -> bytes:
    """Seconds over size, both logarithmic, a panel a unit."""
    times, fits = suite.tables["scaling"], suite.tables["exponents"]
    units = list(dict.fromkeys(row["unit"] for row in times.where()))
    figure, axes = figure_of(len(units), 3.6)
    for axis, unit in zip(axes, units):
        for number, what in enumerate(dict.fromkeys(row["what"] for row in times.where(unit=unit))):
            rows = times.where(what=what)
            exponent = fits.where(what=what)[0]["exponent"]
            points = [row["x"] for row in rows], [row["seconds"] for row in rows]
            label = f"{what}: {exponent:.2f}"
            axis.plot(*points, marker=MARKERS[number], color=COLORS[number], label=label)
        axis.set(xlabel=unit, ylabel="seconds")
        for side in (axis.xaxis, axis.yaxis) if unit != "pixels" else (axis.yaxis,):
            _plain_ticks(side)
        axis.legend(fontsize=7, title="exponent", title_fontsize=7)
    return png_of(figure)
