"""Files of network weights as they exist in the world: their tensors' names and shapes, read without trusting the file.

A file is known by its content, never by its name. Before any memory is taken, the header must fit the file, the tensors
the header, and the whole a limit far above any VGG-19; nothing that a file holds is ever executed.
"""

from __future__ import annotations

import contextlib
import json
import math
import pickle
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Callable

import numpy as np

from ..errors import WeightsError
from .caffemodel import read_caffemodel

if TYPE_CHECKING:
    import torch

REMEDY = "run `medcolor weights fetch`, or point MEDCOLOR_WEIGHTS to another file"
MAX_FILE_BYTES = 1_500_000_000  # VGG-19 with all its dense layers in float32 has 575 million
_MAX_HEADER_BYTES = 1 << 20  # 160 tensors need about 16 thousand
_MAX_PICKLE_BYTES = 1 << 22
_LEGACY_TORCH = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."  # what torch.save wrote before its zip format of 2020
_ITEM_BYTES = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1}
# What the readers below raise on damaged bytes; anything else is a fault of the program and must show.
_DAMAGE = (
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    EOFError,
    RuntimeError,
    OverflowError,
    AssertionError,
    MemoryError,
    pickle.UnpicklingError,
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    struct.error,
)


@dataclass(frozen=True)
class Checkpoint:
    """An opened file of weights.

    Attributes:
        path: the file.
        container: "safetensors", "PyTorch", "NumPy" or "Caffe".
        shapes: shape by tensor name, known without reading any tensor.
        read: name, and optionally a slice of the first axis, to a tensor of the stored type.
        metadata: what a safetensors header says beside its tensors.
    """

    path: Path
    container: str
    shapes: Mapping[str, tuple[int, ...]]
    read: Callable[..., torch.Tensor] = field(repr=False)
    metadata: Mapping[str, str] = field(default_factory=dict)


