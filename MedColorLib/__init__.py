"""MedColor: grey medical volumes in the colours of real anatomy. Headless library; the Slicer module is in `MedColor/`.

The data's way, from top to bottom; a folder imports from those below it, never from one above. A file is one stage, a folder
holds the files of one stage or the choice of alternatives:

| stage | where | takes -> gives |
| --- | --- | --- |
| command line | `cli/` | words -> one of the calls below; the demo |
| cohorts | `cohort/` | folder of volumes -> folder of results; processes, Dask |
| benchmark | `bench/` | -> tables, pictures and a page of error, time and stability |
| the map | `pipeline` | volume, references, settings -> `ColorVolume`: one call per stage |
| run | `run/prepare`, `run/engine`, `run/paint` | plan, and what is left out; batches of slices matched, then painted |
| interruption | `run/resume` | matches of an unfinished run, kept on disk |
| time points | `run/timepoints` | volumes of a series -> whose matches serve whom |
| looking about | `run/live` | volume, references, a slice -> its colours at once |
| forecast | `run/estimate`, `run/expected_error` | time and error to expect |
| colour | `coloring/transfer`, `coloring/coherence` | T', the scan's luminance, evidence of neighbours -> sRGB slice |
| which way up | `matching/orientation`, `matching/coarse` | how a photograph lies |
| contrast | `matching/contrast` | scan's grey -> the photograph's contrast, for matching only |
| correspondence | `matching/analogy`, `matching/reconstruction` | maps -> field, coarse to fine |
| search, vote | `matching/fields/`, `matching/vote` | maps -> nearest-neighbour field -> matched colours T' |
| confidence | `matching/confidence` | there and back, and likeness -> how far a match counts |
| choice of references | `matching/recommend`, `matching/assignment` | likeness -> reference of each slice |
| tissue guard | `matching/tissue_guard` | labels -> groups that matching and colour do not cross |
| references | `references/` | picture, folder, colour volume, library -> `Reference`s |
| volume in, out | `io/` | file -> `Volume` (k, j, i) with its place in space; `ColorVolume` -> file |
| scan | `scan/` | volume -> slices, body, display grey on one raster |
| features | `features/` | grey slice -> five maps |
| smoothers | `filters/` | picture, guide -> smooth picture |
| colour spaces | `color/` | sRGB, L*a*b*, differences, gamut |
| rendering | `rendering/` | `ColorVolume` -> pictures |
| words | `volume`, `parameters`, `plan`, `progress`, `report`, `device`, `errors` | what every stage speaks of |
| sample | `phantom/` | a head by formula: CT, MR and photographs of one anatomy, whose truth is known |

`pipeline.colorize` is the map: one call per stage. Nothing heavy is imported until it is used.

On import the environment variable OMP_WAIT_POLICY becomes "PASSIVE" unless it is set: torch's threads then sleep while they
wait for each other. By default they spin, and on a machine that is busy, each in the way of the one it waits for, a run
took ten times its share of the processor. torch reads it when it is first imported; a program that imports torch before
MedColorLib sets it itself.

>>> from MedColorLib import Settings
>>> Settings(preset="draft").resolved_smoother
'regression'
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # what `__getattr__` finds, for type checkers and editors; a test compares the two
    from .cohort.batch import run_batch
    from .filters import fast_global_smoother
    from .io.files import read_color_volume, read_time_points, read_volume, write_color_volume, write_confidence
    from .matching.tissue_guard import Guard
    from .parameters import Settings
    from .pipeline import colorize, colorize_time_points, make_plan, plan_time_points
    from .plan import Plan
    from .run.resume import Resume, forget_run
    from .volume import ColorVolume, Volume

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"

_WHERE = {
    "ColorVolume": "volume",
    "Guard": "matching.tissue_guard",
    "Plan": "plan",
    "Resume": "run.resume",
    "Settings": "parameters",
    "Volume": "volume",
    "colorize": "pipeline",
    "colorize_time_points": "pipeline",
    "fast_global_smoother": "filters",
    "forget_run": "run.resume",
    "make_plan": "pipeline",
    "plan_time_points": "pipeline",
    "read_color_volume": "io.files",
    "read_time_points": "io.files",
    "read_volume": "io.files",
    "run_batch": "cohort.batch",
    "write_color_volume": "io.files",
    "write_confidence": "io.files",
}

__all__ = [
    "ColorVolume",
    "Guard",
    "Plan",
    "Resume",
    "Settings",
    "Volume",
    "colorize",
    "colorize_time_points",
    "fast_global_smoother",
    "forget_run",
    "make_plan",
    "plan_time_points",
    "read_color_volume",
    "read_time_points",
    "read_volume",
    "run_batch",
    "write_color_volume",
    "write_confidence",
]


def __getattr__(name: str):
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_WHERE[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
