"""What this machine can do at most: rates of matrix products and of copying memory, measured in the same run."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .tables import Table, timed

COLUMNS = ("what", "value", "unit")
_SIDE = 1536  # of the square matrices: three of them hold 28 MB
_COPIED = 1 << 26  # numbers of 4 bytes: far larger than any cache


@dataclass(frozen=True)
class Machine:
    """Highest measured rates.

    Attributes:
        operations_per_s: by torch type ("float32", "bfloat16"), a multiplication and an addition count as two.
        bytes_per_s: read plus written.
    """

    operations_per_s: dict[str, float]
    bytes_per_s: float

    def least_seconds(self, operations: float | None, moved: float | None, kind: str) -> float | None:
        """The time below which this work cannot be done: the larger of computing and moving (the roofline model)."""
        times = [] if operations is None else [operations / self.operations_per_s[kind]]
        times += [] if moved is None else [moved / self.bytes_per_s]
        return max(times, default=None)

    def table(self) -> Table:
        """One row per rate."""
        table = Table(COLUMNS)
        for kind, rate in self.operations_per_s.items():
            table.add(what=f"matrix product, {kind}", value=rate / 1e9, unit="GFLOP/s")
        table.add(what="copy of 256 MB, read and written", value=self.bytes_per_s / 1e9, unit="GB/s")
        return table


def measure_machine(quick: bool) -> Machine:
    """Rates of float32, and of bfloat16 where the processor multiplies it."""
    from ..features.vgg19 import fast_dtype

    side, runs = (768, 3) if quick else (_SIDE, 5)
    generator = torch.Generator().manual_seed(0)
    one, other = (torch.rand(side, side, generator=generator) for _ in range(2))
    rates = {}
    for dtype in dict.fromkeys((torch.float32, fast_dtype(torch.device("cpu")))):
        a, b = one.to(dtype), other.to(dtype)
        seconds = timed(lambda a=a, b=b: a @ b, runs, least_s=0.1)[1]
        rates[str(dtype).removeprefix("torch.")] = 2 * side**3 / seconds.low
    source = torch.ones(_COPIED)
    target = torch.empty_like(source)
    seconds = timed(lambda: target.copy_(source), runs)[1]
    return Machine(rates, 2 * 4 * _COPIED / seconds.low)
