"""MetaImage and NIfTI in.

MetaImage is read here and not by ITK: SimpleITK 2.5 gives damaged or missing voxels of a compressed one as whatever its
memory held, and damaged headers crash it.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume
from .choice import Choice, checked_count, chosen_note, pick
from .voxel_data import (
    IS_COLOR,
    IS_FLAT,
    IS_FOUR_D,
    IS_TRUNCATED,
    LPS_TO_RAS,
    MAX_DEFLATE_RATIO,
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

_SAME_FORM = 0.01  # of a voxel's edge: sform and qform that differ by no more are one
_UPRIGHT = 1e-4  # largest cosine between axes that ITK takes for a right angle


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
    dtype = np.dtype(_META_TYPES[kind])
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
    array = read_voxels(source, start, shape, dtype.newbyteorder(">" if big_endian else "<"), encoding, skip=skip)
    notes = [*chosen_note(choices, index, number), *notes]
    return Volume(array[index] if len(shape) == 4 else array, matrix, name=title(path), notes=tuple(notes))


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


# --- NIfTI ----------------------------------------------------------------------------------------------------------


@contextmanager
def _quiet_nibabel() -> Iterator[None]:
    """Keep remarks on odd header fields off stderr."""
    from nibabel.imageglobals import logger

    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def load_nifti(path: Path):
    """The nibabel image; voxels still on disk."""
    import nibabel as nib

    try:
        with _quiet_nibabel():
            image = nib.load(path, mmap="r")
    except (OSError, MemoryError):
        raise
    except Exception as error:  # nibabel raises whatever a damaged header makes its parts raise
        raise InputError(f"not a readable NIfTI ({error})") from error
    if not isinstance(image, nib.Nifti1Image):
        raise InputError(f"holds a {type(image).__name__}, not a NIfTI; save it as NIfTI or NRRD")
    return image


def nifti_matrix(image, notes: list[str]) -> np.ndarray:
    """(4, 4) IJK to RAS in millimetres: sform or qform, the one that ITK takes; else the size of the voxels alone."""
    matrix = np.array(image.affine, dtype=np.float64)
    sform_code, qform_code = int(image.header["sform_code"]), int(image.header["qform_code"])
    if not sform_code and not qform_code:
        notes.append("the NIfTI header has no orientation; axes are taken as left, anterior, superior")
    if sform_code and qform_code:
        matrix = _as_itk_takes_it(matrix, sform_code, image, notes)
    scale = {1: 1e3, 3: 1e-3}.get(int(image.header["xyzt_units"]) & 7, 1.0)  # metre, micrometre
    if scale != 1.0:
        notes.append(f"the NIfTI header's unit is not millimetres; the geometry was multiplied by {scale:g}")
        matrix[:3] *= scale
    return repaired(matrix, (*image.shape, 1, 1, 1)[2::-1], notes)


def _as_itk_takes_it(sform: np.ndarray, code: int, image, notes: list[str]) -> np.ndarray:
    """Of two orientations that differ ITK 5.4, and so 3D Slicer, takes the sform only if it is the scanner's and upright."""
    import nibabel as nib

    try:
        qform = np.array(image.header.get_qform(), dtype=np.float64)
    except (nib.spatialimages.HeaderDataError, ValueError):
        notes.append("the qform of the NIfTI header is damaged; the sform is used")
        return sform
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(image.shape[:3]) - 1)
    apart = np.linalg.norm(corners @ (sform - qform)[:3, :3].T + (sform - qform)[:3, 3], axis=1).max()
    edges = np.linalg.norm(sform[:3, :3], axis=0)
    if not apart > _SAME_FORM * edges.min():
        return sform
    axes = sform[:3, :3] / np.maximum(edges, 1e-300)
    upright = np.abs(axes.T @ axes - np.eye(3)).max() < _UPRIGHT
    taken, other = ("sform", "qform") if code == 1 and upright else ("qform", "sform")
    turn = _turn_degrees(sform, qform)
    notes.append(
        f"sform and qform of the NIfTI header differ by up to {apart:.3g} mm{turn}: the {taken} is used, as ITK and 3D Slicer "
        f"do, the {other} is not"
    )
    return sform if taken == "sform" else qform


