"""DICOM in: one volume of one contrast, acquisition and time point out of the files of a folder, as a `Volume`.

`dicom_file` opens files, `dicom_header` reads what they say (pydicom), `dicom_volumes` finds the volumes among them,
`dicom_grid` lays the slices where their positions are, `dicom_pixels` decodes. `dcm2niix` was tried instead: it stacks two
acquisitions of one series in each other without a word, does not tell of gaps, and knows no mosaic without Siemens' private
header.

Reasons for everything that was decided or left out go into `Volume.notes`. Neither notes, names nor messages carry a
patient's or study's data, and no file names (scanners put names of people into them): a slice is called by its number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume
from .choice import Choice, chosen_note, pick, time_points
from .dicom_file import DICOM_ENDINGS, is_dicom, quiet_pydicom
from .dicom_grid import Grid, grid_of, resampled
from .dicom_header import Frame, read_frames
from .dicom_pixels import value_type, values
from .dicom_volumes import Stack, find_stacks
from .voxel_data import check_size, has_temporary_room, natural_key, temporarily_mapped

__all__ = ["DICOM_ENDINGS", "IN_MEMORY", "dicom_choices", "is_dicom", "read_dicom", "read_dicom_points"]
IN_MEMORY = 1 << 30  # bytes of voxels; a series of more is decoded into a temporary file


def read_dicom(files: Sequence[Path], max_bytes: int, wanted: Path | None = None, number: int | None = None) -> Volume:
    """Read one scalar volume out of `files`: the largest, or that of the file `wanted`, or that of `number`.

    Positions along the normal order the slices; what does not lie on a regular upright grid is resampled to one. Rescale
    slope and intercept are applied (CT: HU), of every frame its own.

    Args:
        number: as `dicom_choices` counts, from 1 on.

    Raises:
        InputError: no readable image, only colour images, no such volume, a volume whose slices cannot be told from
            others, or more than `max_bytes` of voxels.
    """
    with quiet_pydicom():
        stacks, notes = _found(files, wanted)
        choices = [_choice(stack) for stack in stacks]
        index = pick(choices, number)
        notes += chosen_note(choices, index, number)
        return _volume(stacks[index], max_bytes, notes)


def read_dicom_points(
    files: Sequence[Path], max_bytes: int, wanted: Path | None = None, number: int | None = None
) -> list[Volume]:
    """Read all time points of a series: of the largest volume, that of the file `wanted`, or that of `number`.

    The headers are read once. Args and errors as for `read_dicom`; `max_bytes` of all together, and InputError, too, where
    there is but one time point.
    """
    with quiet_pydicom():
        stacks, notes = _found(files, None)
        own = [s for s in stacks if wanted is None or any(frame.path == wanted for frame in s.frames)]
        chosen = stacks.index(own[pick([_choice(stack) for stack in own], number)]) + 1
        found: list[Volume] = []
        for point in time_points([_choice(stack) for stack in stacks], chosen):
            room = max_bytes - sum(one.array.nbytes for one in found)
            found.append(_volume(stacks[point - 1], room, list(notes)))
        return found


def dicom_choices(files: Sequence[Path], wanted: Path | None = None) -> tuple[list[Choice], list[str]]:
    """What there is to choose from, in the order in which `read_dicom` counts, and notes on what is left out."""
    with quiet_pydicom():
        stacks, notes = _found(files, wanted)
        return [_choice(stack) for stack in stacks], notes


def _found(files: Sequence[Path], wanted: Path | None) -> tuple[list[Stack], list[str]]:
    """The scalar volumes, the largest first."""
    frames: list[Frame] = []
    unread = 0
    for file in sorted(files, key=natural_key):
        found = read_frames(file)
        frames += found
        unread += not found
    notes = [f"{unread} DICOM files without a readable image were left out"] if unread else []
    stacks = find_stacks(frames)
    if wanted is not None:
        stacks = [stack for stack in stacks if any(frame.path == wanted for frame in stack.frames)]
    if not stacks:
        raise InputError(
            "no readable DICOM image (reports are none, nor are files that are cut short); export the series again"
        )
    scalar = [stack for stack in stacks if stack.frames[0].pixels is not None]
    if not scalar:
        raise InputError("the DICOM images are in colour; a colour image can only be a reference, give a scalar series")
    colored = sum(len(stack.frames) for stack in stacks) - sum(len(stack.frames) for stack in scalar)
    if colored:
        notes.append(f"{colored} colour images were left out")
    return scalar, notes


def _choice(stack: Stack) -> Choice:
    try:
        grid = grid_of(stack.frames)
    except InputError:
        return Choice(stack.label, stack.size, series=stack.series)
    spacing = tuple(np.linalg.norm(grid.ijk_to_ras[:3, :3], axis=0).tolist())
    return Choice(stack.label, grid.shape[::-1], spacing, stack.series)


def _volume(stack: Stack, max_bytes: int, notes: list[str]) -> Volume:
    notes += stack.notes
    frames = _alike_in_scale(stack.frames, notes)
    if stack.untold:
        raise InputError(
            "several images lie at each place and nothing in their headers tells them apart; export the series again, or "
            "put the files of one volume into a folder of their own"
        )
    if frames[0].tiles == 0:
        raise InputError(
            "slices as tiles of one picture (a Siemens mosaic), and the header does not say how many; convert it with dcm2niix"
        )
    if frames[0].tiles > 1:
        notes.append(f"a Siemens mosaic: {len(frames)} slices were cut out of one picture")
    grid = grid_of(frames)
    notes += grid.notes
    array = _pixels(frames, grid, max_bytes, notes)
    window = _window(frames, notes)
    return Volume(array, grid.ijk_to_ras, window, stack.label, tuple(notes))


def _pixels(frames: Sequence[Frame], grid: Grid, max_bytes: int, notes: list[str]) -> np.ndarray:
    """The voxels, in memory, or, where they are many and the disk has room, in a temporary file that is mapped."""
    dtype, said = value_type(frames), set()
    planes = _planes(frames, grid, dtype, said)
    if check_size(grid.shape, dtype, max_bytes) > IN_MEMORY and has_temporary_room(grid.shape, dtype):
        notes.append(
            f"more than {IN_MEMORY / 2**30:g} GiB: the decoded slices are in a nameless temporary file, not in memory"
        )
        array = temporarily_mapped(planes, grid.shape, dtype)
    else:
        array = np.empty(grid.shape, dtype)
        for number, plane in enumerate(planes):
            array[number] = plane
    notes += sorted(said)
    return array


def _planes(frames: Sequence[Frame], grid: Grid, dtype: np.dtype, said: set[str]) -> Iterator[np.ndarray]:
    if grid.wanted_mm is None:
        return (values(frame, dtype, said) for frame in frames)
    return resampled(grid, lambda number: values(frames[number], dtype, said), dtype)


def _alike_in_scale(frames: Sequence[Frame], notes: list[str]) -> list[Frame]:
    """Frames without a scale in a volume where all others have the same one get that."""
    if any(frame.table for frame in frames):
        notes.append("the look-up table for the values (Modality LUT) in the header is not applied; they are as stored")
    if any(frame.zero_slope for frame in frames):
        notes.append("the rescale slope of the header is 0; 1 is taken for it")
    bare = [frame for frame in frames if not frame.rescaled]
    scales = {frame.rescale for frame in frames if frame.rescaled}
    if not bare or not scales:
        return list(frames)
    said = f"{len(bare)} of {len(frames)} images have no rescale slope in their header"
    if len(scales) > 1:
        notes.append(f"{said}; their values are as stored")
        return list(frames)
    (scale,) = scales
    notes.append(f"{said}; that of the others is taken ({scale[0]:g}, intercept {scale[1]:g})")
    return [frame if frame.rescaled else replace(frame, rescale=scale) for frame in frames]


def _window(frames: Sequence[Frame], notes: list[str]) -> tuple[float, float] | None:
    """The window that the header proposes, in the units of the values; turned with MONOCHROME1."""
    turned = [frame for frame in frames if frame.pixels and frame.pixels.inverted]
    if turned:
        low, high = turned[0].pixels.limits
        some = "" if len(turned) == len(frames) else f" of {len(turned)} of {len(frames)} images"
        rest = "" if any(frame.window is None for frame in frames) else ", and the window with them"
        notes.append(
            f"MONOCHROME1{some}: larger stored numbers are meant to look darker; they were turned round ({low + high} minus the "
            f"number){rest}"
        )
    windows = [_turned(frame) for frame in frames if frame.window]
    if not windows:
        return None
    if any(frame.windows > 1 for frame in frames):
        notes.append("several windows in the header; the first is used")
    if len(set(windows)) > 1:
        notes.append("the window differs from slice to slice; the median is used")
    low, high = np.median(windows, axis=0)
    return float(low), float(high)


def _turned(frame: Frame) -> tuple[float, float]:
    assert frame.window and frame.pixels
    low, high = frame.window
    if not frame.pixels.inverted:
        return low, high
    slope, intercept = frame.rescale
    both = slope * sum(frame.pixels.limits) + 2 * intercept
    return both - high, both - low
