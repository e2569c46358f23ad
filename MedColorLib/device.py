"""Compute devices: names a user may give, checked before any work."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from .errors import DeviceError

if TYPE_CHECKING:
    import torch


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
    """Torch works with one thread inside: for stages of small arrays, where waking a second one takes longer than it saves."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def memory_errors(device: str) -> Iterator[None]:
    """Turn torch's out-of-memory error into a DeviceError that says what to do."""
    import torch

    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        torch.cuda.empty_cache()
        raise DeviceError(
            f"device {device}: its memory is too small; close other programs, use --preset draft or --device cpu"
        ) from error


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
