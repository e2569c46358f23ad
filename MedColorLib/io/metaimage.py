"""MetaImage in. It is read here and not by ITK: SimpleITK 2.5 gives damaged or missing voxels of a compressed one as whatever its
memory held, and damaged headers crash it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume
from .choice import Choice, checked_count, chosen_note, pick
from .voxel_data import (
    IS_COLOR,
    IS_FLAT,
    IS_FOUR_D,
    LPS_TO_RAS,
    MAX_HEADER,
    check_size,
    data_file,
    read_voxels,
    repaired,
    title,
)

_META_TYPES = {
    **{"MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4"},
    **{"MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8"},  # long: always 4 bytes
    **{"MET_FLOAT": "f4", "MET_DOUBLE": "f8"},
}


def read_meta_image(path: Path, max_bytes: int, number: int | None = None) -> Volume:
    """A scalar MetaImage with three axes; voxels attached or detached, raw, zlib or text.

    Of four axes (time points) the volume with that number, from 1 on.
    """
    fields, end = meta_fields(path)
    shape, matrix, notes = _meta_geometry(fields)
    count = checked_count(shape[0]) if len(shape) == 4 else 1
    if count > 1 and number is None:
        raise InputError(f"{IS_FOUR_D} ({count} volumes)")
    choices = _meta_choices(path, shape, matrix)
    index = pick(choices, number)
    kind = fields["ElementType"]
    if kind not in _META_TYPES:
        raise InputError(f"MetaImage type {kind!r} is not an integer or float type")
    array = _meta_voxels(path, fields, end, shape, np.dtype(_META_TYPES[kind]), max_bytes)
    notes = [*chosen_note(choices, index, number), *notes]
    return Volume(array[index] if len(shape) == 4 else array, matrix, name=title(path), notes=tuple(notes))


def read_meta_colors(
    path: Path, max_bytes: int, check: Callable[[str, Sequence[int], int], None]
) -> tuple[np.ndarray, np.ndarray]:
    """(k, j, i, channels), and (4, 4) IJK to RAS.

    Args:
        check: called with type, size along i, j, k and channels; raises where they are not wanted.
    """
    fields, end = meta_fields(path)
    kind = fields["ElementType"].replace("_ARRAY", "")
    try:
        channels = int(fields.get("ElementNumberOfChannels", 1))
    except ValueError as error:
        raise InputError(f"not a valid MetaImage header ({error})") from error
    shape, matrix, _ = _meta_geometry({**fields, "ElementNumberOfChannels": "1", "ElementType": kind})
    dtype = np.dtype(_META_TYPES.get(kind, "V1"))
    check(dtype.name if kind in _META_TYPES else kind, shape[::-1], channels)
    return _meta_voxels(path, fields, end, (*shape, channels), dtype, max_bytes), matrix


def _meta_voxels(
    path: Path, fields: dict[str, str], end: int, shape: tuple[int, ...], dtype: np.dtype, max_bytes: int
) -> np.ndarray:
    check_size(shape, dtype, max_bytes)
    big_endian = _is_true(fields, "BinaryDataByteOrderMSB") or _is_true(fields, "ElementByteOrderMSB")
    encoding = (
        "zlib" if _is_true(fields, "CompressedData") else "raw" if _is_true(fields, "BinaryData", "T") else "text"
    )
    try:
        skip = int(fields.get("HeaderSize", 0))
    except ValueError as error:
        raise InputError(f"not a valid MetaImage header ({error})") from error
    attached = fields["ElementDataFile"].upper() == "LOCAL"
    source, start = (path, end) if attached else (data_file(path, fields["ElementDataFile"]), 0)
    return read_voxels(source, start, shape, dtype.newbyteorder(">" if big_endian else "<"), encoding, skip=skip)


def meta_choices(path: Path) -> list[Choice]:
    """What there is to choose from: one volume, or one for each point of a fourth axis."""
    shape, matrix, _ = _meta_geometry(meta_fields(path)[0])
    return _meta_choices(path, shape, matrix)


def _meta_choices(path: Path, shape: tuple[int, ...], matrix: np.ndarray) -> list[Choice]:
    spacing = tuple(np.linalg.norm(matrix[:3, :3], axis=0).tolist())
    names = [f"time point {n + 1}" for n in range(checked_count(shape[0]))] if len(shape) == 4 else [title(path)]
    return [Choice(name, shape[:-4:-1], spacing) for name in names]


def _meta_geometry(fields: dict[str, str]) -> tuple[tuple[int, ...], np.ndarray, list[str]]:
    """(shape, three axes or four, the slowest first; (4, 4) IJK to RAS; notes).

    Raises:
        InputError: damaged, colour, or fewer or more axes.
    """
    try:
        shape = tuple(int(size) for size in reversed(fields["DimSize"].split()))
        axes = len(shape)
        channels = int(fields.get("ElementNumberOfChannels", 1))
        while len(shape) > 3 and shape[0] == 1:
            shape = shape[1:]  # a fourth axis of length one
        matrix = _meta_matrix(fields, axes) if len(shape) in (3, 4) else LPS_TO_RAS
    except ValueError as error:
        raise InputError(f"not a valid MetaImage header ({error})") from error
    if channels != 1 or fields["ElementType"].endswith("_ARRAY"):
        raise InputError(IS_COLOR)
    if len(shape) not in (3, 4):
        raise InputError(IS_FLAT if len(shape) < 3 else IS_FOUR_D)
    notes: list[str] = []
    scale = {"um": 1e-3, "cm": 10.0, "m": 1e3}.get(fields.get("DistanceUnits", "mm"), 1.0)
    if scale != 1.0:
        notes.append(f"the MetaImage header's unit is not millimetres; the geometry was multiplied by {scale:g}")
    return shape, repaired(np.diag([scale, scale, scale, 1.0]) @ matrix, shape[-3:], notes), notes


def meta_fields(path: Path) -> tuple[dict[str, str], int]:
    """The header's fields, and where its last line ends."""
    fields: dict[str, str] = {}
    with path.open("rb") as file:
        while "ElementDataFile" not in fields and file.tell() < MAX_HEADER:
            line = file.readline(MAX_HEADER)
            if not line:
                break
            name, _, value = line.decode("utf-8", "surrogateescape").partition("=")
            fields[name.strip()] = value.strip()
        missing = {"DimSize", "ElementType", "ElementDataFile"} - fields.keys()
        if missing:
            raise InputError(f"not a MetaImage: the header lacks {', '.join(sorted(missing))}")
        return fields, file.tell()


def _meta_matrix(fields: dict[str, str], axes: int) -> np.ndarray:
    """(4, 4) IJK to RAS of the first three of `axes`. The header holds LPS; a row of its matrix is an axis' direction."""

    def numbers(count: int, default: np.ndarray, *names: str) -> np.ndarray:
        values = next((np.array(fields[name].split(), dtype=float) for name in names if name in fields), default)
        if values.size != count:
            raise ValueError(f"{names[0]} has {values.size} numbers instead of {count}")
        return values

    matrix = np.eye(4)
    spacing = numbers(axes, np.ones(axes), "ElementSpacing", "ElementSize")[:3]
    turns = numbers(axes * axes, np.eye(axes), "TransformMatrix", "Rotation", "Orientation").reshape(axes, axes)
    matrix[:3, :3] = turns[:3, :3].T * spacing
    matrix[:3, 3] = numbers(axes, np.zeros(axes), "Offset", "Position", "Origin")[:3]
    return LPS_TO_RAS @ matrix + 0.0  # + 0.0 turns -0.0 into 0.0


def _is_true(fields: dict[str, str], name: str, default: str = "F") -> bool:
    return fields.get(name, default)[:1] in ("T", "t", "1")
