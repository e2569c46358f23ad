"""NRRD in: header numbers as they are written (pynrrd), voxels by `voxel_data`.

pynrrd's own reading of voxels keeps several copies in memory and unpacks whatever a compressed stream holds.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume
from .voxel_data import IS_COLOR, IS_FLAT, IS_FOUR_D, MAX_HEADER, check_size, data_file, read_voxels, title

_TYPES = {
    alias: dtype
    for dtype, aliases in {
        "int8": "signed char,int8,int8_t",
        "uint8": "uchar,unsigned char,uint8,uint8_t",
        "int16": "short,short int,signed short,signed short int,int16,int16_t",
        "uint16": "ushort,unsigned short,unsigned short int,uint16,uint16_t",
        "int32": "int,signed int,int32,int32_t",
        "uint32": "uint,unsigned int,uint32,uint32_t",
        "int64": "longlong,long long,long long int,signed long long,signed long long int,int64,int64_t",
        "uint64": "ulonglong,unsigned long long,unsigned long long int,uint64,uint64_t",
        "float32": "float",
        "float64": "double",
    }.items()
    for alias in aliases.split(",")
}
_FIELDS = {
    "spacing": "spacings",
    **{name: name for name in ("dimension", "type", "encoding", "endian", "sizes", "kinds", "spacings", "thicknesses")},
    **{name: name for name in ("space", "space dimension", "space directions", "space origin")},
    **{name.replace(" ", ""): name for name in ("data file", "byte skip", "line skip")},
    **{name: name for name in ("data file", "byte skip", "line skip")},
}
_ENCODINGS = {"gz": "gzip", "bz2": "bzip2", "ascii": "text", "txt": "text"}
_RAS_SIGNS = {
    **dict.fromkeys(("right-anterior-superior", "ras"), (1.0, 1.0, 1.0)),
    **dict.fromkeys(("left-anterior-superior", "las"), (-1.0, 1.0, 1.0)),
    **dict.fromkeys(("left-posterior-superior", "lps"), (-1.0, -1.0, 1.0)),
}


def nrrd_header(path: Path) -> dict:
    """The fields of an NRRD header that say where and what the voxels are; `start`: the offset of attached data.

    pynrrd parses the values. It gets the lines in its own spelling, because it takes field names by the letter, wants
    no blanks inside vectors, and drops letters outside ASCII from file names; key-value pairs are left out.
    """
    import nrrd

    lines = []
    with path.open("rb") as file:
        magic = file.readline(MAX_HEADER).decode("ascii", "replace")
        while file.tell() <= MAX_HEADER:
            line = file.readline(MAX_HEADER).decode("utf-8", "surrogateescape").rstrip()
            if not line:
                break
            name, _, value = line.partition(":")
            field = _FIELDS.get(name.strip().lower())
            if field and not value.startswith("="):
                vectors = field.startswith("space ") and re.sub(r"(?<=[(,])\s+|\s+(?=[,)])", "", value)
                lines.append(f"{field}: {(vectors or value).strip()}")
        start = file.tell()
    try:
        with np.errstate(invalid="ignore"):  # sizes beyond any integer come out negative and are refused by their value
            header = dict(nrrd.read_header([magic, *lines]))
    except (nrrd.NRRDError, ValueError, IndexError) as error:
        raise InputError(f"not a valid NRRD header ({error})") from error
    return {**header, "start": start}


def nrrd_axes(header: dict) -> tuple[list[int], list[int]]:
    """The axes in space and the other ones (colour, vector, list), from kinds and directions."""
    missing = {"dimension", "type", "encoding", "sizes"} - header.keys()
    if missing:
        raise InputError(f"the NRRD header lacks {', '.join(sorted(missing))}")
    sizes, directions = header["sizes"], header.get("space directions")
    kinds = [kind.lower() for kind in header.get("kinds", ["domain"] * len(sizes))]
    if {len(sizes), len(kinds), len(sizes if directions is None else directions)} != {header["dimension"]}:
        raise InputError("sizes, kinds and space directions of the NRRD header differ in number from its dimension")
    in_space = [
        kind in ("domain", "space", "???", "none") and (directions is None or not np.isnan(directions[axis]).all())
        for axis, kind in enumerate(kinds)
    ]
    return [a for a, inside in enumerate(in_space) if inside], [a for a, inside in enumerate(in_space) if not inside]


def nrrd_matrix(header: dict, axes: Sequence[int], notes: list[str]) -> np.ndarray:
    """(4, 4) IJK to RAS from the header's numbers. Without a known space they are taken as RAS, as Slicer does."""
    space = header.get("space", "").strip().lower()
    if space not in _RAS_SIGNS:
        notes.append(f"the space of the NRRD header is {space or 'not given'}; its numbers are taken as RAS")
    signs = np.array(_RAS_SIGNS.get(space, (1.0, 1.0, 1.0)))
    matrix = np.eye(4)
    directions = header.get("space directions")
    if directions is not None:
        if directions.shape[1] != 3:
            raise InputError(f"the NRRD space has {directions.shape[1]} dimensions instead of 3")
        matrix[:3, :3] = signs[:, None] * directions[list(axes)].T
    else:
        steps = header.get("spacings", header.get("thicknesses", np.full(header["dimension"], np.nan)))
        if len(steps) != header["dimension"]:
            raise InputError("the NRRD header has spacings that differ in number from its dimension")
        steps = steps[list(axes)]
        if not np.all(np.isfinite(steps) & (steps != 0)):
            notes.append("no spacing in the NRRD header: 1 mm is assumed")
        matrix[:3, :3] = np.diag(signs * np.where(np.isfinite(steps) & (steps != 0), steps, 1.0))
    origin = header.get("space origin")
    if origin is None or np.shape(origin) != (3,):
        notes.append("no origin in the NRRD header: 0, 0, 0 is assumed")
        origin = np.zeros(3)
    matrix[:3, 3] = signs * origin
    return matrix + 0.0  # + 0.0 turns -0.0 into 0.0


