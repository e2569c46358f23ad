"""Stage *volume in / volume out*: files and folders to `Volume`, `ColorVolume` to files that Slicer opens.

Geometry is kept: NRRD numbers as they are written, NIfTI as sform or qform give it, DICOM positions and directions.
What a reader had to decide is in `Volume.notes`.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import InputError, OutputError
from ..output import COLOR_ENDINGS, atomic_output, check_output_path
from ..volume import ColorVolume, Volume
from .choice import Choice, chosen_note, time_points
from .dicom import DICOM_ENDINGS, dicom_choices, is_dicom, read_dicom, read_dicom_points
from .folders import FolderContents, files_below, files_in, look_into
from .metaimage import meta_choices, meta_fields, read_meta_image
from .nifti import (
    NIFTI_ENDINGS,
    load_nifti,
    nifti_array,
    nifti_choices,
    nifti_files,
    nifti_matrix,
    read_nifti,
)
from .nrrd import nrrd_array, nrrd_axes, nrrd_choices, nrrd_header, nrrd_matrix, read_nrrd
from .pictures import folder_choices, read_picture_folder, read_tiff, tiff_choices
from .voxel_data import IS_FLAT, LPS_TO_RAS, check_size, data_file, title

MAX_BYTES = 16 * 2**30
_RGB24 = np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")])
_NIFTI_MAX = 32767
_ORTHONORMAL = 1e-6  # largest cosine between axes that a NIfTI qform may drop


def read_volume(
    path: str | os.PathLike, *, max_bytes: int = MAX_BYTES, volume: int | None = None, below: bool = True
) -> Volume:
    """Read a scalar volume in its own type and geometry.

    Args:
        path: NRRD (.nrrd, .nhdr), MetaImage (.mha, .mhd), NIfTI (.nii, .nii.gz, .hdr with .img), multi-page TIFF, a DICOM
            folder (its largest volume, of one series, contrast, acquisition and time point), one DICOM file (the volume of
            that file in its folder), or a folder of PNG or TIFF slices.
        max_bytes: refuse more voxels than this before taking memory for them.
        volume: where there are several, the number of one of them, as `list_volumes` counts, from 1 on.
        below: of a DICOM folder, whether to look into the folders in it.

    Returns:
        `Volume`, (k, j, i), DICOM and NIfTI rescale applied. The array is native and in memory, or, of an uncompressed
        NRRD, MetaImage or NIfTI, the file itself: read-only, mapped, in the file's byte order (NIfTI: where that is the
        machine's; see `voxel_data.read_voxels`).

    Raises:
        InputError: missing, unreadable, truncated, not an image, colour, not three-dimensional, too large, or no such
            volume.
        MissingPackageError: the format needs a package that is not here.
    """
    with _input_errors(path) as source:
        if not source.is_dir():
            return _reader(source)(source, max_bytes, volume)
        found = _look_into(source, below)
        read = read_dicom if found.kind == "dicom" else read_picture_folder
        read_one = read(found.files, max_bytes, number=volume)
        return replace(read_one, notes=(*found.notes, *read_one.notes)) if found.notes else read_one


def read_time_points(path: str | os.PathLike, *, max_bytes: int = MAX_BYTES, volume: int | None = None) -> list[Volume]:
    """Read all time points of a series, in the order of time; see `pipeline.colorize_time_points`.

    Args:
        path, max_bytes: as for `read_volume`; the bytes are those of all together.
        volume: the number of one of them, where there are several series.

    Raises:
        InputError: as `read_volume`, and where there is but one time point.
    """
    with _input_errors(path) as source:
        if source.is_dir():
            found = _look_into(source)
            if found.kind == "dicom":
                points = read_dicom_points(found.files, max_bytes, number=volume)
                return [replace(point, notes=(*found.notes, *point.notes)) for point in points]
        elif _reader(source) is _read_single_dicom:
            return read_dicom_points(_dicom_beside(source), max_bytes, source, volume)
    choices, _ = list_volumes(path)
    with _input_errors(path):
        numbers = time_points(choices, volume)
    points = []
    for number in numbers:
        one = read_volume(path, max_bytes=max_bytes - sum(point.array.nbytes for point in points), volume=number)
        left_out = chosen_note(choices, number - 1, number)  # which is not so here
        points.append(replace(one, notes=tuple(note for note in one.notes if note not in left_out)))
    return points


def list_volumes(path: str | os.PathLike) -> tuple[list[Choice], tuple[str, ...]]:
    """The volumes of a file or folder in the order in which `read_volume` counts, and notes on what is none.

    Raises:
        InputError: as `read_volume`.
    """
    with _input_errors(path) as source:
        if source.is_dir():
            found = _look_into(source)
            if found.kind == "pictures":
                return folder_choices(found.files), found.notes
            choices, notes = dicom_choices(found.files)
            return choices, (*found.notes, *notes)
        reader = _reader(source)
        if reader is _read_single_dicom:
            choices, notes = dicom_choices(_dicom_beside(source), source)
            return choices, tuple(notes)
        if reader in _CHOICES:
            return _CHOICES[reader](source), ()
        volume = reader(source, MAX_BYTES, None)
        return [Choice(volume.name, volume.array.shape[::-1], tuple(volume.spacing_mm.tolist()))], volume.notes


def read_color_volume(path: str | os.PathLike, *, max_bytes: int = MAX_BYTES) -> ColorVolume:
    """Read what `write_color_volume` writes: an RGB NRRD (colour axis first) or an RGB24 NIfTI.

    Raises:
        InputError: missing, unreadable, or not such a volume.
    """
    with _input_errors(path) as source:
        ending = _ending(source, (*COLOR_ENDINGS, ".nhdr"))
        if ending in (".nrrd", ".nhdr"):
            return _read_color_nrrd(source, max_bytes)
        if ending in (".nii", ".nii.gz"):
            return _read_color_nifti(source, max_bytes)
        raise InputError(f"not a colour volume; the endings are {', '.join(COLOR_ENDINGS)}")


def write_color_volume(volume: ColorVolume, path: str | os.PathLike) -> None:
    """Write an RGB volume that Slicer opens as a vector volume; `ColorVolume.report` is the caller's to write.

    `.nrrd` keeps the geometry to the last bit. `.nii` and `.nii.gz` hold it as float32 (sform; qform as well where the
    axes are orthogonal). An unfinished file never bears the final name.

    Raises:
        OutputError: unknown ending, folder missing or read-only, disk full.
    """
    _write(volume.rgb, volume.ijk_to_ras, Path(path))


def write_confidence(volume: ColorVolume, path: str | os.PathLike) -> None:
    """Write the confidence of a coloured volume, per cent as 8-bit scalars on the same grid; endings and errors as there.

    Raises:
        OutputError: as `write_color_volume`.
        InputError: the volume has none; colour it with `Settings(confidence=True)`.
    """
    if volume.confidence is None:
        raise InputError(f"{volume.name}: holds no confidence; colour it with Settings(confidence=True)")
    _write(volume.confidence, volume.ijk_to_ras, Path(path))


def _write(array: np.ndarray, ijk_to_ras: np.ndarray, path: Path) -> None:
    write = _write_nrrd if check_output_path(path) == ".nrrd" else _write_nifti
    if write is _write_nifti and max(array.shape) > _NIFTI_MAX:
        raise OutputError(f"{path}: NIfTI holds at most {_NIFTI_MAX} voxels along an axis; write .nrrd")
    with atomic_output(path) as temporary:
        write(array, ijk_to_ras, temporary)


def file_sha256(path: str | os.PathLike) -> str:
    """SHA-256 (hex) of a file; of a folder: over the SHA-256 of its files in the order of their names.

    Raises:
        InputError: missing or unreadable.
    """
    with _input_errors(path) as source:
        if not source.is_dir():
            return _digest(source).hex()
        total = hashlib.sha256()
        for file in sorted(files_below(source), key=lambda file: file.relative_to(source).as_posix()):
            total.update(_digest(file))
        return total.hexdigest()


def input_sha256(path: str | os.PathLike) -> str:
    """SHA-256 (hex) over the files that one volume is read from, in the order of their names.

    These are a file and the data file that its header names, or the files of a folder without the folders in it.

    Raises:
        InputError: missing, unreadable, or a header without its data.
    """
    with _input_errors(path) as source:
        files = sorted(files_in(source)) if source.is_dir() else [source, *_detached(source)]
        return hashlib.sha256(b"".join(_digest(file) for file in files)).hexdigest()


def _detached(path: Path) -> list[Path]:
    """The data file of a header, if it has one, or the other file of a pair."""
    name = None
    if _ending(path, NIFTI_ENDINGS):
        if _is_dicom_by_another_name(path):
            return []
        return sorted({*nifti_files(path)} - {path})
    if _ending(path, (".nrrd", ".nhdr")):
        name = nrrd_header(path).get("data file")
    elif _ending(path, (".mha", ".mhd")):
        name = meta_fields(path)[0]["ElementDataFile"]
    return [] if name is None or name.upper() == "LOCAL" else [data_file(path, name)]


def _digest(file: Path) -> bytes:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while chunk := stream.read(1 << 20):
            digest.update(chunk)
    return digest.digest()


@contextmanager
def _input_errors(path: str | os.PathLike) -> Iterator[Path]:
    """Puts the path before every reason, and turns the system's refusals into reasons."""
    if not os.fspath(path):
        raise InputError("the name of the input is empty; name a file or a folder")
    path = Path(path)
    try:
        if not path.exists():
            raise InputError("does not exist; check the spelling")
        if not (path.is_file() or path.is_dir()):
            raise InputError("neither a file nor a folder")  # a pipe would be waited for
        with np.errstate(all="ignore"):  # numbers of damaged headers overflow; `Volume` refuses what comes of it
            yield _medium(path)
    except InputError as error:
        raise InputError(f"{path}: {' '.join(str(error).split())}") from error  # libraries break lines
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except MemoryError as error:
        raise InputError(f"{path}: more than the free memory of this machine; crop or resample the volume") from error


