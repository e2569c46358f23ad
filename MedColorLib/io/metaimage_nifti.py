"""MetaImage and NIfTI in.

MetaImage is read here and not by ITK: SimpleITK 2.5 gives damaged or missing voxels of a compressed one as whatever its
memory held, and damaged headers crash it.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume
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
    title,
)

_META_TYPES = {
    **{"MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4"},
    **{"MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8"},  # long: always 4 bytes
    **{"MET_FLOAT": "f4", "MET_DOUBLE": "f8"},
}


def read_meta_image(path: Path, max_bytes: int) -> Volume:
    """A scalar MetaImage with three axes; voxels attached or detached, raw, zlib or text."""
    fields, end = meta_fields(path)
    try:
        shape = tuple(int(size) for size in reversed(fields["DimSize"].split()))
        channels, skip = int(fields.get("ElementNumberOfChannels", 1)), int(fields.get("HeaderSize", 0))
        matrix = _meta_matrix(fields) if len(shape) == 3 else LPS_TO_RAS
    except ValueError as error:
        raise InputError(f"not a valid MetaImage header ({error})") from error
    kind = fields["ElementType"].removesuffix("_ARRAY")
    if channels != 1 or kind != fields["ElementType"]:
        raise InputError(IS_COLOR)
    if len(shape) != 3:
        raise InputError(IS_FLAT if len(shape) < 3 else IS_FOUR_D)
    if kind not in _META_TYPES:
        raise InputError(f"MetaImage type {kind!r} is not an integer or float type")
    dtype = np.dtype(_META_TYPES[kind])
    check_size(shape, dtype, max_bytes)
    big_endian = _is_true(fields, "BinaryDataByteOrderMSB") or _is_true(fields, "ElementByteOrderMSB")
    encoding = (
        "zlib" if _is_true(fields, "CompressedData") else "raw" if _is_true(fields, "BinaryData", "T") else "text"
    )
    attached = fields["ElementDataFile"].upper() == "LOCAL"
    source, start = (path, end) if attached else (data_file(path, fields["ElementDataFile"]), 0)
    array = read_voxels(source, start, shape, dtype.newbyteorder(">" if big_endian else "<"), encoding, skip=skip)
    return Volume(array, matrix, name=title(path))


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


def _meta_matrix(fields: dict[str, str]) -> np.ndarray:
    """(4, 4) IJK to RAS. The header holds LPS; each row of its TransformMatrix is the direction of one axis."""

    def numbers(count: int, default: np.ndarray, *names: str) -> np.ndarray:
        values = next((np.array(fields[name].split(), dtype=float) for name in names if name in fields), default)
        if values.size != count:
            raise ValueError(f"{names[0]} has {values.size} numbers instead of {count}")
        return values

    matrix = np.eye(4)
    spacing = numbers(3, np.ones(3), "ElementSpacing", "ElementSize")
    matrix[:3, :3] = numbers(9, np.eye(3), "TransformMatrix", "Rotation", "Orientation").reshape(3, 3).T * spacing
    matrix[:3, 3] = numbers(3, np.zeros(3), "Offset", "Position", "Origin")
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
            image = nib.load(path, mmap=False)
    except (nib.filebasedimages.ImageFileError, nib.spatialimages.HeaderDataError, EOFError, zlib.error) as error:
        raise InputError(f"not a readable NIfTI ({error})") from error
    if not isinstance(image, nib.Nifti1Image):
        raise InputError(f"holds a {type(image).__name__}, not a NIfTI; save it as NIfTI or NRRD")
    return image


def nifti_matrix(image, notes: list[str]) -> np.ndarray:
    """(4, 4) IJK to RAS in millimetres: sform, else qform, else the size of the voxels alone."""
    matrix = np.array(image.affine, dtype=np.float64)
    if not image.header["sform_code"] and not image.header["qform_code"]:
        notes.append("the NIfTI header has no orientation; axes are taken as left, anterior, superior")
    scale = {1: 1e3, 3: 1e-3}.get(int(image.header["xyzt_units"]) & 7, 1.0)  # metre, micrometre
    if scale != 1.0:
        notes.append(f"the NIfTI header's unit is not millimetres; the geometry was multiplied by {scale:g}")
        matrix[:3] *= scale
    return matrix


def read_nifti(path: Path, max_bytes: int) -> Volume:
    """A scalar NIfTI-1 or -2 with three axes; a fourth of length one is dropped."""
    image = load_nifti(path)
    dtype, shape = image.get_data_dtype(), image.shape
    if dtype.names or shape[4:] == (3,):
        raise InputError(IS_COLOR)
    if len(shape) < 3:
        raise InputError(IS_FLAT)
    if shape[3:] not in ((), (1,)):
        raise InputError(IS_FOUR_D)
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise InputError(f"NIfTI type {dtype} is not an integer or float type of at most 64 bits")
    notes: list[str] = []
    matrix = nifti_matrix(image, notes)
    array = nifti_array(image, check_size(shape, dtype, max_bytes), path)
    return Volume(array.reshape(array.shape[-3:]), matrix, name=title(path), notes=tuple(notes))


def nifti_array(image, size: int, path: Path) -> np.ndarray:
    """The voxels, slowest axis first, native. Scaled integers up to 16 bits become float32, others float64."""
    if size > path.stat().st_size * (MAX_DEFLATE_RATIO if path.suffix.lower() == ".gz" else 1):
        raise InputError(IS_TRUNCATED)
    dtype = image.get_data_dtype()
    try:
        if (image.dataobj.slope, image.dataobj.inter) == (1.0, 0.0):  # nibabel blanks the header's own after loading
            array = image.dataobj.get_unscaled()
        else:
            narrow = dtype.itemsize <= 2 or dtype == np.float32
            array = np.asarray(image.dataobj, dtype=np.float32 if narrow else np.float64)
            dtype = np.dtype(np.float32 if narrow else np.float64)
    except (EOFError, zlib.error, OSError, ValueError) as error:  # ValueError: an offset beyond any file
        raise InputError(f"{IS_TRUNCATED} ({error})") from error
    return np.asarray(array).T.astype(dtype.newbyteorder("="), copy=False)
