"""Seconds by stage without a trace in the program: functions are replaced by timed ones while a measurement lasts."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Adds up the time of stages; a stage inside another one does not count to the outer one.

    Attributes:
        seconds: stage -> its own seconds.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inner: list[float] = []  # of each open stage, the seconds spent in stages inside it

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what happens inside to `name`."""
        self._inner.append(0.0)
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.seconds[name] += elapsed - self._inner.pop()
            if self._inner:
                self._inner[-1] += elapsed

    @contextmanager
    def watching(self, *places: tuple[object, str, str]) -> Iterator[Stopwatch]:
        """Time functions while the block lasts.

        Args:
            places: (module or object, name of the function there, stage).
        """
        before = [(owner, name, getattr(owner, name)) for owner, name, _ in places]
        try:
            for owner, name, stage in places:
                setattr(owner, name, self._timed(getattr(owner, name), stage))
            yield self
        finally:
            for owner, name, function in reversed(before):
                setattr(owner, name, function)

    def _timed(self, function, stage: str):
        def timed(*arguments, **options):
            with self.stage(stage):
                return function(*arguments, **options)

        return timed
