"""How long a run will take on this machine: a short probe on the volume itself, then arithmetic."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from .parameters import Settings
from .volume import Volume

PROBES = 3


@dataclass(frozen=True)
class Estimate:
    """Expected run time.

    Attributes:
        seconds: expected, whole run without reading and writing files.
        low, high: seconds if every slice were as fast as the fastest, or half again as slow as the slowest probe.
        slices: number of slices that will be matched.
        seconds_per_slice: median of the probes.
    """

    seconds: float
    low: float
    high: float
    slices: int
    seconds_per_slice: float

    def text(self) -> str:
        """For people."""
        return f"about {_human(self.seconds)} ({_human(self.low)} to {_human(self.high)}) for {self.slices} slices"


def estimate(volume: Volume, references: Sequence, settings: Settings | None = None) -> Estimate:
    """Colour the middle slice a few times and extrapolate; takes about as long as five slices.

    Raises:
        As `colorize`.
    """
    from .engine import Engine
    from .paint import Painter
    from .prepare import prepare
    from .progress import Run

    started = time.perf_counter()
    prepared = prepare(volume, references, settings or Settings())
    slices = prepared.plan.slices
    middle = slices[len(slices) // 2]
    single = replace(prepared, plan=replace(prepared.plan, slices=(middle,)), repeats={})
    engine = Engine(single, Run(None, None))
    overhead = time.perf_counter() - started
    probes = []
    for _ in range(PROBES + 1):  # the first warms up and does not count
        start = time.perf_counter()
        Painter(single, engine, None).add([middle], engine.match([middle], engine.choice[middle]))
        probes.append(time.perf_counter() - start)
    probes = sorted(probes[1:])
    count = len(slices) - len(prepared.repeats)
    median = probes[len(probes) // 2]
    return Estimate(
        overhead + count * median, overhead + count * probes[0], overhead + 1.5 * count * probes[-1], count, median
    )


def _human(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
