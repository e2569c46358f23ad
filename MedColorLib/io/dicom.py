"""DICOM in: the slices of one series, found by a pass over the headers alone, as a `Volume`.

Reasons for everything that was decided or left out go into `Volume.notes`. Neither notes, names nor messages carry a
patient's or study's data, and no file names (scanners put names of people into them): a slice is called by its number.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume
from .voxel_data import LPS_TO_RAS, check_size, has_temporary_room, natural_key, temporarily_mapped

DICOM_ENDINGS = (".dcm", ".dicom", ".ima")
_SAME_DIRECTION = 1e-3  # distance of the direction cosines; headers round them to about 1e-6
_SAME_SPACING = 1e-3  # relative
_GAP = 1.5  # a step of more than this many median steps lacks a slice
IN_MEMORY = 1 << 30  # bytes of voxels; a series of more is decoded into a temporary file
_UNEVEN = 0.01  # relative deviation of a step that is worth a note


@dataclass(frozen=True)
class _Slice:
    """What the header of one file says."""

    path: Path
    series: str  # SeriesInstanceUID
    label: str
    size: tuple[int, int, int]  # columns, rows, frames
    dtype: np.dtype | None  # as decoded, rescale applied; None: colour
    spacing_mm: tuple[float, float, float]  # along i, j; thickness along k
    axes: tuple[float, ...]  # direction cosines of i, then of j
    position_mm: tuple[float, ...]  # of the first pixel, LPS; empty: not given
    instance: float
    window: tuple[float, float] | None
    window_count: int
    inverted: bool  # MONOCHROME1
    bits: float  # per stored number
    ijk_to_ras: np.ndarray  # of this file alone


@contextmanager
def _quiet_itk() -> Iterator[None]:
    """Keep ITK's warnings off stderr: what matters of them is checked here and noted."""
    import SimpleITK as sitk

    shown = sitk.ProcessObject.GetGlobalWarningDisplay()
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        yield
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(shown)


def _dtype(pixel_id: int) -> np.dtype | None:
    """The numpy type of an ITK pixel type; None for vectors, complex numbers and labels."""
    import SimpleITK as sitk

    scalars = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Float32", "Float64")
    return {getattr(sitk, f"sitk{name}"): np.dtype(name.lower()) for name in scalars}.get(pixel_id)


