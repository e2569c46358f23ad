"""NIfTI in: single files and pairs of .hdr and .img, packed or not. nibabel knows the header, and maps what is not packed.

What nibabel mends without a word (sizes of zero, scales that are no numbers) is looked up in the header as it is written.
"""

from __future__ import annotations

import gzip
import math
import zlib
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume
from .choice import Choice, checked_count, chosen_note, pick
from .quiet import quiet_package
from .voxel_data import (
    GZIP,
    IS_COLOR,
    IS_FLAT,
    IS_FOUR_D,
    IS_TRUNCATED,
    LPS_TO_RAS,
    MAX_DEFLATE_RATIO,
    check_size,
    read_voxels,
    repaired,
    title,
)

NIFTI_ENDINGS = (".nii", ".nii.gz", ".hdr", ".img", ".hdr.gz", ".img.gz")
_SAME_FORM = 0.01  # of a voxel's edge: sform and qform that differ by no more are one
_UPRIGHT = 1e-4  # largest cosine between axes that ITK takes for a right angle


def nifti_files(path: Path) -> tuple[Path, Path]:
    """(file of the header, file of the voxels): one and the same, or a pair.

    Raises:
        InputError: the other file of a pair is missing.
    """
    name = path.name.lower()
    for own, other in ((".hdr", ".img"), (".img", ".hdr")):
        if not name.endswith((own, f"{own}.gz")):
            continue
        stem, ending = path.name[: name.rindex(own)], path.name[name.rindex(own) :]
        names = [stem + (e.upper() if ending.isupper() else e) for e in (other, f"{other}.gz")]
        found = next((path.with_name(n) for n in names if path.with_name(n).is_file()), None)
        if found is None:
            raise InputError(f"one file of a pair, {names[0]} is missing; put it beside this one")
        return (path, found) if own == ".hdr" else (found, path)
    return path, path


def is_pair(path: Path) -> bool:
    """Whether it is a .hdr with its .img beside it; alone it may be a photograph."""
    try:
        return nifti_files(path)[1] != path
    except InputError:
        return False


def load_nifti(path: Path):
    """The nibabel image; voxels still on disk. `extra["written"]` is the header without nibabel's repairs.

    Raises:
        InputError: damaged, or another kind of file.
    """
    header, voxels = nifti_files(path)
    try:
        with quiet_package("nibabel"):
            kind, written = _kind(_beginning(header))
            _check_offset(written)
            image = kind.from_file_map({**kind.make_file_map(), **_files(kind, header, voxels)}, mmap="r")
    except (OSError, MemoryError, InputError):
        raise
    except Exception as error:  # nibabel raises whatever a damaged header makes its parts raise
        raise InputError(f"not a readable NIfTI ({error})") from error
    image.extra["written"] = written
    return image


def _check_offset(written) -> None:
    if written.is_single and written["vox_offset"] < written.single_vox_offset:
        raise InputError(
            f"the NIfTI header says that the voxels begin at byte {int(written['vox_offset'])}, which is in the header; save "
            "it again"
        )


def _files(kind, header: Path, voxels: Path) -> dict:
    """What nibabel wants to know of where the parts of an image lie."""
    from nibabel.fileholders import FileHolder

    return {name: FileHolder(str(header if name == "header" else voxels)) for name, _ in kind.files_types}


def _beginning(path: Path) -> bytes:
    """The first bytes, unpacked."""
    with path.open("rb") as file:
        packed = file.read(2) == GZIP
    if packed and path.suffix.lower() != ".gz":
        raise InputError(f"packed with gzip, but its name does not say so; name it {path.name}.gz")
    if not packed and path.suffix.lower() == ".gz":
        raise InputError(f"not packed with gzip, though its name says so; if it is a NIfTI, name it {path.stem}")
    try:
        with gzip.open(path) if packed else path.open("rb") as file:
            return file.read(544)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{IS_TRUNCATED} ({error})") from error


def _kind(head: bytes) -> tuple:
    """(nibabel's class, header as it is written) of a file that begins so."""
    import nibabel as nib

    kinds = {b"n+1": nib.Nifti1Image, b"ni1": nib.Nifti1Pair, b"n+2": nib.Nifti2Image, b"ni2": nib.Nifti2Pair}
    for at, length in ((344, 348), (4, 540)):
        kind = kinds.get(head[at : at + 3])
        if kind and len(head) >= length and kind.header_class.sizeof_hdr == length:
            return kind, kind.header_class(head[:length], check=False)
    if 348 in (int.from_bytes(head[:4], order) for order in ("little", "big")):
        raise InputError("an Analyze file, which does not tell left from right; save it as NIfTI or NRRD")
    raise InputError("not a NIfTI, or damaged; save it again as NIfTI or NRRD")


