"""How long a run will take on this machine, and what error to expect: a short probe on the volume, then arithmetic."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ..parameters import Settings
from ..volume import Volume
from .expected_error import LEAST_TRUSTED, NOT_MEASURED, ExpectedError, expected_error

if TYPE_CHECKING:
    from ..matching.tissue_guard import Guard
    from .prepare import Prepared

PROBES = 3


@dataclass(frozen=True)
class Estimate:
    """Expected run time and colour error.

    Attributes:
        seconds: expected, whole run without reading and writing files.
        low, high: seconds if every slice were as fast as the fastest, or half again as slow as the slowest probe.
        slices: number of slices that will be matched.
        seconds_per_slice: median of the probes.
        error: what the benchmark measured with these settings; None where it did not.
        trusted_fraction: 0..1, share of the probe's matches that can be trusted; None where nothing reads it.
        least_trusted: the smallest such share on the benchmark's pairs; None where it was not measured.
    """

    seconds: float
    low: float
    high: float
    slices: int
    seconds_per_slice: float
    error: ExpectedError | None = None
    trusted_fraction: float | None = None
    least_trusted: float | None = None

    def text(self) -> str:
        """For people."""
        return f"about {_human(self.seconds)} ({_human(self.low)} to {_human(self.high)}) for {self.slices} slices"

    def error_text(self) -> str:
        """The range of the error and, where the probe was matched worse than every pair of the benchmark, that."""
        if self.error is None:
            return NOT_MEASURED
        if self.trusted_fraction is None or self.least_trusted is None:
            return self.error.text()
        share, least = 100 * self.trusted_fraction, 100 * self.least_trusted
        if self.trusted_fraction >= self.least_trusted:
            return f"{self.error.text()}; {share:.0f} % of the probe's matches can be trusted, as on these pairs"
        return (
            f"{self.error.text()}; of the probe's matches only {share:.0f} % can be trusted, on these pairs at least "
            f"{least:.0f} %: expect more than on the hardest of them"
        )


def estimate(
    volume: Volume, references: Sequence, settings: Settings | None = None, guard: Guard | None = None
) -> Estimate:
    """Colour the middle slice, or the middle slices side by side, a few times and extrapolate; takes as long as five slices.

    Raises:
        As `colorize`.
    """
    from ..device import side_by_side
    from ..progress import Run
    from .engine import Engine
    from .paint import Painter
    from .prepare import prepare

    started = time.perf_counter()
    prepared = prepare(volume, references, settings or Settings(), guard=guard)
    slices = prepared.plan.slices
    middle = slices[len(slices) // 2]
    with side_by_side() as each:
        some = replace(prepared, plan=replace(prepared.plan, slices=_around(middle, prepared)), repeats={})
        engine = Engine(some, Run(None, None), each=each)
        overhead = time.perf_counter() - started
        together = [k for k in some.plan.slices if engine.choice[k] == engine.choice[middle]]
        probes = []
        for _ in range(PROBES + 1):  # the first warms up and does not count
            start = time.perf_counter()
            painter = Painter(replace(some, plan=replace(some.plan, slices=tuple(together))), engine, None, each=each)
            painter.add(together, engine.match(together, engine.choice[middle]))
            probes.append((time.perf_counter() - start) / len(together))
    probes = sorted(probes[1:])
    count = len(slices) - len(prepared.repeats)
    median = probes[len(probes) // 2]
    high = overhead + 1.5 * count * probes[-1]
    features = prepared.plan.features
    return Estimate(
        overhead + count * median,
        overhead + count * probes[0],
        high,
        count,
        median,
        expected_error(prepared.settings, features),
        painter.trusted.get(middle),
        LEAST_TRUSTED.get(features),
    )


def _around(middle: int, prepared: Prepared) -> tuple[int, ...]:
    """The slices that are probed: as many as are matched side by side, each on a thread; a large network takes one."""
    import torch

    count = 1
    if prepared.plan.features == "embedded" and prepared.plan.device == "cpu":
        count = min(prepared.settings.batch, torch.get_num_threads())
    first = max(0, prepared.plan.slices.index(middle) - count // 2)
    return prepared.plan.slices[first : first + count]


def _human(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
