"""Progress, cancellation and seconds per stage of one run."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import contextmanager

from .errors import Cancelled

Progress = Callable[[float, str], None]


class Run:
    """Progress, cancellation and seconds per stage of one run."""

    def __init__(self, progress: Progress | None, cancelled: Callable[[], bool] | None) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.started = time.perf_counter()
        self._progress, self._cancelled, self._lock = progress, cancelled, threading.Lock()

    def step(self, fraction: float, text: str) -> None:
        if self._cancelled is not None and self._cancelled():
            raise Cancelled
        if self._progress is not None:
            self._progress(fraction, text)

    @contextmanager
    def timed(self, stage: str):
        start = time.perf_counter()
        try:
            yield
        finally:
            with self._lock:
                self.seconds[stage] += time.perf_counter() - start

    @contextmanager
    def shared_out(self):
        """Stages timed inside may run on several threads: together they are given the time that passes here."""
        before, self.seconds = self.seconds, defaultdict(float)
        start = time.perf_counter()
        try:
            yield
        finally:
            inside, self.seconds = self.seconds, before
            passed, total = time.perf_counter() - start, sum(inside.values())
            for stage, seconds in inside.items():
                self.seconds[stage] += passed * seconds / max(total, 1e-9)