def _turn_degrees(a: np.ndarray, b: np.ndarray) -> str:
    """Words on the angle between two orientations, where there is one."""
    one, other = (m[:3, :3] / np.maximum(np.linalg.norm(m[:3, :3], axis=0), 1e-300) for m in (a, b))
    angle = np.degrees(np.arccos(np.clip((np.trace(one.T @ other) - 1) / 2, -1, 1)))
    return f" and {angle:.3g} degrees" if angle > 0.1 else ""


def read_nifti(path: Path, max_bytes: int, number: int | None = None) -> Volume:
    """A scalar NIfTI-1 or -2 with three axes; of more (time points) the volume with that number, from 1 on."""
    image = load_nifti(path)
    dtype, count = image.get_data_dtype(), _nifti_count(image)
    if count > 1 and number is None:
        raise InputError(f"{IS_FOUR_D} ({count} volumes)")
    notes: list[str] = []
    choices = nifti_choices(path, image)
    index = pick(choices, number)
    notes += chosen_note(choices, index, number)
    matrix = nifti_matrix(image, notes)
    shape = image.shape[:3]
    array = nifti_array(image, check_size(shape, dtype, max_bytes), path, index if count > 1 else None)
    return Volume(array.reshape(shape[::-1]), matrix, name=title(path), notes=tuple(notes))


def nifti_choices(path: Path, image=None) -> list[Choice]:
    """What there is to choose from: one volume, or one for each point of the axes after the third."""
    image = image or load_nifti(path)
    count = _nifti_count(image)
    shape = image.shape[:3]
    spacing = tuple(np.linalg.norm(nifti_matrix(image, [])[:3, :3], axis=0).tolist())
    return [Choice(f"time point {n + 1}" if count > 1 else title(path), shape, spacing) for n in range(count)]


def _nifti_count(image) -> int:
    """Volumes of a file.

    Raises:
        InputError: colour, two-dimensional, or a type that is not a number.
    """
    dtype, shape = image.get_data_dtype(), image.shape
    if dtype.names or shape[4:] == (3,):
        raise InputError(IS_COLOR)
    if len(shape) < 3:
        raise InputError(IS_FLAT)
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise InputError(f"NIfTI type {dtype} is not an integer or float type of at most 64 bits")
    return checked_count(math.prod(int(n) for n in shape[3:]))


def nifti_array(image, size: int, path: Path, index: int | None = None) -> np.ndarray:
    """The voxels, slowest axis first; of an uncompressed file without a scale the file itself, read-only and mapped.

    Scaled integers up to 16 bits become float32, others float64.
    """
    if size > path.stat().st_size * (MAX_DEFLATE_RATIO if path.suffix.lower() == ".gz" else 1):
        raise InputError(IS_TRUNCATED)
    dtype = image.get_data_dtype()
    part = (...,) if index is None else (..., *np.unravel_index(index, image.shape[3:], order="F"))
    part = tuple(int(n) if isinstance(n, np.integer) else n for n in part)
    try:
        if (image.dataobj.slope, image.dataobj.inter) == (1.0, 0.0):  # nibabel blanks the header's own after loading
            array = image.dataobj.get_unscaled() if index is None else image.dataobj[part]
            return np.asarray(array).T.astype(dtype.newbyteorder("="), copy=False)
        narrow = np.float32 if dtype.itemsize <= 2 or dtype == np.float32 else np.float64
        if index is None:
            return np.asarray(image.dataobj, dtype=narrow).T
        return np.asarray(image.dataobj[part], dtype=narrow).T
    except (EOFError, zlib.error, OSError, ValueError, OverflowError) as error:  # ValueError: an offset beyond any file
        raise InputError(f"{IS_TRUNCATED} ({error})") from error
