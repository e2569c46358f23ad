"""What the readers behind `io.files.read_volume` share: reasons, limits, detached files, bounded reading of voxels.

A reader takes (path, max_bytes) and gives a `Volume`. It raises `InputError` with the reason alone; `io.files` names
the file. Sizes are checked against the limit and the file before memory is taken, and check sums are verified.
"""

from __future__ import annotations

import bz2
import io
import math
import os
import re
import shutil
import tempfile
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError

LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
MAX_DEFLATE_RATIO = 1032  # no gzip or zlib stream unpacks to more than this many times its size
MAX_HEADER = 1 << 20
GZIP = b"\x1f\x8b"  # how such a stream begins

IS_COLOR = "a colour or vector image, which can only be a reference; the volume to colour has to be scalar"
IS_FLAT = "a two-dimensional image; put all slices as PNG or TIFF files in one folder and give the folder"
IS_FOUR_D = "more than three dimensions (a time series?); choose one with --volume N, or save it in a file of its own"
IS_TRUNCATED = "the file ends before its last voxel; copy or export it again"
_IS_SCATTERED = "the voxels are spread over several data files; save the volume as one file"
_CHUNK = 1 << 24


def check_size(shape: Sequence[int], dtype: np.dtype, max_bytes: int) -> int:
    """Bytes of an array of that shape and type, checked before any memory is taken.

    Raises:
        InputError: an axis is empty, or more than `max_bytes`.
    """
    sizes = " x ".join(str(size) for size in shape)
    if min(shape) < 1:
        raise InputError(f"the volume has no voxels ({sizes})")
    size = math.prod(int(n) for n in shape) * np.dtype(dtype).itemsize
    if size > max_bytes:
        taken = f"{size / 2**30:.3g}" if size < 1 << 100 else "countless"
        raise InputError(
            f"{sizes} voxels of {dtype} take {taken} GiB, more than the limit of {max_bytes / 2**30:.3g}; "
            "crop or resample the volume first"
        )
    return size


