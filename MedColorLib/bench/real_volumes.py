"""Speed on real volumes: seconds a slice of the public call, by stage, with how far its matches can be trusted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..parameters import Settings
from ..pipeline import colorize
from .slabs import Slab, load_slabs
from .suite_pipeline import has_network
from .tables import TIME_COLUMNS, Suite, Table, seconds_of

STAGES = ("features", "matching", "colour")
COLUMNS = (
    "volume", "features", "method", "slices", "rows", "cols", "trusted", *TIME_COLUMNS,
    *(f"seconds_{stage}" for stage in STAGES), "matching_over_features", "colour_share",
)  # fmt: skip
RUNS = 3

NOTES = [
    "volumes: slabs of real volumes by colorize(), reference given; seconds a slice: features, matching and colour, without "
    "what is done once a volume; median and quartiles of three runs after a warm-up. trusted: mean share of matches that lead "
    "back home and look alike.",
    "What is not reached, and what would reach it. Colour takes more than a tenth beside VGG-19: what is left are some forty "
    "array operations of a quarter to three milliseconds each; a compiled kernel that makes one pass of them would, or more "
    "than two cores (slices of a batch are coloured side by side). As a share of balanced with VGG-19, draft and the embedded "
    "features miss a third and a quarter because that has itself become three times as fast: a draft's colour and an embedded "
    "slice's matching do not shrink with the network.",
]


def run(suite: Suite, data: Path | None, progress: Callable[[float], None]) -> None:
    """Add the table `volumes` to the suite where the volumes are."""
    slabs = [slab for slab in load_slabs(data, False) if slab.name != "phantom"]
    if not slabs:
        suite.failures.append(
            ("speed on real volumes", "the CT, the MR or the photograph of the head is not here (--data)")
        )
        return
    suite.notes.extend(NOTES)
    table = suite.tables["volumes"] = Table(COLUMNS)
    names = ("vgg19", "embedded") if has_network() else ("embedded",)
    jobs = [(slab, name, preset) for slab in slabs for name in names for preset in ("draft", "balanced")]
    for number, job in enumerate(jobs):
        progress(number / len(jobs))
        measure(table, *job)


def measure(table: Table, slab: Slab, features: str, preset: str) -> None:
    """Colour a slab a few times and add the row."""
    settings = Settings(preset=preset, features=features)
    reports = [colorize(slab.volume, [slab.reference], settings).report for _ in range(RUNS + 1)][1:]
    slices = len(reports[0]["plan"]["slices"])
    seconds = {stage: np.array([report["seconds"][stage] for report in reports]) / slices for stage in STAGES}
    medians = {stage: float(np.median(values)) for stage, values in seconds.items()}
    table.add(
        volume=slab.name,
        features=features,
        method=preset,
        slices=slices,
        rows=slab.volume.array.shape[1],
        cols=slab.volume.array.shape[2],
        trusted=float(np.mean(list(reports[0]["trusted_fraction"].values()))),
        **seconds_of(list(sum(seconds.values()))).columns(),
        **{f"seconds_{stage}": value for stage, value in medians.items()},
        matching_over_features=medians["matching"] / medians["features"],
        colour_share=medians["colour"] / sum(medians.values()),
    )