def _ending(path: Path, endings: Iterable[str]) -> str | None:
    return next((ending for ending in endings if path.name.lower().endswith(ending)), None)


def _medium(path: Path) -> Path:
    """The folder of a DICOM medium where its directory file is given: that holds no image itself."""
    return path.parent if path.name.upper() == "DICOMDIR" and path.is_file() else path


def _dicom_beside(path: Path) -> list[Path]:
    return [file for file in files_in(path.parent) if is_dicom(file)]


def _read_single_dicom(path: Path, max_bytes: int, number: int | None) -> Volume:
    return read_dicom(_dicom_beside(path), max_bytes, wanted=path, number=number)


def _refuse_picture(path: Path, max_bytes: int, number: int | None) -> Volume:
    raise InputError(IS_FLAT)


_READERS: dict[str, Callable[[Path, int, int | None], Volume]] = {
    **dict.fromkeys((".nrrd", ".nhdr"), read_nrrd),
    **dict.fromkeys((".mha", ".mhd"), read_meta_image),
    **dict.fromkeys(NIFTI_ENDINGS, read_nifti),
    **dict.fromkeys((".tif", ".tiff"), read_tiff),
    **dict.fromkeys(DICOM_ENDINGS, _read_single_dicom),
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".bmp"), _refuse_picture),
}
_CHOICES = {read_nrrd: nrrd_choices, read_meta_image: meta_choices, read_nifti: nifti_choices, read_tiff: tiff_choices}


