"""Who does the work of a batch: this process, processes of this machine, or an existing Dask cluster.

Each way takes `work(task, progress=..., cancelled=...)`, a function of a module, and yields (number of the task, result or the
exception that ended it) in the order in which tasks end. What a lost worker was doing is done again, nothing else is.
When the caller stops asking (Ctrl-C), running tasks are told to stop by `cancelled`.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import queue
import secrets
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from ..errors import DeviceError, MedColorError, MissingPackageError
from .terminal import log_to_stderr

log = logging.getLogger("MedColorLib")

RETRIES = 2  # after a worker was lost
CONNECT_SECONDS = 10
ANSWER_SECONDS = CONNECT_SECONDS / 2  # for the answer to a first question; the other half is for the connection

# Processes are started one by one: two threads that do so at the same time for the first time may meet halves of modules
# in `multiprocessing` (seen in Python 3.9), and a task would end with an ImportError.
_STARTING = threading.Lock()

Ended = Iterator[tuple[int, Any]]


class WorkerLost(MedColorError):
    """A worker ended without an answer, again and again, while it did this task."""


def run_here(work: Callable, tasks: Sequence, progress: Callable[[int, float, str], None]) -> Ended:
    """One task after the other in this process; `progress` is called with (number of the task, fraction of it, text)."""
    for number, task in enumerate(tasks):
        try:
            result = work(task, progress=lambda fraction, text, n=number: progress(n, fraction, text))
        except Exception as error:
            result = error
        yield number, result


def run_processes(work: Callable, tasks: Sequence, workers: int) -> Ended:
    """`workers` processes; a task whose process is killed is tried twice more.

    Each process has a pool of its own: in a common one a lost process takes the tasks of all others with it.
    """
    context = multiprocessing.get_context("spawn")  # forked threads of torch hang
    stop, waiting, ended = context.Event(), queue.SimpleQueue(), queue.SimpleQueue()
    for number in range(len(tasks)):
        waiting.put(number)
    count = min(workers, len(tasks))
    start = (stop, max(1, _cores() // count), log.getEffectiveLevel()) if count else ()

    def serve() -> None:
        with _Process(context, start, stop.is_set) as process:
            while not stop.is_set():
                try:
                    number = waiting.get_nowait()
                except queue.Empty:
                    return
                ended.put((number, process.result(work, tasks[number])))

    servers = [threading.Thread(target=serve) for _ in range(count)]
    for server in servers:
        server.start()
    try:
        for _ in tasks:
            yield ended.get()
    finally:
        stop.set()
        for server in servers:
            server.join()


class _Process:
    """One process that does one task at a time and is started anew when it was lost."""

    def __init__(self, context, start: tuple, stopped: Callable[[], bool]) -> None:
        self._context, self._start, self._stopped = context, start, stopped
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> _Process:
        return self

    def __exit__(self, *_exception) -> None:
        self._close()

    def result(self, work: Callable, task: Any) -> Any:
        """What `work` gave, or the exception it ended with."""
        for _ in range(1 + RETRIES):
            try:
                with _STARTING:
                    self._pool = self._pool or ProcessPoolExecutor(1, self._context, _start_worker, self._start)
                    answer = self._pool.submit(_in_worker, work, task)
                return answer.result()
            except BrokenProcessPool:
                self._close()
                if self._stopped():
                    break
                log.warning("batch: a worker process was killed; its volume is done again")
            except (Exception, KeyboardInterrupt) as error:
                return error
        return WorkerLost(f"its worker process was killed {1 + RETRIES} times (out of memory?); use fewer --workers")

    def _close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None


_stop = None  # in a worker process: the event that tells it to stop


def _start_worker(stop, threads: int, level: int) -> None:
    """Prepare a worker process: its share of the cores, Ctrl-C only while it works, an end when its parent ends."""
    global _stop  # noqa: PLW0603 (an event cannot travel with a task)
    import cv2
    import torch

    _stop = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    log_to_stderr(level)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    multiprocessing.parent_process().join()
    os._exit(1)


def _in_worker(work: Callable, task: Any) -> Any:
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return work(task, cancelled=_stop.is_set)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_on_cluster(work: Callable, tasks: Sequence, address: str) -> Ended:
    """The workers of the Dask scheduler at `address`, one task a volume; Dask does what a lost worker did again.

    Raises:
        MissingPackageError: dask.distributed is not installed.
        DeviceError: no scheduler answers, or it has no workers.
    """
    return _served(_connect(address), work, tasks)


def _served(client, work: Callable, tasks: Sequence) -> Ended:
    from distributed import Event, as_completed

    with client:
        stop = f"medcolor-stop-{secrets.token_hex(8)}"
        numbers = {
            client.submit(_on_cluster, work, task, stop, pure=False, retries=RETRIES): number
            for number, task in enumerate(tasks)
        }
        try:
            for future in as_completed(list(numbers), loop=client.loop):
                try:
                    result = future.result()
                except Exception as error:
                    result = error
                yield numbers[future], result
        except BaseException:
            Event(stop, client).set()
            client.cancel(list(numbers))
            raise


def _connect(address: str):
    """A client of the scheduler, which has a worker."""
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingPackageError(
            "batch: --scheduler needs dask.distributed, which is not installed; run: pip install 'medcolor[cluster]'"
        ) from error
    silent = DeviceError(
        f"scheduler {address}: no Dask scheduler answers there within {CONNECT_SECONDS} s; check the address, or start "
        "one with 'dask scheduler'"
    )
    try:
        if not _is_scheduler(address, ANSWER_SECONDS):
            raise silent
        client = Client(address, timeout=ANSWER_SECONDS, set_as_default=False)
    except (OSError, ValueError, asyncio.TimeoutError) as error:  # ValueError: not an address
        raise silent from error
    try:
        client.wait_for_workers(1, timeout=CONNECT_SECONDS)
    except (TimeoutError, asyncio.TimeoutError) as error:  # the same from Python 3.11 on
        client.close()
        raise DeviceError(f"scheduler {address}: has no workers; start one with 'dask worker {address}'") from error
    return client


def _is_scheduler(address: str, seconds: float) -> bool:
    """Whether what listens there says that it is a scheduler.

    `Client` takes long to give up on an unknown host or kind of address, and never gives up on a peer that is silent or says
    something else. The question is asked in a thread that may be left behind: garbage can keep the reading of it busy.
    """
    from distributed.comm import resolve_address
    from distributed.core import rpc

    said = queue.SimpleQueue()

    async def ask() -> None:
        async with rpc(resolve_address(address), timeout=seconds) as peer:
            said.put(await asyncio.wait_for(peer.identity(), seconds))

    def work() -> None:
        try:
            asyncio.run(ask())
        except Exception as error:  # whatever the garbage makes of the reading
            said.put(error)

    threading.Thread(target=work, daemon=True).start()
    try:
        identity = said.get(timeout=seconds)
    except queue.Empty:
        return False
    if isinstance(identity, Exception):
        log.debug("scheduler %s: %s: %s", address, type(identity).__name__, identity)
    return isinstance(identity, dict) and identity.get("type") == "Scheduler"


def _on_cluster(work: Callable, task: Any, stop: str) -> Any:
    from distributed import Event

    return work(task, cancelled=Event(stop).is_set)
