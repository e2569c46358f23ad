"""What all diagrams share: palette, markers, an empty figure, its PNG. Needs matplotlib."""

from __future__ import annotations

from io import BytesIO

# Okabe and Ito's palette: told apart by everybody
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = "osD^vPX"


def figure_of(columns: int, width: float = 4.6, height: float = 4.4, shared: bool | str = True, rows: int = 1):
    """An empty figure and its axes row by row, both of which are logarithmic; `shared`: with one vertical scale."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=shared).ravel()
    for axis in axes:
        axis.set(xscale="log", yscale="log")
        axis.grid(True, which="both", alpha=0.25)
    return figure, axes


def png_of(figure) -> bytes:
    """The figure as a PNG file."""
    stream = BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()