def open_checkpoint(path: Path) -> Checkpoint:
    """Open a `.safetensors`, `.pth`, `.npz` or `.caffemodel` file, whichever it is by its first bytes.

    Raises:
        WeightsError: missing, unreadable, too large, truncated, damaged, executable, or of no known format.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(32)
    except OSError as error:
        raise WeightsError(
            f"weights {path}: cannot be read ({error.strerror}); point MEDCOLOR_WEIGHTS to a readable file"
        ) from error
    if not 32 <= size <= MAX_FILE_BYTES:
        raise WeightsError(f"{path.name}: {size} bytes cannot be a VGG-19 (limit {MAX_FILE_BYTES}); {REMEDY}")
    with _reading(path):
        return _reader(path, head)(path)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGE as error:
        detail = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise WeightsError(f"{path.name}: truncated or damaged ({detail}); {REMEDY}") from error


def is_safetensors(path: Path) -> bool:
    """Tell by the first bytes whether a file can be used where it lies, without conversion."""
    with Path(path).open("rb") as file:
        return file.read(9)[8:] == b"{"


def _reader(path: Path, head: bytes) -> Callable[[Path], Checkpoint]:
    if head.startswith(b"PK\x03\x04"):
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
        return _open_numpy if all(name.endswith(".npy") for name in names) else _open_torch
    if head.startswith(_LEGACY_TORCH):
        return _open_torch_legacy
    if head[8:9] == b"{":
        return _open_safetensors
    if head[:1] in (b"\x0a", b"\x12") or head[:2] == b"\xa2\x06":  # NetParameter.name, .layers or .layer comes first
        return _open_caffe
    raise WeightsError(
        f"{path.name}: not a file of weights; expected safetensors, PyTorch, NumPy .npz or .caffemodel, found bytes "
        f"{head[:16]!r}; {REMEDY}"
    )


def _open_safetensors(path: Path) -> Checkpoint:
    from safetensors import SafetensorError, safe_open

    size = path.stat().st_size
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if length > min(_MAX_HEADER_BYTES, size - 8):
            raise ValueError(f"a header of {length} bytes in a file of {size}")
        header = json.loads(file.read(length).decode("utf-8"))
    metadata = header.pop("__metadata__", {})
    shapes, end = {}, 0
    for name, entry in header.items():
        shapes[name] = tuple(int(extent) for extent in entry["shape"])
        begin, stop = entry["data_offsets"]
        if stop - begin != math.prod(shapes[name]) * _ITEM_BYTES[entry["dtype"]]:
            raise ValueError(f"{name}: {stop - begin} bytes for {entry['dtype']} {shapes[name]}")
        end = max(end, stop)
    if end != size - 8 - length:
        raise ValueError(f"the header announces {8 + length + end} bytes, the file has {size}")

    def read(name: str, rows: slice | None = None) -> torch.Tensor:
        try:
            with safe_open(str(path), framework="pt") as file:
                return file.get_tensor(name) if rows is None else file.get_slice(name)[rows]
        except (SafetensorError, OSError) as error:
            raise WeightsError(f"{path.name}: {name} cannot be read ({error}); {REMEDY}") from error

    return Checkpoint(path, "safetensors", shapes, read, metadata)


def _open_torch(path: Path) -> Checkpoint:
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
    # torch.save never compresses: what is compressed is not its work, and could unpack to anything.
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise ValueError("compressed entries, which torch.save never writes")
    pickles = [entry.file_size for entry in entries if entry.filename.endswith("data.pkl")]
    if (
        len(pickles) != 1
        or pickles[0] > _MAX_PICKLE_BYTES
        or sum(entry.file_size for entry in entries) > MAX_FILE_BYTES
    ):
        raise ValueError("not the layout that torch.save writes")
    return _from_state(path, mmap=True)


def _open_torch_legacy(path: Path) -> Checkpoint:
    return _from_state(path, mmap=False)


def _from_state(path: Path, mmap: bool) -> Checkpoint:
    import torch

    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except pickle.UnpicklingError as error:
        raise WeightsError(
            f"{path.name}: refused, because it is damaged or holds more than tensors (a pickle can run any program); "
            f"expected a state_dict of tensors; {REMEDY}"
        ) from error
    if not isinstance(state, dict) or not all(isinstance(name, str) for name in state):
        raise ValueError(f"a {type(state).__name__}, not a state_dict of tensors by name")
    tensors = {name: value for name, value in state.items() if isinstance(value, torch.Tensor)}

    def read(name: str, rows: slice | None = None) -> torch.Tensor:
        return tensors[name] if rows is None else tensors[name][rows]

    return Checkpoint(path, "PyTorch", {name: tuple(value.shape) for name, value in tensors.items()}, read)


def _open_numpy(path: Path) -> Checkpoint:
    shapes = {}
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > MAX_FILE_BYTES:
            raise ValueError(f"unpacks to more than {MAX_FILE_BYTES} bytes")
        for entry in archive.infolist():
            with archive.open(entry) as file:
                shape, dtype = _npy_header(file)
            if dtype.hasobject or math.prod(shape) * dtype.itemsize > entry.file_size:
                raise ValueError(f"{entry.filename}: {entry.file_size} bytes for {dtype} {shape}")
            shapes[entry.filename[: -len(".npy")]] = tuple(shape)

    def read(name: str, rows: slice | None = None) -> torch.Tensor:
        import torch

        with _reading(path), np.load(path, allow_pickle=False) as archive:
            array = np.ascontiguousarray(archive[name] if rows is None else archive[name][rows])
        return torch.from_numpy(array)

    return Checkpoint(path, "NumPy", shapes, read)


def _npy_header(file) -> tuple[tuple[int, ...], np.dtype]:
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise ValueError(f"npy version {version}")
    return shape, dtype


def _open_caffe(path: Path) -> Checkpoint:
    arrays = read_caffemodel(path)

    def read(name: str, rows: slice | None = None) -> torch.Tensor:
        import torch

        # Copied: the file's floats may lie at any byte, and stay readable only while it is mapped.
        return torch.from_numpy(np.array(arrays[name] if rows is None else arrays[name][rows], dtype=np.float32))

    return Checkpoint(path, "Caffe", {name: array.shape for name, array in arrays.items()}, read)