def nifti_matrix(image, notes: list[str]) -> np.ndarray:
    """(4, 4) IJK to RAS in millimetres: sform or qform, the one that ITK takes; else the size of the voxels alone.

    Raises:
        InputError: there is an orientation, and it is damaged.
    """
    forms = _forms(image, notes)
    name = next(iter(forms)) if forms else ""
    if not forms:
        matrix = LPS_TO_RAS @ np.diag([*map(float, image.header.get_zooms()[:3]), 1.0])
        notes.append(
            "the NIfTI header has no orientation: axes are taken to lead left, back and up, as ITK and 3D Slicer do"
        )
    else:
        if len(forms) == 2:
            name = _as_itk_takes_it(forms, int(image.header["sform_code"]), image.shape, notes)
        matrix = forms[name]
    if name != "sform":
        sizes = np.asarray(image.extra["written"]["pixdim"][1:4], dtype=np.float64)
        missing = [axis for axis in range(3) if not sizes[axis] > 0 and image.shape[axis] > 1]
        if missing:
            notes.append(
                f"the NIfTI header has no size of the voxels along {', '.join('ijk'[axis] for axis in missing)} "
                f"({', '.join(f'{sizes[axis]:g}' for axis in missing)}): "
                f"{', '.join(f'{np.linalg.norm(matrix[:3, axis]):g}' for axis in missing)} mm is assumed"
            )
    scale = {1: 1e3, 3: 1e-3}.get(int(image.header["xyzt_units"]) & 7, 1.0)  # metre, micrometre
    if scale != 1.0:
        notes.append(f"the NIfTI header's unit is not millimetres; the geometry was multiplied by {scale:g}")
        matrix[:3] *= scale
    return repaired(matrix, (*image.shape, 1, 1, 1)[2::-1], notes)


def _forms(image, notes: list[str]) -> dict[str, np.ndarray]:
    """The orientations that the header gives and that can be used, "sform" and "qform"."""
    import nibabel as nib

    given = [name for name in ("sform", "qform") if int(image.header[f"{name}_code"])]
    forms = {}
    for name in given:
        try:
            matrix = np.array(getattr(image.header, f"get_{name}")(), dtype=np.float64)
        except (nib.spatialimages.HeaderDataError, ValueError):
            continue
        used = [axis for axis in range(3) if image.shape[axis : axis + 1] != (1,)]
        if np.isfinite(matrix).all() and np.linalg.norm(matrix[:3, used], axis=0).all():
            forms[name] = matrix
    if given and not forms:
        raise InputError(f"the NIfTI header's {' and '.join(given)} cannot be used; repair its orientation")
    if len(forms) < len(given):
        (used,) = forms
        other = "qform" if used == "sform" else "sform"
        notes.append(f"the {other} of the NIfTI header is damaged; the {used} is used")
    return forms


def _as_itk_takes_it(forms: dict[str, np.ndarray], code: int, shape: tuple[int, ...], notes: list[str]) -> str:
    """Of two orientations that differ ITK 5.4, and so 3D Slicer, takes the sform only if it is the scanner's and upright."""
    sform, qform = forms["sform"], forms["qform"]
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(shape[:3]) - 1)
    apart = np.linalg.norm(corners @ (sform - qform)[:3, :3].T + (sform - qform)[:3, 3], axis=1).max()
    edges = np.linalg.norm(sform[:3, :3], axis=0)
    if not apart > _SAME_FORM * edges.min():
        return "sform"
    axes = sform[:3, :3] / np.maximum(edges, 1e-300)
    upright = np.abs(axes.T @ axes - np.eye(3)).max() < _UPRIGHT
    taken, other = ("sform", "qform") if code == 1 and upright else ("qform", "sform")
    turn = _turn_degrees(sform, qform)
    notes.append(
        f"sform and qform of the NIfTI header differ by up to {apart:.3g} mm{turn}: the {taken} is used, as ITK and 3D Slicer "
        f"do, the {other} is not"
    )
    return taken


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
    _note_scale(image, notes)
    shape = image.shape[:3]
    array = nifti_array(image, check_size(shape, dtype, max_bytes), path, index if count > 1 else None)
    return Volume(array.reshape(shape[::-1]), matrix, name=title(path), notes=tuple(notes))


def _note_scale(image, notes: list[str]) -> None:
    """A scale that is not used; 0 with no intercept is the standard's way to say that there is none."""
    slope, intercept = (float(image.extra["written"][name]) for name in ("scl_slope", "scl_inter"))
    if not (math.isfinite(slope) and math.isfinite(intercept)) or (slope == 0 and intercept != 0):
        notes.append(
            f"the scale of the NIfTI header (slope {slope:g}, intercept {intercept:g}) is not used; the values are as stored"
        )


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
    """The voxels, slowest axis first; of a file that is not packed and has no scale the file itself, read-only and mapped.

    Scaled integers up to 16 bits become float32, others float64.
    """
    path = nifti_files(path)[1]
    packed = path.suffix.lower() == ".gz"
    if size > path.stat().st_size * (MAX_DEFLATE_RATIO if packed else 1):
        raise InputError(IS_TRUNCATED)
    dtype = image.get_data_dtype()
    shape = image.shape[::-1] if index is None else image.shape[2::-1]
    skip = int(image.dataobj.offset) + (0 if index is None else index * size)
    scale = (image.dataobj.slope, image.dataobj.inter)  # nibabel blanks the header's own after loading
    try:
        stored = read_voxels(path, 0, shape, dtype, "gzip" if packed else "raw", skip=skip)
    except (ValueError, OverflowError) as error:  # an offset beyond any file
        raise InputError(f"{IS_TRUNCATED} ({error})") from error
    if dtype.names or scale == (1.0, 0.0):  # colours have no scale
        return stored.astype(dtype.newbyteorder("="), copy=False)
    narrow = np.float32 if dtype.itemsize <= 2 or dtype == np.float32 else np.float64
    array = np.empty(stored.shape, narrow)
    planes = (values.reshape(-1, *stored.shape[-2:]) for values in (array, stored))
    for scaled, plane in zip(*planes):
        scaled[...] = plane * np.float64(scale[0]) + np.float64(scale[1])
    return array