def read_nrrd(path: Path, max_bytes: int) -> Volume:
    """A scalar NRRD with three axes in space, in any known or unknown space, with attached or detached data."""
    header = nrrd_header(path)
    spatial, other = nrrd_axes(header)
    if len(spatial) == 2:
        raise InputError(IS_FLAT)
    if other and len(spatial) == 3:
        raise InputError(IS_COLOR)
    if other or len(spatial) != 3:
        raise InputError(IS_FOUR_D)
    notes: list[str] = []
    matrix = nrrd_matrix(header, spatial, notes)
    return Volume(nrrd_array(path, header, max_bytes), matrix, name=title(path), notes=tuple(notes))


def nrrd_array(path: Path, header: dict, max_bytes: int) -> np.ndarray:
    """The voxels, slowest axis first, in the machine's byte order."""
    shape = tuple(int(size) for size in header["sizes"][::-1])
    kind, encoding, endian = (header.get(field, "").lower() for field in ("type", "encoding", "endian"))
    if kind not in _TYPES:
        raise InputError(f"NRRD type {kind!r} is not a number; integer and float types can be read")
    dtype = np.dtype(_TYPES[kind])
    check_size(shape, dtype, max_bytes)
    encoding = _ENCODINGS.get(encoding, encoding)
    if dtype.itemsize > 1 and encoding != "text":
        if endian not in ("little", "big"):
            raise InputError("the NRRD header lacks endian: little or big")
        dtype = dtype.newbyteorder("<" if endian == "little" else ">")
    name = header.get("data file")
    source, start = (path, header["start"]) if name is None else (data_file(path, name), 0)
    skips = {"lines": header.get("line skip", 0), "skip": header.get("byte skip", 0)}
    return read_voxels(source, start, shape, dtype, encoding, **skips)
