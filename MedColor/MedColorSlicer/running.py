"""A computation in a worker thread, while the window stays responsive and one button can cancel it."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import threading
import time

import slicer

_POLL_SECONDS = 0.03


class Job:
    """State of one run, shared by the worker (which reports) and the panel (which shows and cancels)."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._cancel = threading.Event()
        self._fraction, self._text = 0.0, ""
        self.reason = ""  # why it was cancelled, if not by the user
        self._start = time.monotonic()

    def progress(self, fraction: float, text: str = "") -> None:
        """To be called by the library from the worker."""
        with self._lock:
            self._fraction, self._text = min(max(float(fraction), 0.0), 1.0), str(text)

    def cancelled(self) -> bool:
        """To be asked by the library from the worker."""
        return self._cancel.is_set()

    def cancel(self, reason: str = "") -> None:
        """The user's decision, or what the scene leaves no other choice but; the worker stops at its next question."""
        self.reason = self.reason or reason
        self._cancel.set()

    def state(self) -> tuple[float, str, float | None]:
        """(fraction 0..1, what is being done, seconds left or None while that is a guess)."""
        with self._lock:
            fraction, text = self._fraction, self._text
        elapsed = time.monotonic() - self._start
        left = elapsed * (1.0 - fraction) / fraction if fraction >= 0.03 and elapsed > 1.0 else None
        return fraction, text, left

    def elapsed_seconds(self) -> float:
        """Seconds since the run began."""
        return time.monotonic() - self._start


def run_responsive(function, keep_alive, poll_seconds: float = _POLL_SECONDS):
    """Call `function()` in a worker thread; call `keep_alive()` here many times a second until it is done.

    The worker must touch neither widgets nor the scene. What it logs is handed over and logged here, because Slicer's
    log belongs to the main thread.

    Returns:
        What `function` returns.

    Raises:
        What `function` raises.
    """
    outcome: dict = {}
    records: queue.SimpleQueue = queue.SimpleQueue()

    def work() -> None:
        try:
            with a_core_for_the_window():
                outcome["result"] = function()
        except BaseException as error:  # handed over and raised in the calling thread
            outcome["error"] = error

    worker = threading.Thread(target=work, name="MedColor", daemon=True)
    with _redirected_log(worker, records):
        worker.start()
        while worker.is_alive():
            keep_alive()
            _log_here(records)
            worker.join(poll_seconds)  # releases the interpreter lock: the worker gets on
    _log_here(records)
    if "error" in outcome:
        raise outcome["error"]
    return outcome["result"]


class _Workers:
    """How many workers compute, and the threads of torch and OpenCV before the first of them came."""

    def __init__(self) -> None:
        self.lock, self.inside, self.threads = threading.Lock(), 0, (1, 1)


_workers = _Workers()


@contextlib.contextmanager
def a_core_for_the_window():
    """For a worker: torch and OpenCV leave one processor core to Slicer's window; afterwards they have their threads back.

    Workers may overlap (a live preview that is ending, a run): the last one that leaves gives the threads back.
    MedColorLib is imported before torch, which reads on import how its threads are to wait for each other. The first import of
    torch takes seconds and cannot be cancelled; the plan's worker makes it while the user still chooses, so that a run finds it
    done, unless Apply comes within those seconds.
    """
    import MedColorLib  # noqa: F401

    try:
        import cv2
        import torch
    except ModuleNotFoundError:  # nothing computes here; what needs them says so
        yield
        return
    from MedColorLib.device import leave_cores_free

    with _workers.lock:
        if not _workers.inside:
            _workers.threads = torch.get_num_threads(), cv2.getNumThreads()
            if max(_workers.threads) >= (os.cpu_count() or 1):  # fewer: set by the user, or cores are counted twice
                leave_cores_free(1)
        _workers.inside += 1
    try:
        yield
    finally:
        with _workers.lock:
            _workers.inside -= 1
            if not _workers.inside:
                torch.set_num_threads(_workers.threads[0])
                cv2.setNumThreads(_workers.threads[1])


class _redirected_log:  # used like a function
    """Takes the worker's records out of the "MedColorLib" log and puts them into a queue."""

    def __init__(self, worker, records) -> None:
        self._worker, self._records = worker, records
        self._logger = logging.getLogger("MedColorLib")

    def __enter__(self) -> None:
        self._logger.addFilter(self._catch)

    def __exit__(self, *_exception) -> None:
        self._logger.removeFilter(self._catch)

    def _catch(self, record) -> bool:
        if record.thread != self._worker.ident:
            return True
        self._records.put(record)
        return False


def _log_here(records) -> None:
    while True:
        try:
            record = records.get_nowait()
        except queue.Empty:
            return
        logging.getLogger("MedColorLib").callHandlers(record)


def readable_seconds(seconds: float) -> str:
    """A duration as people say it: 40 s, 3 min, 1 h 20 min."""
    seconds = max(round(seconds), 1)
    if seconds < 90:
        return f"{seconds} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


_shown_status = [""]


def status(text: str) -> None:
    """Show a text in the status bar of Slicer's window, wherever the user is; the same text only once."""
    if text != _shown_status[0]:
        _shown_status[0] = text
        if slicer.util.mainWindow() is not None:
            slicer.util.showStatusMessage(text)
