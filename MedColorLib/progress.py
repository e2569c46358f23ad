"""Progress, cancellation and seconds per stage of one run."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import contextmanager

from .errors import Cancelled

Progress = Callable[[float, str], None]


_here = threading.local()  # .run: the run that this thread works for


def check() -> None:
    """For loops that take long: raises Cancelled where the run that this thread works for was cancelled."""
    run = getattr(_here, "run", None)
    if run is not None:
        run.check()


def taken_along(function: Callable) -> Callable:
    """The function, to be called on other threads: it asks `check` first, and what it calls may ask, as if on this one."""
    run = getattr(_here, "run", None)
    if run is None:
        return function

    def work(*arguments):
        before, _here.run = getattr(_here, "run", None), run
        try:
            run.check()
            return function(*arguments)
        finally:
            _here.run = before

    return work


class Run:
    """Progress, cancellation and seconds per stage of one run."""

    def __init__(self, progress: Progress | None, cancelled: Callable[[], bool] | None) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.started = time.perf_counter()
        self._progress, self._cancelled, self._lock = progress, cancelled, threading.Lock()

    def step(self, fraction: float, text: str) -> None:
        self.check()
        if self._progress is not None:
            self._progress(fraction, text)

    def check(self) -> None:
        """Raises Cancelled where it was."""
        if self._cancelled is not None and self._cancelled():
            raise Cancelled

    @contextmanager
    def timed(self, stage: str):
        """A stage of the run; what this thread does inside it may ask `check`."""
        before, _here.run = getattr(_here, "run", None), self
        start = time.perf_counter()
        try:
            yield
        finally:
            _here.run = before
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
