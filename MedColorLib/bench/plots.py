"""Work-precision diagrams: error on one axis, run time on the other, both logarithmic. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Callable

from . import plots_suites
from .figures import COLORS, MARKERS, figure_of, png_of
from .suite_smoothing import IMPLEMENTATIONS, SCENES
from .tables import Suite

_FLOOR = 1e-6  # where an error of zero is drawn on a logarithmic axis


def draw_all(suites: dict[str, Suite]) -> dict[str, bytes]:
    """PNG by name, for the suites that were run."""
    plots: dict[str, tuple[str, Callable[[Suite], bytes]]] = {
        "error_against_time": ("time", plots_suites.error_against_time),
        "smoothing": ("smoothing", _smoothing),
        "rounding": ("smoothing", _rounding),
        "correspondence": ("correspondence", _correspondence),
        "quality": ("quality", plots_suites.quality),
        "profile": ("profile", plots_suites.profile),
        "scaling": ("scaling", plots_suites.scaling),
    }
    drawn = {name: draw(suites[suite]) for name, (suite, draw) in plots.items() if suite in suites}
    if "seen" in getattr(suites.get("quality"), "tables", ()):
        drawn["seen"] = plots_suites.seen(suites["quality"])
    return drawn


def _finished(figure, axes, plain_errors: bool = True) -> bytes:
    """Legend, ticks as plain numbers (1, 2, 5), and the PNG."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    axes[0].legend(fontsize=7)
    for axis in axes:
        axis.margins(x=0.12)
        for side in (axis.xaxis, axis.yaxis) if plain_errors else (axis.xaxis,):
            side.set_major_locator(
                LogLocator(subs=(1, 2, 5) if side is axis.xaxis else (1, 1.5, 2, 3, 5, 7), numticks=30)
            )
            side.set_major_formatter(FormatStrFormatter("%g"))
            side.set_minor_formatter(NullFormatter())
        axis.tick_params(labelsize=8)
    return png_of(figure)


def _smoothing(suite: Suite) -> bytes:
    table = suite.tables["fgs"]
    figure, axes = figure_of(len(SCENES))
    for axis, (scene, (lam, sigma)) in zip(axes, SCENES.items()):
        for number, method in enumerate(IMPLEMENTATIONS):
            rows = [row for row in table.where(scene=scene, method=method) if row["seconds"]]
            name = "OpenCV" if method == "opencv" else f"MedColor {method}"
            points = [row["seconds"] for row in rows], [row["rms_to_wls"] for row in rows]
            axis.plot(*points, marker=MARKERS[number], color=COLORS[number], label=f"FGS, {name}")
            for row in rows:
                axis.annotate(
                    row["iterations"],
                    (row["seconds"], row["rms_to_wls"]),
                    fontsize=6,
                    xytext=(3, 3),
                    textcoords="offset points",
                )
        for number, method in enumerate(
            ("guided", "domain-transform", "wls", "regression"), start=len(IMPLEMENTATIONS)
        ):
            measured = [
                row
                for row in table.where(scene=scene, method=method)
                if None not in (row["seconds"], row["rms_to_wls"])
            ]
            for row in measured:
                axis.plot(row["seconds"], row["rms_to_wls"], MARKERS[number], color=COLORS[number], label=method)
        exact = table.where(scene=scene, method="exact WLS")[0]
        axis.axvline(exact["seconds"], color="0.4", linestyle="--", linewidth=1, label="exact WLS, sparse direct")
        axis.set(
            title=f"lambda {lam:g}, sigma {sigma:g}",
            xlabel="seconds, 256 x 256 x 2",
            ylabel="RMS distance to exact WLS / deviation",
        )
    return _finished(figure, axes)


def _rounding(suite: Suite) -> bytes:
    table = suite.tables["stiff"]
    figure, (axis,) = figure_of(1, 6.0)
    for number, method in enumerate(IMPLEMENTATIONS):
        rows = table.where(method=method)
        finite = [row for row in rows if not isinstance(row["max_to_separable"], str)]
        values = [max(row["max_to_separable"], 1e-17) for row in finite]
        name = "OpenCV" if method == "opencv" else f"MedColor {method}"
        axis.plot([r["lambda"] for r in finite], values, marker=MARKERS[number], color=COLORS[number], label=name)
        lost = [row["lambda"] for row in rows if isinstance(row["max_to_separable"], str)]
        if lost:
            axis.plot(lost, [1.0] * len(lost), "x", color=COLORS[number], markersize=9, label=f"{name}: not a number")
    axis.axhline(1e-5, color="0.4", linestyle="--", linewidth=1, label="bound 1e-5")
    axis.set(
        xlabel="lambda", ylabel="largest error / largest source value", title="FGS: rounding against extended precision"
    )
    axis.legend(fontsize=7)
    return png_of(figure)


def _correspondence(suite: Suite) -> bytes:
    table = suite.tables["fields"]
    first = table.where()[0]
    keys = {name: first[name] for name in ("section", "remap", "features")}
    layers = sorted({row["layer"] for row in table.where(**keys)}, reverse=True)
    figure, axes = figure_of(len(layers))
    for axis, layer in zip(axes, layers):
        for number, start in enumerate(("coarser layer", "chance")):
            rows = [r for r in table.where(**keys, layer=layer, method="patchmatch", start=start) if r["iterations"]]
            points = [r["seconds"] for r in rows], [max(r["energy_ratio"] - 1, _FLOOR) for r in rows]
            axis.plot(*points, marker=MARKERS[number], color=COLORS[number], label=f"PatchMatch from {start}")
            for row, x, y in zip(rows, *points):
                axis.annotate(row["iterations"], (x, y), fontsize=6, xytext=(3, 3), textcoords="offset points")
        for number, method in enumerate(("windowed", "exact, float32", "exact, bfloat16"), start=2):
            for row in table.where(**keys, layer=layer, method=method):
                value = max(row["energy_ratio"] - 1, _FLOOR)
                axis.plot(row["seconds"], value, MARKERS[number], color=COLORS[number], label=method)
        axis.set(
            title=f"{keys['section']}, {keys['features']}, layer {layer}",
            xlabel="seconds",
            ylabel="energy / exhaustive - 1",
        )
    return _finished(figure, axes, plain_errors=False)
