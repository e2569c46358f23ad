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
from .choice import Choice, checked_count, chosen_note, pick
from .voxel_data import IS_COLOR, IS_FLAT, IS_FOUR_D, MAX_HEADER, check_size, data_file, read_voxels, repaired, title

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
    **{name.replace(" ", ""): name for name in ("axis mins", "axis maxs")},
    **{name: name for name in ("axis mins", "axis maxs", "centerings", "space units", "units")},
    "centers": "centerings",
}
_IN_SPACE = ("domain", "space", "???", "none")
_ENCODINGS = {"gz": "gzip", "bz2": "bzip2", "ascii": "text", "txt": "text"}
_UNITS_MM = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre"), 1.0),
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm", "micron", "microns", "micrometer", "micrometre"), 1e-3),
    **dict.fromkeys(("m", "meter", "metre", "meters", "metres"), 1e3),
    **{"cm": 10.0, "nm": 1e-6},
}
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
    """The axes in space and the other ones (colour, vector, list), from kinds and directions.

    Axes of length one that are not needed are in neither list.
    """
    missing = {"dimension", "type", "encoding", "sizes"} - header.keys()
    if missing:
        raise InputError(f"the NRRD header lacks {', '.join(sorted(missing))}")
    sizes, directions = header["sizes"], header.get("space directions")
    kinds = [kind.lower() for kind in header.get("kinds", ["domain"] * len(sizes))]
    if {len(sizes), len(kinds), len(sizes if directions is None else directions)} != {header["dimension"]}:
        raise InputError("sizes, kinds and space directions of the NRRD header differ in number from its dimension")
    inside = [
        axis
        for axis, kind in enumerate(kinds)
        if kind in _IN_SPACE and (directions is None or not np.isnan(directions[axis]).all())
    ]
    while len(inside) > 3 and (single := [axis for axis in inside if sizes[axis] == 1]):
        inside.remove(single[-1])
    if len(inside) == 4 and directions is None:
        inside.pop()  # the last of four is time
    return inside, [axis for axis, size in enumerate(sizes) if axis not in inside and size != 1]


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
        matrix[:3, :3] = np.diag(signs * _steps(header, axes, notes))
    matrix[:3, 3] = signs * _origin(header, axes, signs * np.diag(matrix)[:3], notes)
    scale = _unit_mm(header, axes, notes)
    matrix[:3] *= scale
    return repaired(matrix, [int(header["sizes"][axis]) for axis in reversed(axes)], notes) + 0.0  # no -0.0


def _per_axis(header: dict, name: str, axes: Sequence[int]) -> np.ndarray:
    """(3,) numbers of the axes in space; nan where they are not given."""
    values = header.get(name)
    if values is None:
        return np.full(len(axes), np.nan)
    if np.size(values) != header["dimension"]:
        raise InputError(f"the NRRD header has {name} that differ in number from its dimension")
    return np.asarray(values, dtype=np.float64)[list(axes)]


def _steps(header: dict, axes: Sequence[int], notes: list[str]) -> np.ndarray:
    """(3,) from spacings, from the ends of the axes, or from thicknesses."""
    lows, highs = _per_axis(header, "axis mins", axes), _per_axis(header, "axis maxs", axes)
    sizes = np.asarray(header["sizes"], dtype=np.float64)[list(axes)]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        found = [_per_axis(header, "spacings", axes), (highs - lows) / (sizes - _is_node(header, axes))]
    steps = np.full(len(axes), np.nan)
    for values in (*found, _per_axis(header, "thicknesses", axes)):
        good = np.isfinite(values) & (values != 0) & ~np.isfinite(steps)
        steps = np.where(good, values, steps)
    if good.any():
        notes.append("the NRRD header gives the thickness of slices, not their distance; that is taken for it")
    if not np.isfinite(steps).all():
        notes.append("no spacing in the NRRD header: 1 mm is assumed")
    return np.where(np.isfinite(steps), steps, 1.0)


