"""Suite *scaling*: how time grows with slice area, slices, references and layers; how memory grows with slices."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from ..color.lab import lightness_to_gray
from ..errors import MedColorError
from ..features.self_similarity import SelfSimilarity
from ..matching.analogy import deep_image_analogy
from ..parameters import Settings
from ..phantom import section as phantom_section
from ..progress import Progress
from ..volume import Volume
from .pairs import Section, make_pair
from .peak_memory import peak_of, tall_phantom
from .suite_profile import slice_volume
from .tables import TIME_COLUMNS, Seconds, Suite, Table, seconds_of, timed

COLUMNS = ("what", "x", "unit", *TIME_COLUMNS)
EXPONENT_COLUMNS = ("what", "unit", "x_from", "x_to", "points", "exponent", "standard_error")
MEMORY_COLUMNS = ("slices", "side_px", "peak_mb", "input_mb", "output_mb", "beyond_mb", "growth_mb")

MEMORY_SIDE_PX = 64
_DRAFT = Settings(preset="draft", features="embedded")
_EXHAUSTIVE, _WINDOWED = "layers: down to 5, 4, 3 (exhaustive)", "layers: down to 2, 1 (windows)"

NOTES = [
    "Preset draft, MedColor's own features, but for the analogy by layers: self-similarity on 256 x 256, its last layer moved; x "
    "is then the number of positions of the last layer, and the time holds the layers above, too.",
    "exponent p of seconds = c x^p: least squares of log seconds (medians) over log x, and its standard error. Fixed costs "
    "lower it. Matching takes place on a raster of fixed size: by area only the stage colour grows.",
    "Memory: a process of its own colours a volume of 64 x 64 pixels a slice, 2 mm apart; beyond_mb is its largest resident "
    "memory less input and output, with interpreter and libraries; growth_mb: against the volume with the fewest slices.",
]


def run(section: Section, quick: bool, seed: int, progress: Progress) -> Suite:
    """Measure times, fit exponents, then memory (not in a quick run)."""
    times = Table(COLUMNS)
    suite = Suite({"scaling": times, "exponents": Table(EXPONENT_COLUMNS)}, notes=list(NOTES))
    parts = (_by_area, _by_slices, _by_references, _by_layers)
    for number, part in enumerate(parts):
        progress(0.15 * number, f"scaling, {part.__name__.removeprefix('_by_')}")
        for what, unit, x, seconds in part(section, quick, seed):
            times.add(what=what, x=x, unit=unit, **seconds.columns())
    suite.tables["exponents"] = exponents(times)
    if quick:
        suite.failures.append(("memory by slices", "left out of a quick run"))
        return suite
    suite.tables["memory"] = memory = Table(MEMORY_COLUMNS)
    counts = (50, 200, 800)
    for number, count in enumerate(counts):
        progress(0.6 + 0.4 * number / len(counts), f"scaling, memory of {count} slices")
        add_memory(suite, memory, count)
    if not memory.rows:
        del suite.tables["memory"]
    return suite


def add_memory(suite: Suite, memory: Table, slices: int) -> None:
    """Measure a volume in a process of its own and add the row."""
    try:
        found = peak_of(slices, MEMORY_SIDE_PX)
    except MedColorError as error:
        suite.failures.append((f"memory of {slices} slices", str(error)))
        return
    first = memory.where()[0]["beyond_mb"] if memory.rows else found["beyond_mb"]
    memory.add(slices=slices, side_px=MEMORY_SIDE_PX, growth_mb=found["beyond_mb"] - first, **found)


def fit_exponent(x: np.ndarray, seconds: np.ndarray) -> tuple[float, float | None]:
    """p of seconds = c x^p and its standard error (None for two points), by least squares of the logarithms."""
    a, b = np.log(np.asarray(x, np.float64)), np.log(np.asarray(seconds, np.float64))
    spread = ((a - a.mean()) ** 2).sum()
    slope = float(((a - a.mean()) * (b - b.mean())).sum() / spread)
    if len(a) < 3:
        return slope, None
    rest = b - b.mean() - slope * (a - a.mean())
    return slope, float(np.sqrt((rest**2).sum() / (len(a) - 2) / spread))


def exponents(times: Table) -> Table:
    """A fit for every `what` of the table."""
    table = Table(EXPONENT_COLUMNS)
    for what in dict.fromkeys(row["what"] for row in times.where()):
        rows = times.where(what=what)
        x, seconds = ([row[name] for row in rows] for name in ("x", "seconds"))
        slope, error = fit_exponent(np.array(x), np.array(seconds))
        ends = {"x_from": min(x), "x_to": max(x), "points": len(x)}
        table.add(what=what, unit=rows[0]["unit"], **ends, exponent=slope, standard_error=error)
    return table


Measured = Iterator[tuple[str, str, float, Seconds]]  # what, unit, x, time


def _by_area(section: Section, quick: bool, seed: int) -> Measured:
    settings = Settings(preset="draft", features="embedded", window=(0.0, 1.0))
    for side in (128, 256, 512) if quick else (128, 256, 512, 1024):
        volume = slice_volume(section, side, seed)
        whole, stages = _colorized(volume, [section.rgb], settings, 2 if quick else 5)
        yield "area: volume of one slice", "pixels", side**2, whole
        yield "area: stage colour alone", "pixels", side**2, stages["colour"]


def _by_slices(section: Section, quick: bool, seed: int) -> Measured:
    for count in (2, 4, 8) if quick else (8, 16, 32, 64):
        whole, stages = _colorized(tall_phantom(count, 96), _pictures(1), _DRAFT, 1 if quick else 3)
        yield "slices: whole volume", "slices", count, whole
        yield "slices: without what is done once", "slices", count, stages["each slice"]


def _by_references(section: Section, quick: bool, seed: int) -> Measured:
    for count in (1, 2, 4) if quick else (1, 2, 4, 8, 16):
        volume = tall_phantom(2 if quick else 16, 96)
        whole, _ = _colorized(volume, _pictures(count), _DRAFT, 1 if quick else 3)
        yield "references: whole volume", "references", count, whole


def _pictures(count: int) -> list[np.ndarray]:
    """Sections of the phantom at different levels."""
    levels = np.linspace(-0.6, 0.2, count) if count > 1 else (-0.45,)
    return [phantom_section(float(level)) for level in levels]


def _colorized(volume: Volume, pictures: list, settings: Settings, runs: int) -> tuple[Seconds, dict[str, Seconds]]:
    """Time of the call, and by the report of the same runs that of "colour" and of "each slice"."""
    from ..pipeline import colorize

    reports: list[dict] = []
    whole = timed(lambda: reports.append(colorize(volume, pictures, settings).report["seconds"]), runs)[1]
    own = ("features", "matching", "colour")
    measured = {"colour": [r["colour"] for r in reports[1:]]}
    measured["each slice"] = [sum(r[stage] for stage in own) for r in reports[1:]]
    return whole, {name: seconds_of(values) for name, values in measured.items()}


def _by_layers(section: Section, quick: bool, seed: int) -> Measured:
    pair = make_pair(section, "as it is", seed)
    kinds = ((_EXHAUSTIVE, (5, 4, 3)),) if quick else ((_EXHAUSTIVE, (5, 4, 3)), (_WINDOWED, (2, 1)))
    reference = lightness_to_gray(section.lab[..., 0]) * section.mask
    planes = [torch.from_numpy(grey.astype(np.float32))[None, None] for grey in (pair.grey * pair.mask, reference)]
    masks = torch.from_numpy(pair.mask)[None], torch.from_numpy(section.mask)
    sides = [SelfSimilarity().extract(plane, (5, 4, 3, 2, 1)) for plane in planes]
    for what, layers in kinds:
        for layer in layers:
            positions = reference.size / 4 ** (layer - 1)
            taken = timed(lambda last=layer: deep_image_analogy(*sides, *masks, last), 2 if quick else 5)[1]
            yield what, "positions", positions, taken