def repaired(ijk_to_ras: np.ndarray, shape: Sequence[int], notes: list[str]) -> np.ndarray:
    """(4, 4) with a direction for axes (k, j, i) of length one that have none: their normal, 1 mm; noted."""
    matrix = ijk_to_ras.copy()
    for axis in range(3):
        if shape[2 - axis] == 1 and not matrix[:3, axis].any():
            normal = np.cross(matrix[:3, (axis + 1) % 3], matrix[:3, (axis + 2) % 3])
            length = float(np.linalg.norm(normal))
            matrix[:3, axis] = normal / length if length else np.eye(3)[axis]
            notes.append(f"axis {'ijk'[axis]} has one voxel and no size: 1 mm is assumed")
    return matrix


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts slice 2 before slice 10."""
    parts = re.split(r"(\d+)", path.as_posix().lower())
    return [*((int(part), "") if part.isdecimal() else (-1, part) for part in parts), (-1, path.as_posix())]


def title(path: Path) -> str:
    """The name without folder and ending; `.nii.gz` is one ending."""
    return re.sub(r"(\.(nii|hdr|img)\.gz|\.[^.]*)$", "", path.name, flags=re.IGNORECASE) or path.name


def data_file(header: Path, name: str) -> Path:
    """The detached data file `name` of a header file.

    Raises:
        InputError: it is missing, several, or outside the header's folder tree: a header from elsewhere must not make
            this program read any file of the machine.
    """
    if name.upper().startswith("LIST") or "%" in name:
        raise InputError(_IS_SCATTERED)
    if "\0" in name:
        raise InputError("the name of its data file is damaged; copy or export it again")
    folder = Path(os.path.realpath(header.parent))
    target = Path(os.path.realpath(folder / name))
    if not target.is_relative_to(folder):
        raise InputError(f"its data file {name!r} lies outside the header's folder; put both in one folder")
    if not target.is_file():
        raise InputError(f"its data file {name!r} is missing; put it beside the header")
    return target


def read_voxels(
    source: Path, start: int, shape: Sequence[int], dtype: np.dtype, encoding: str, *, lines: int = 0, skip: int = 0
) -> np.ndarray:
    """The voxels of a NRRD or MetaImage, slowest axis first.

    Packed and text voxels are read, in the machine's byte order. Raw ones are mapped: a read-only array in the file's
    byte order whose pages the system reads when they are used and drops when memory is short. The file must stay as it
    is while the array is in use.

    Args:
        source: the file that holds them, from byte `start` on.
        dtype: type and byte order in the file.
        encoding: raw, gzip, zlib, bzip2, hex or text.
        lines: lines to skip first.
        skip: bytes to skip then, after unpacking; -1 for raw: the voxels end the file.

    Raises:
        InputError: truncated, damaged, or an unknown encoding.
    """
    with source.open("rb") as file:
        file.seek(start)
        for _ in range(lines):
            if not file.readline():
                raise InputError(IS_TRUNCATED)
        try:
            if encoding == "text":
                return _parsed(file.read().replace(b",", b" ").split(), shape, dtype.newbyteorder("="))
            stream = _stream(file, encoding, skip, math.prod(shape) * dtype.itemsize)
            if encoding == "raw":
                return np.asarray(np.memmap(file, dtype, "r", file.tell(), tuple(shape)))
            array = _filled(stream, shape, dtype)
            return array if dtype.isnative else array.byteswap(inplace=True).view(dtype.newbyteorder("="))
        except (EOFError, zlib.error) as error:
            raise InputError(f"the voxels are cut short or damaged ({error}); copy or export the file again") from error


def has_temporary_room(shape: Sequence[int], dtype: np.dtype) -> bool:
    """Whether the folder for temporary files has room for `temporarily_mapped`."""
    return shutil.disk_usage(tempfile.gettempdir()).free > math.prod(shape) * dtype.itemsize


def temporarily_mapped(planes: Iterable[np.ndarray], shape: Sequence[int], dtype: np.dtype) -> np.ndarray:
    """Write planes to a temporary file one by one and map it, read-only.

    The file has no name (POSIX) or is marked for deletion (Windows) from the start: the system removes it when the array
    is gone, also when the process is killed. Nobody else can read it.

    Args:
        planes: in order; together of `shape`.
    """
    with tempfile.TemporaryFile() as file:
        for plane in planes:
            file.write(np.ascontiguousarray(plane, dtype).data)
        file.flush()
        return np.asarray(np.memmap(file, dtype, "r", 0, tuple(shape)))


def _stream(file: io.BufferedReader, encoding: str, skip: int, size: int) -> io.IOBase:
    """The unpacked voxels, from their first byte."""
    available = os.fstat(file.fileno()).st_size - file.tell()
    if skip < (-1 if encoding == "raw" else 0):
        raise InputError(f"a skip of {skip} bytes is not defined for {encoding} data")
    if encoding == "raw":
        if available < size + max(skip, 0):
            raise InputError(IS_TRUNCATED)
        file.seek(*((-size, os.SEEK_END) if skip < 0 else (skip, os.SEEK_CUR)))
        return file
    if encoding in ("gzip", "zlib") and available * MAX_DEFLATE_RATIO < size:
        raise InputError(IS_TRUNCATED)
    if encoding not in ("gzip", "zlib", "bzip2", "hex"):
        raise InputError(f"the encoding {encoding!r} is not known; save the volume as raw or gzip")
    stream: io.IOBase = {"bzip2": bz2.BZ2File, "hex": _Unhexed}.get(encoding, _Inflated)(file)
    while skip > 0 and (passed := len(stream.read(min(skip, _CHUNK)))):
        skip -= passed
    return stream


class _Unhexed(io.RawIOBase):
    """Bytes written as pairs of hexadecimal digits, with blanks anywhere."""

    def __init__(self, file: io.BufferedReader) -> None:
        self._file, self._rest = file, b""

    def readable(self) -> bool:
        return True

    def readinto(self, view: memoryview) -> int:
        digits = self._rest
        while len(digits) < 2 and (read := self._file.read(2 * len(view))):
            digits += b"".join(read.split())
        count = min(len(digits) // 2, len(view))
        self._rest = digits[2 * count :]
        try:
            view[:count] = bytes.fromhex(digits[: 2 * count].decode("ascii"))
        except ValueError as error:
            raise InputError(
                f"the voxels are no hexadecimal digits ({error}); copy or export the file again"
            ) from error
        return count


class _Inflated(io.RawIOBase):
    """Unpacks zlib and gzip streams, one behind the other as `gzip` does; what follows the last of them does not count."""

    def __init__(self, file: io.BufferedReader) -> None:
        self._file, self._unpacker, self._packed = file, zlib.decompressobj(wbits=47), b""

    def readable(self) -> bool:
        return True

    def readinto(self, view: memoryview) -> int:
        data = b""
        while not data:
            if self._unpacker.eof and not self._begins_again():
                return 0
            packed = self._unpacker.unconsumed_tail or self._packed or self._file.read(1 << 16)
            self._packed = b""
            data = self._unpacker.decompress(packed, len(view))
            if not packed and not data:
                raise EOFError("no end of the stream")
        view[: len(data)] = data
        return len(data)

    def _begins_again(self) -> bool:
        """Whether another gzip stream follows."""
        rest = self._unpacker.unused_data.lstrip(b"\0")
        while len(rest) < len(GZIP) and (more := self._file.read(1 << 16)):
            rest = (rest + more).lstrip(b"\0")
        if not rest.startswith(GZIP):
            return False
        self._unpacker, self._packed = zlib.decompressobj(wbits=47), rest
        return True


def _filled(stream: io.IOBase, shape: Sequence[int], dtype: np.dtype) -> np.ndarray:
    array = np.empty(shape, dtype)
    view = memoryview(array.reshape(-1).view(np.uint8))
    done = 0
    while done < len(view):
        count = stream.readinto(view[done : done + _CHUNK])
        if not count:
            raise InputError(IS_TRUNCATED)
        done += count
    stream.read(1)  # makes a compressed stream verify its check sum
    return array


def _parsed(words: list[bytes], shape: Sequence[int], dtype: np.dtype) -> np.ndarray:
    count = math.prod(shape)
    if len(words) < count:
        raise InputError(IS_TRUNCATED)
    try:
        return np.array(words[:count]).astype(dtype).reshape(shape)
    except (ValueError, OverflowError) as error:
        raise InputError(f"the text data are no {dtype} numbers ({error})") from error