def _is_node(header: dict, axes: Sequence[int]) -> np.ndarray:
    """(3,) bool: the axis' ends are centres of voxels; else, as by default (and in ITK), they are edges of them."""
    centers = header.get("centerings") or ["cell"] * header["dimension"]
    if len(centers) != header["dimension"]:
        raise InputError("the NRRD header has centerings that differ in number from its dimension")
    return np.array([str(centers[axis]).lower() == "node" for axis in axes])


def _origin(header: dict, axes: Sequence[int], steps: np.ndarray, notes: list[str]) -> np.ndarray:
    """(3,) in the header's own space."""
    origin = header.get("space origin")
    if origin is not None and np.shape(origin) == (3,):
        return np.asarray(origin, dtype=np.float64)
    lows = _per_axis(header, "axis mins", axes)
    if header.get("space directions") is None and np.isfinite(lows).all():
        notes.append("the origin is taken from the axis mins of the NRRD header, as ITK does")
        return lows + np.where(_is_node(header, axes), 0.0, steps / 2)
    notes.append("no origin in the NRRD header: 0, 0, 0 is assumed")
    return np.zeros(3)


def _unit_mm(header: dict, axes: Sequence[int], notes: list[str]) -> float:
    """Millimetres in the header's unit."""
    units = header.get("space units")
    if not units and header.get("units") and len(header["units"]) == header["dimension"]:
        units = [header["units"][axis] for axis in axes]
    words = {str(unit).strip() for unit in units or () if str(unit).strip()}
    if not words:
        return 1.0
    known = {_UNITS_MM.get(word.lower()) for word in words}
    scale = known.pop() if len(known) == 1 else None
    if scale is None:
        notes.append(f"the unit of the NRRD header ({', '.join(sorted(words))}) is not known; it is taken as mm")
        return 1.0
    if scale != 1.0:
        notes.append(f"the NRRD header's unit is not millimetres; the geometry was multiplied by {scale:g}")
    return scale


def nrrd_choices(path: Path) -> list[Choice]:
    """What there is to choose from: one volume, or one for each point of a fourth axis."""
    header = nrrd_header(path)
    spatial, other = nrrd_axes(header)
    shape = tuple(int(header["sizes"][axis]) for axis in spatial)
    count = _volume_count(header, spatial, other)
    spacing = tuple(np.linalg.norm(nrrd_matrix(header, spatial, [])[:3, :3], axis=0).tolist())
    return [Choice(f"volume {n + 1}" if count > 1 else title(path), shape, spacing) for n in range(count)]


def _volume_count(header: dict, spatial: list[int], other: list[int]) -> int:
    """Volumes of a file.

    Raises:
        InputError: two-dimensional, colour, or more than one axis too many.
    """
    sizes = header["sizes"]
    if len(spatial) == 2:
        raise InputError(IS_FLAT)
    kinds = [kind.lower() for kind in header.get("kinds", [])]
    if len(spatial) == 3 and any(kinds and kinds[axis] not in ("list", "time", *_IN_SPACE) for axis in other):
        raise InputError(IS_COLOR)
    if len(spatial) != 3 or len(other) > 1:
        raise InputError(IS_FOUR_D)
    return checked_count(int(sizes[other[0]])) if other else 1


def read_nrrd(path: Path, max_bytes: int, number: int | None = None) -> Volume:
    """A scalar NRRD with three axes in space, in any known or unknown space, with attached or detached data.

    Of more (an axis of the kind list or time) the volume with that number, from 1 on.
    """
    header = nrrd_header(path)
    spatial, other = nrrd_axes(header)
    count = _volume_count(header, spatial, other)
    if count > 1 and number is None:
        raise InputError(f"{IS_FOUR_D} ({count} volumes)")
    notes: list[str] = []
    choices = nrrd_choices(path)
    index = pick(choices, number)
    notes += chosen_note(choices, index, number)
    matrix = nrrd_matrix(header, spatial, notes)
    array = nrrd_array(path, header, max_bytes)
    if other:
        array = array.take(index, axis=len(header["sizes"]) - 1 - other[0])
    shape = [int(header["sizes"][axis]) for axis in reversed(spatial)]
    return Volume(array.reshape(shape), matrix, name=title(path), notes=tuple(notes))


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