def _reader(path: Path) -> Callable[[Path, int, int | None], Volume]:
    if not path.stat().st_size:
        raise InputError("the file is empty; copy or export it again")
    ending = _ending(path, _READERS)
    if ending in NIFTI_ENDINGS and _is_dicom_by_another_name(path):
        return _read_single_dicom
    if ending:
        return _READERS[ending]
    if is_dicom(path):
        return _read_single_dicom
    raise InputError(
        f"not a known image file; save it as NRRD or NIfTI (known endings: {', '.join(_READERS)}), or give a folder of slices"
    )


def _is_dicom_by_another_name(path: Path) -> bool:
    """DICOM that is named .img or .hdr, as some scanners do. Of a pair the header tells: voxels may begin as DICOM does."""
    try:
        return is_dicom(nifti_files(path)[0])
    except InputError:  # it has no other half
        return is_dicom(path)


def _look_into(folder: Path, below: bool = True) -> FolderContents:
    try:
        return look_into(folder, below)
    except InputError as error:
        hint = "; give one of its files" if any(_ending(file, _READERS) for file in files_in(folder)) else ""
        raise InputError(f"{error}{hint}") from error


def _read_color_nrrd(path: Path, max_bytes: int) -> ColorVolume:
    header = nrrd_header(path)
    spatial, other = nrrd_axes(header)
    if other != [0] or len(spatial) != 3 or header["sizes"][0] != 3:
        sizes = " x ".join(map(str, header["sizes"]))
        raise InputError(f"not an RGB volume: expected 3 x i x j x k with the colour axis first, got {sizes}")
    array = nrrd_array(path, header, max_bytes)
    return ColorVolume(array, nrrd_matrix(header, spatial, []), name=title(path))