def _matrix(image) -> np.ndarray:
    """(4, 4) IJK to RAS of a three-dimensional ITK image, or of a reader that has read a header."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    matrix[:3, 3] = image.GetOrigin()
    return LPS_TO_RAS @ matrix + 0.0  # + 0.0 turns -0.0 into 0.0


def is_dicom(path: Path) -> bool:
    """True for a file that is DICOM by its ending or its first bytes."""
    if path.suffix.lower() in DICOM_ENDINGS:
        return True
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def read_dicom(files: Sequence[Path], max_bytes: int, wanted: Path | None = None) -> Volume:
    """Read the largest scalar series among `files`, or the series of the file `wanted`.

    Files of one series count as separate sets where orientation, size or pixel spacing differ. Positions along the
    normal order the slices; rescale slope and intercept are applied (CT: HU) in the smallest type that GDCM gives.

    Raises:
        InputError: no readable image, only colour images, or more than `max_bytes` of voxels.
    """
    notes: list[str] = []
    with _quiet_itk():
        headers = [header for header in map(_header, sorted(files, key=natural_key)) if header]
        if len(headers) < len(files):
            notes.append(f"{len(files) - len(headers)} DICOM files without a readable image were left out")
        chosen = _largest(headers, wanted, notes)
        slices, ijk_to_ras = _placed(chosen, notes)
        array = _pixels(slices, max_bytes, notes)
    if slices[0].inverted:
        notes.append("MONOCHROME1: larger values are meant to look darker; the values are kept as they are")
    return Volume(array, ijk_to_ras, _window(slices, notes), slices[0].label, tuple(notes))


def _header(path: Path) -> _Slice | None:
    """The header of an image, or None for other objects and damaged files."""
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError:
        return None
    if reader.GetDimension() != 3:
        return None

    def text(tag: str) -> str:
        return reader.GetMetaData(tag).strip(" \0") if reader.HasMetaDataKey(tag) else ""

    def numbers(tag: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text(tag).split("\\"))
        except ValueError:
            return ()
        return values if all(map(math.isfinite, values)) else ()

    direction = np.reshape(reader.GetDirection(), (3, 3))
    spacing = numbers("0028|0030")[::-1]  # the header has the distance of rows first
    axes, position = numbers("0020|0037"), numbers("0020|0032")
    centers, widths = numbers("0028|1050"), numbers("0028|1051")
    return _Slice(
        path,
        text("0020|000e"),
        f"{text('0008|0060') or 'DICOM'} series {text('0020|0011')}".rstrip(),
        reader.GetSize(),
        _dtype(reader.GetPixelIDValue()),
        (*(spacing if len(spacing) == 2 and min(spacing) > 0 else reader.GetSpacing()[:2]), reader.GetSpacing()[2]),
        axes if len(axes) == 6 else (*direction[:, 0], *direction[:, 1]),
        position if len(position) == 3 else (),
        (numbers("0020|0013") or (0.0,))[0],
        _first_window(centers, widths),
        len(centers),
        text("0028|0004") == "MONOCHROME1",
        (numbers("0028|0100") or (16.0,))[0],
        _matrix(reader),
    )


def _first_window(centers: tuple[float, ...], widths: tuple[float, ...]) -> tuple[float, float] | None:
    if not centers or not widths or widths[0] <= 0:
        return None
    return centers[0] - widths[0] / 2, centers[0] + widths[0] / 2


def _same_grid(a: _Slice, b: _Slice) -> bool:
    closest = min(*a.spacing_mm[:2], *b.spacing_mm[:2])
    return (
        math.dist(a.axes, b.axes) < _SAME_DIRECTION
        and math.dist(a.spacing_mm[:2], b.spacing_mm[:2]) <= _SAME_SPACING * closest
    )


def _grouped(headers: Sequence[_Slice]) -> list[list[_Slice]]:
    """Sets of slices that can be stacked. A multi-frame file is a set of its own."""
    groups: dict[tuple, list[list[_Slice]]] = {}
    for header in headers:
        alone = header.path if header.size[2] > 1 else None
        sets = groups.setdefault((header.series, header.size, header.dtype is None, alone), [])
        for members in sets:
            if _same_grid(members[0], header):
                members.append(header)
                break
        else:
            sets.append([header])
    return [members for sets in groups.values() for members in sets]


def _largest(headers: list[_Slice], wanted: Path | None, notes: list[str]) -> list[_Slice]:
    groups = _grouped(headers)
    if wanted is not None:
        groups = [members for members in groups if any(member.path == wanted for member in members)]
    if not groups:
        raise InputError("no readable DICOM image; export the series again (reports are no images)")
    scalar = [members for members in groups if members[0].dtype is not None]
    if not scalar:
        raise InputError("the DICOM images are in colour; a colour image can only be a reference, give a scalar series")
    chosen = max(scalar, key=lambda members: (len(members) * members[0].size[2], math.prod(members[0].size)))
    series = {header.series for header in headers}
    if len(series) > 1:
        why = "the largest" if wanted is None else "the one of the given file"
        slices = len(chosen) * chosen[0].size[2]
        notes.append(f"{chosen[0].label} with {slices} slices was picked, {why} of {len(series)} series")
    others = sum(header.series == chosen[0].series for header in headers) - len(chosen)
    if others:
        notes.append(f"{others} images of the series were left out: another orientation, size, pixel spacing or colour")
    return chosen


def _placed(members: list[_Slice], notes: list[str]) -> tuple[list[_Slice], np.ndarray]:
    """The slices in order along the normal, duplicates dropped, and the (4, 4) IJK-to-RAS matrix."""
    if members[0].size[2] > 1:
        notes.append("a multi-frame file: the frames are taken to be equidistant, as its header says")
        return members, members[0].ijk_to_ras
    if not all(member.position_mm for member in members):
        notes.append("slices without a position: ordered by their number, distance from the slice thickness")
        members = sorted(members, key=lambda member: member.instance)
        return members, members[0].ijk_to_ras
    first = members[0]
    axes = np.reshape(first.axes, (2, 3))
    normal = np.cross(*axes)
    normal /= np.linalg.norm(normal) or 1.0
    tolerance = 0.01 * min(first.spacing_mm[:2])
    heights = {id(member): float(np.dot(member.position_mm, normal)) for member in members}
    members = sorted(members, key=lambda m: (round(heights[id(m)] / tolerance), m.instance))
    kept = members[:1]
    for member in members[1:]:
        if heights[id(member)] - heights[id(kept[-1])] > tolerance:
            kept.append(member)
    if len(kept) < len(members):
        notes.append(
            f"{len(members) - len(kept)} slices at a position already taken were left out (the lowest number was kept)"
        )
    height = np.array([heights[id(member)] for member in kept])
    positions = np.array([member.position_mm for member in kept])
    matrix = np.eye(4)
    matrix[:3, :2] = axes.T * first.spacing_mm[:2]
    matrix[:3, 2] = _step(height, positions, normal, first, notes)
    matrix[:3, 3] = positions[0]
    return kept, LPS_TO_RAS @ matrix + 0.0


def _step(height: np.ndarray, positions: np.ndarray, normal: np.ndarray, first: _Slice, notes: list[str]) -> np.ndarray:
    """(3,) vector from slice to slice in LPS millimetres. Not along the normal where the gantry was tilted."""
    if len(height) == 1:
        return normal * (first.spacing_mm[2] or 1.0)
    steps = np.diff(height)
    median = float(np.median(steps))
    gaps = np.flatnonzero(steps > _GAP * median)
    if len(gaps):
        shown = ", ".join(f"{steps[n]:.4g} mm after {height[n]:.4g} mm" for n in gaps[:5]) + ", ..." * (len(gaps) > 5)
        notes.append(
            f"{len(gaps)} gaps between slices, where {median:.4g} mm is usual: {shown}; "
            "what lies beyond a gap is drawn too close"
        )
    even = steps[steps <= _GAP * median]
    if np.ptp(even) > _UNEVEN * median:
        notes.append(f"slices {even.min():.4g} to {even.max():.4g} mm apart; the median of {median:.4g} mm is used")
    uniform = not len(gaps) and np.ptp(even) <= _UNEVEN * median
    per_mm = (positions[-1] - positions[0]) / (height[-1] - height[0])
    tilt = math.degrees(math.acos(min(1.0, 1.0 / float(np.linalg.norm(per_mm)))))
    if tilt > 0.1:
        notes.append(f"gantry tilt of {tilt:.1f} degrees; the sheared geometry is kept")
    off_line = np.linalg.norm(positions - positions[0] - np.outer(height - height[0], per_mm), axis=1).max()
    if off_line > 0.5 * min(first.spacing_mm[:2]):
        notes.append(f"slices are shifted sideways by up to {off_line:.3g} mm; this is not corrected")
    # Even steps: end to end, so that the rounding of single positions does not add up over the stack.
    return per_mm * (float(height[-1] - height[0]) / (len(height) - 1) if uniform else median)


def _pixels(slices: list[_Slice], max_bytes: int, notes: list[str]) -> np.ndarray:
    """The voxels, in memory, or, where they are many and the disk has room, in a temporary file that is mapped."""
    columns, rows, frames = slices[0].size
    dtype = np.result_type(*(member.dtype for member in slices))  # rescale may differ from slice to slice (PET)
    if dtype == np.float64 and all(member.bits <= 16 for member in slices):
        dtype = np.dtype(np.float32)  # holds scaled 16-bit numbers to 6e-8
    shape = (len(slices) * frames, rows, columns)
    if check_size(shape, dtype, max_bytes) > IN_MEMORY and has_temporary_room(shape, dtype):
        notes.append(
            f"more than {IN_MEMORY / 2**30:g} GiB: the decoded slices are in a nameless temporary file, not in memory"
        )
        return temporarily_mapped((plane for decoded in _decoded(slices) for plane in decoded), shape, dtype)
    array = np.empty(shape, dtype)
    for number, decoded in enumerate(_decoded(slices)):
        array[number * frames : (number + 1) * frames] = decoded
    return array


def _decoded(slices: list[_Slice]) -> Iterator[np.ndarray]:
    """(frames, rows, columns) of one file after the other."""
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    for member in slices:
        reader.SetFileName(str(member.path))
        try:
            decoded = sitk.GetArrayFromImage(reader.Execute())
        except RuntimeError as error:
            raise InputError(f"DICOM slice {member.instance:g} cannot be decoded; export the series again") from error
        if decoded.shape[::-1] != tuple(member.size):
            raise InputError(f"DICOM slice {member.instance:g} is not as large as its header says; export it again")
        yield decoded


def _window(slices: list[_Slice], notes: list[str]) -> tuple[float, float] | None:
    windows = [member.window for member in slices if member.window]
    if not windows:
        return None
    if any(member.window_count > 1 for member in slices):
        notes.append("several windows in the header; the first is used")
    if len(set(windows)) > 1:
        notes.append("the window differs from slice to slice; the median is used")
    low, high = np.median(windows, axis=0)
    return float(low), float(high)
