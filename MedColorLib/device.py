"""Compute devices: names a user may give, checked before any work."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING

from .errors import DeviceError, MemoryTooSmall
from .progress import taken_along

if TYPE_CHECKING:
    import torch
    from threadpoolctl import ThreadpoolController


Each = Callable[..., Iterable]  # like the built-in `map`

# What RuntimeErrors say: torch on a CPU and on Apple's GPU, ITK, and any C++ library.
_NO_MEMORY = (
    "can't allocate memory",
    "not enough memory",
    "out of memory",
    "Failed to allocate memory",
    "bad allocation",
    "bad_alloc",
)
_CV_NO_MEMORY = -4  # cv::Error::StsNoMem


def fast_dtype(device: torch.device) -> torch.dtype:
    """Return bfloat16 where the hardware multiplies it (CUDA from Ampere, AVX-512 BF16, AMX), else float32."""
    import torch

    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.get_device_capability(device) >= (8, 0) else torch.float32
    if device.type == "cpu":
        # torch has no public question for this; where it lacks the private one, float32 is always right.
        for question in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"):
            if getattr(torch.cpu, question, lambda: False)():
                return torch.bfloat16
    return torch.float32


@contextmanager
def one_thread() -> Iterator[None]:
    """torch and OpenCV work with one thread inside: for stages of small arrays, where waking a second one takes longer than it
    saves, and waits for a core on a busy machine.
    """
    import cv2
    import torch

    threads, cv2_threads = torch.get_num_threads(), cv2.getNumThreads()
    _set_threads(1, 1)
    try:
        yield
    finally:
        _set_threads(threads, cv2_threads)


class _OneBlasThread:
    """NumPy's matrix products with one thread inside: threads that call them at once wait for each other, and spin meanwhile.

    Users may overlap (two runs): the last one that leaves gives the threads back.
    """

    def __init__(self) -> None:
        self._lock, self._inside, self._limits = threading.Lock(), 0, None

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._limits = _thread_pools().limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_error) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._limits.restore_original_limits()


_one_blas_thread = _OneBlasThread()


@lru_cache(maxsize=1)
def _thread_pools() -> ThreadpoolController:
    """Of the libraries that are loaded by now, NumPy's BLAS among them; to look for them takes 5 ms."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def side_by_side() -> Iterator[Each]:
    """A `map` for the slices of a batch, each on a thread of its own; torch, too, has one thread for each, NumPy's BLAS in all.

    Their arrays are too small to be worth several threads each. The result does not depend on the number of threads. In a
    stage of a run (`progress.Run.timed`) each slice asks first whether the run was cancelled.
    """
    import torch

    with _one_blas_thread, ThreadPoolExecutor(torch.get_num_threads(), "MedColor slices") as pool:

        def each(function, *arguments):
            with one_thread():
                return list(pool.map(taken_along(function), *arguments))

        yield each


def leave_cores_free(count: int = 1) -> int:
    """torch and OpenCV leave some cores to others from here on, such as one to a window; never all of them.

    Returns:
        How many threads they have now.
    """
    threads = max(1, (os.cpu_count() or 1) - count)
    _set_threads(threads, threads)
    return threads


def _set_threads(of_torch: int, of_opencv: int) -> None:
    import cv2
    import torch

    torch.set_num_threads(of_torch)
    cv2.setNumThreads(of_opencv)


@contextmanager
def memory_errors(device: str) -> Iterator[None]:
    """Turn an out-of-memory error of any library into a MemoryTooSmall that says what to do."""
    try:
        yield
    except MemoryTooSmall:
        raise
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        if device != "cpu" or _is_of_gpu(error):
            _empty_cache()
            remedy = "use --preset draft or --device cpu"
        else:
            remedy = "colour a part of the volume (--slices, --region), or use --preset draft"
        raise MemoryTooSmall(f"device {device}: its memory is too small; close other programs, {remedy}") from error


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error of Python, NumPy, torch, OpenCV, ITK or the system says that there is no more memory."""
    if isinstance(error, (MemoryError, MemoryTooSmall)) or _is_of_gpu(error):
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    if type(error).__module__.partition(".")[0] == "cv2":
        return getattr(error, "code", None) == _CV_NO_MEMORY or "nsufficient memory" in str(error)
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _NO_MEMORY)


def _is_of_gpu(error: BaseException) -> bool:
    return type(error).__name__ == "OutOfMemoryError"  # torch's; asked without importing it


def _empty_cache() -> None:
    import torch

    torch.cuda.empty_cache()


def choose_device(name: str) -> str:
    """Resolve "auto" (CUDA, else Apple's MPS, else the CPU) and check that a named device exists.

    Raises:
        DeviceError: unknown name, or a device this machine or this build of torch does not have.
    """
    import torch

    mps = getattr(torch.backends, "mps", None)
    has_mps = bool(mps and mps.is_available())
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "mps" if has_mps else "cpu"
    if name == "cpu" or (name == "mps" and has_mps):
        return name
    kind, _, index = name.partition(":")
    if (
        kind == "cuda"
        and torch.cuda.is_available()
        and (not index or (index.isdigit() and int(index) < torch.cuda.device_count()))
    ):
        return name
    present = ["cpu"] + [f"cuda:{i}" for i in range(torch.cuda.device_count())] + (["mps"] if has_mps else [])
    raise DeviceError(f"device {name!r} is not here; present: {', '.join(present)}. Use --device auto or one of these")