def _read_color_nifti(path: Path, max_bytes: int) -> ColorVolume:
    image = load_nifti(path)
    if image.get_data_dtype() != _RGB24 or len(image.shape) != 3:
        raise InputError(f"not an RGB24 volume: got {image.get_data_dtype()} of shape {image.shape}")
    array = nifti_array(image, check_size(image.shape, _RGB24, max_bytes), path)
    rgb = np.ascontiguousarray(array).view(np.uint8).reshape(*array.shape, 3)
    return ColorVolume(rgb, nifti_matrix(image, []), name=title(path))


class _Uncopied(np.ndarray):
    """pynrrd packs pieces of `tobytes()`, which would be a copy of the whole volume; a look at it will do."""

    def tobytes(self, order: str = "C") -> memoryview:
        return np.ascontiguousarray(self).data.cast("B")


def _write_nrrd(array: np.ndarray, ijk_to_ras: np.ndarray, path: Path) -> None:
    """(k, j, i) scalars or (k, j, i, 3) RGB, uint8."""
    import nrrd

    lps = LPS_TO_RAS @ ijk_to_ras + 0.0  # + 0.0 turns -0.0 into 0.0
    colors = array.ndim - 3
    header = {
        "space": "left-posterior-superior",
        "kinds": ["RGB-color"] * colors + ["domain"] * 3,
        "space directions": np.vstack([np.full((colors, 3), np.nan), lps[:3, :3].T]),
        "space origin": lps[:3, 3],
        "encoding": "gzip",
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # pynrrd's way to ask for the time, from Python 3.12 on
        nrrd.write(str(path), array.view(_Uncopied), header, compression_level=3, index_order="C")
    _blank_time(path)


def _blank_time(path: Path) -> None:
    """Overwrite pynrrd's comment with the time of writing, so that equal volumes make equal files."""
    with path.open("r+b") as file:
        while (line := file.readline(1024)).startswith((b"NRRD", b"#")):
            if line.startswith(b"# on "):
                file.seek(-len(line), os.SEEK_CUR)
                file.write(b"#".ljust(len(line) - 1) + b"\n")
                file.seek(0, os.SEEK_CUR)  # between writing and reading


def _write_nifti(array: np.ndarray, ijk_to_ras: np.ndarray, path: Path) -> None:
    """(k, j, i) scalars or (k, j, i, 3) RGB, uint8."""
    import nibabel as nib

    data = array.T if array.ndim == 3 else np.ascontiguousarray(array).view(_RGB24)[..., 0].T
    image = nib.Nifti1Image(data, ijk_to_ras)
    image.header.set_xyzt_units("mm")
    image.set_sform(ijk_to_ras, code=1)
    axes = ijk_to_ras[:3, :3] / np.linalg.norm(ijk_to_ras[:3, :3], axis=0)
    if np.abs(axes.T @ axes - np.eye(3)).max() < _ORTHONORMAL:
        image.set_qform(ijk_to_ras, code=1)
    with path.open("wb") as file:  # nib.save would leave the file open when the disk is full
        if path.suffix.lower() != ".gz":
            image.to_stream(file)
        else:
            with gzip.GzipFile("", "wb", compresslevel=3, fileobj=file, mtime=0) as packed:
                image.to_stream(packed)
