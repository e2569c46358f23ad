"""Ctrl-C, or another signal, in the middle of matching."""

from __future__ import annotations

import signal
import threading
from typing import Callable


def sends_once(number: int) -> Callable[..., None]:
    """In place of a step that runs side by side for several slices: the first sends the signal, all wait until it is sent.

    A second one would meet whoever runs the command, the test itself.
    """
    first, sent = threading.Lock(), threading.Event()

    def step(*_, **__) -> None:
        if first.acquire(blocking=False):
            signal.raise_signal(number)
            sent.set()
        sent.wait()

    return step
