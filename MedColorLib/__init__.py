"""MedColor: grey medical volumes in the colours of real anatomy. Headless library; the Slicer module is in `MedColor/`.

The data's way, one file a stage, one folder a choice of alternatives:

| stage | file | takes -> gives |
| --- | --- | --- |
| volume in | `volume_io`, `volume` | file -> `Volume` (k, j, i) with its place in space |
| slices | `slices`, `planes`, `body`, `intensity`, `reference`, `grid` | volume -> slices, body, display grey on one raster |
| references | `references`, `color_sections`, `library`, `visible_human` | picture, folder, colour volume -> `Reference`s |
| tissue guard | `guard`, `label_picture` | label volume, label pictures -> groups that matching and colour do not cross |
| choice of references | `recommend`, `assignment` | likeness of descriptors -> a reference for each slice |
| plan | `prepare`, `plan` | what will be done, what is left out and why |
| orientation | `orientation`, `coarse` | which way up a photograph lies |
| contrast | `contrast`, `coarse` | scan's grey -> the photograph's contrast, for matching only |
| features | `features/` | grey slice -> five maps |
| correspondence | `correspondence/`, `analogy`, `reconstruction`, `vote` | maps -> field -> matched colours T' |
| confidence | `confidence` | there and back, and likeness -> how far a match counts |
| colour | `color/`, `filters/`, `transfer` | T' and the scan's luminance -> sRGB slice |
| coherence | `coherence`, `blending`, `paint` | evidence of neighbouring slices and references -> one colour |
| volume out | `volume_io`, `report` | `ColorVolume` -> NRRD or NIfTI, JSON report |
| rendering | `rendering/` | `ColorVolume` -> pictures |
| interruption | `resume` | matches of an unfinished run, kept on disk |
| cohorts | `batch`, `batch_workers` | folder of volumes -> folder of results; processes, Dask |

`pipeline.colorize` is the map: one call per stage. Nothing heavy is imported until it is used.

>>> from MedColorLib import Settings
>>> Settings(preset="draft").resolved_smoother
'regression'
"""

from __future__ import annotations

from importlib import import_module

__version__ = "0.1.0"

_WHERE = {
    "ColorVolume": "volume",
    "Guard": "guard",
    "Plan": "plan",
    "Resume": "resume",
    "Settings": "parameters",
    "Volume": "volume",
    "colorize": "pipeline",
    "fast_global_smoother": "filters",
    "forget_run": "resume",
    "make_plan": "pipeline",
    "read_color_volume": "volume_io",
    "read_volume": "volume_io",
    "run_batch": "batch",
    "write_color_volume": "volume_io",
    "write_confidence": "volume_io",
}

__all__ = list(_WHERE)


def __getattr__(name: str):
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_WHERE[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
