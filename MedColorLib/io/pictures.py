"""Pictures in: a folder of PNG or TIFF slices (of BMP or JPEG, if there is nothing else), or a TIFF of many pages, as a `Volume`.

The names tell the order (`picture_names`), `tiff` reads TIFF, OpenCV reads PNG, `plain_pictures` the others. Grey saved as
colours is read as grey.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume
from .choice import Choice, chosen_note, pick
from .grey import grey_of
from .label_picture import chunk_before_pixels, has_whole_chunks
from .picture_names import NamedSeries, named_series
from .plain_pictures import PLAIN_ENDINGS, plain_size, read_plain
from .quiet import quiet_cv2
from .tiff import TIFF_STARTS, TiffStack, tiff_planes, tiff_stacks
from .tiff_spacing import PRINTERS
from .voxel_data import IS_FLAT, IS_TRUNCATED, LPS_TO_RAS, MAX_DEFLATE_RATIO, check_size, title

PICTURE_ENDINGS = (".png", ".tif", ".tiff")
TIFF_ENDINGS = (".tif", ".tiff")
_DIRECTIONS = "x to the left, y to the back, slices upwards"
_PNG_START = b"\x89PNG"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # colour type -> samples
_PNG_KINDS = {2: "RGB pictures", 3: "palette pictures", 4: "grey with transparency", 6: "RGB with transparency"}


@dataclass(frozen=True)
class _Stack:
    """One volume of a folder or file: of every file the stack of that rank."""

    files: NamedSeries
    rank: int
    label: str
    size: tuple[int, int]  # columns, rows, of the first plane
    slices: int
    spacing_mm: tuple[float | None, float | None, float | None]
    source: str
    notes: tuple[str, ...]


def read_picture_folder(files: Sequence[Path], max_bytes: int, number: int | None = None) -> Volume:
    """PNG or TIFF slices of one size and type, in the order of the numbers in their names.

    Args:
        number: of the volume, as `folder_choices` counts, where there are several series or channels.

    Raises:
        InputError: colour, damaged, of different sizes, or more than `max_bytes`.
    """
    return _read(_folder_stacks(files), files[0].parent.name, max_bytes, number)


def read_tiff(path: Path, max_bytes: int, number: int | None = None) -> Volume:
    """A TIFF of many pages; one channel and time point of it."""
    stacks = _file_stacks(path)
    if max(stack.slices for stack in stacks) == 1:
        if len(stacks) > 1 and len({(stack.size, stack.label[:6]) for stack in stacks}) > 1:
            raise InputError("the pages of the TIFF differ in size or type; all slices need one size and type")
        raise InputError(IS_FLAT)
    return _read(stacks, title(path), max_bytes, number)


def folder_choices(files: Sequence[Path]) -> list[Choice]:
    """What there is to choose from in a folder of pictures."""
    return [_choice(stack) for stack in _folder_stacks(files)]


def tiff_choices(path: Path) -> list[Choice]:
    """What there is to choose from in a TIFF."""
    return [_choice(stack) for stack in _file_stacks(path)]


def _file_stacks(path: Path) -> list[_Stack]:
    return _ranked(NamedSeries((path,)), several=False)


def _folder_stacks(files: Sequence[Path]) -> list[_Stack]:
    series = named_series(files)
    stacks = [stack for one in series for stack in _ranked(one, several=len(series) > 1)]
    return sorted(stacks, key=lambda stack: -stack.slices)


def _ranked(series: NamedSeries, several: bool) -> list[_Stack]:
    """The volumes of one series of files: as many as its files have stacks."""
    first = series.files[0]
    label = series.label if several else ""
    if _is_plain(first):
        return [_Stack(series, 0, label, _plain_size(first), len(series.files), (None, None, None), "", series.notes)]
    if not _is_tiff(first):
        size, spacing = _png_header(first)[:2], _png_spacing(first)
        source = "the resolution in the pictures" if spacing[0] else ""
        return [_Stack(series, 0, label, size, len(series.files), spacing, source, series.notes)]
    stacks = _tiff_stacks(first)
    counts = [len(stacks[0].pages), *(len(_tiff_stacks(file)[0].pages) for file in series.files[1:])]
    notes = list(series.notes)
    if max(counts) > 1 and len(counts) > 1:
        shown = ", ".join(map(str, counts[:8])) + ", ..." * (len(counts) > 8)
        notes.append(
            f"{len(counts)} TIFFs of {shown} pages were put together in the order of their names; if each is a volume of its "
            "own, give the file"
        )
    slices = sum(counts)
    return [
        _Stack(
            series,
            rank,
            ", ".join(word for word in (label, stack.label) if word),
            stack.size,
            slices if len(stack.pages) == counts[0] else len(stack.pages) * len(series.files),
            stack.spacing_mm,
            stack.source,
            (*notes, *stack.notes),
        )
        for rank, stack in enumerate(stacks)
    ]


def _plain_size(path: Path) -> tuple[int, int]:
    try:
        return plain_size(path)
    except InputError as error:
        raise InputError(f"slice {path.name}: {error}") from error


def _tiff_stacks(path: Path) -> list[TiffStack]:
    try:
        return tiff_stacks(path)
    except InputError as error:
        raise InputError(f"slice {path.name}: {error}") from error


def _choice(stack: _Stack) -> Choice:
    spacing = _known(stack.spacing_mm) if any(stack.spacing_mm) else ()
    label = stack.label or "pictures"
    return Choice(label, (*stack.size, stack.slices), spacing, series=label)  # stacks of pictures say nothing of time


def _known(spacing: tuple[float | None, ...]) -> tuple[float, float, float]:
    """Millimetres along i, j, k; the distance of the slices as that of the pixels where it is not said."""
    i, j, k = spacing
    i = i or j or 1.0
    j = j or i
    return i, j, k or (i if spacing[0] or spacing[1] else 1.0)


def _read(stacks: list[_Stack], name: str, max_bytes: int, number: int | None) -> Volume:
    choices = [_choice(stack) for stack in stacks]
    index = pick(choices, number)
    stack = stacks[index]
    array, found = _voxels(stack, max_bytes)
    notes = [*chosen_note(choices, index, number), *stack.notes, *sorted(found)]
    if not any(stack.spacing_mm):
        notes.append(f"pictures carry no geometry: 1 mm voxels are assumed, {_DIRECTIONS}")
        return Volume(array, LPS_TO_RAS, name=name, notes=tuple(notes))
    spacing = _known(stack.spacing_mm)
    said = " x ".join(f"{value:.4g}" for value in spacing)
    guess = (
        "" if stack.spacing_mm[2] else ", the distance of the slices is not said: it is taken to be that of the pixels"
    )
    notes.append(f"voxels of {said} mm, from {stack.source}{guess}; directions are assumed: {_DIRECTIONS}")
    return Volume(array, LPS_TO_RAS @ np.diag([*spacing, 1.0]), name=name, notes=tuple(notes))


def _voxels(stack: _Stack, max_bytes: int) -> tuple[np.ndarray, set[str]]:
    """(k, j, i) and what was decided about colours."""
    notes: set[str] = set()
    array = np.empty(0)
    names: list[str] = []
    with closing(_all_planes(stack, max_bytes, notes)) as planes:  # what is refused half-way is closed at once, too
        for number, (name, plane) in enumerate(planes):
            if plane.ndim != 2:
                raise InputError(f"{name} holds no picture; save the stack again")
            if number == 0:
                check_size((stack.slices, *plane.shape), plane.dtype, max_bytes)
                array = np.empty((stack.slices, *plane.shape), plane.dtype)
            if (plane.shape, plane.dtype) != (array.shape[1:], array.dtype):
                raise InputError(
                    f"slice {name} is {plane.shape[1]} x {plane.shape[0]} {plane.dtype}, {names[0]} "
                    f"is {array.shape[2]} x {array.shape[1]} {array.dtype}; all slices need one size and type"
                )
            if number >= len(array):
                raise InputError(f"{name} has more pages than the header says; save the stack again")
            array[number] = plane
            names.append(name)
    if len(names) != len(array):
        raise InputError(IS_TRUNCATED)
    return array, notes


def _all_planes(stack: _Stack, max_bytes: int, notes: set[str]) -> Iterator[tuple[str, np.ndarray]]:
    for file in stack.files.files:
        yield from _planes(file, stack, max_bytes, notes)


def _planes(file: Path, stack: _Stack, max_bytes: int, notes: set[str]) -> Iterator[tuple[str, np.ndarray]]:
    several = len(stack.files.files) > 1
    try:
        if _is_plain(file):
            yield file.name, read_plain(file, max_bytes, notes)
            return
        if not _is_tiff(file):
            yield file.name, _png(file, max_bytes, notes)
            return
        stacks = tiff_stacks(file)
        if stack.rank >= len(stacks):
            raise InputError("has fewer channels or time points than the others")
        for page, plane in enumerate(tiff_planes(file, stacks[stack.rank], max_bytes, notes), 1):
            yield (f"{file.name}, page {page}" if len(stacks[stack.rank].pages) > 1 else file.name), plane
    except InputError as error:
        if not several or str(error).startswith("slice "):
            raise
        raise InputError(f"slice {file.name}: {error}") from error


def _is_tiff(file: Path) -> bool:
    """By the first bytes; pictures are renamed without being converted."""
    with file.open("rb") as stream:
        start = stream.read(4)
    return start in TIFF_STARTS or (start != _PNG_START and file.suffix.lower() in TIFF_ENDINGS)


def _is_plain(file: Path) -> bool:
    return file.suffix.lower() in PLAIN_ENDINGS


# --- PNG ------------------------------------------------------------------------------------------------------------


def _png_header(path: Path) -> tuple[int, int, int, int]:
    """(columns, rows, bits, colour type)."""
    with path.open("rb") as file:
        head = file.read(26)
    if len(head) < 26 or head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR":
        raise InputError(f"slice {path.name}: not a readable PNG or TIFF image, or cut short; copy or export it again")
    return struct.unpack(">IIBB", head[16:26])


def _png(path: Path, max_bytes: int, notes: set[str]) -> np.ndarray:
    """(rows, columns), grey."""
    import cv2

    columns, rows, bits, kind = _png_header(path)
    shape = (rows, columns, _PNG_CHANNELS.get(kind, 4))
    check_size(shape, np.dtype("u2" if bits == 16 else "u1"), max_bytes)
    if rows * (columns * shape[2] * bits // 8) > path.stat().st_size * MAX_DEFLATE_RATIO:
        raise InputError(IS_TRUNCATED)
    data = path.read_bytes()
    if not has_whole_chunks(data):
        raise InputError(IS_TRUNCATED)
    with quiet_cv2():
        try:
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            picture = None
    if picture is None:
        raise InputError("not a readable PNG or TIFF image, or cut short; copy or export it again")
    return picture if picture.ndim == 2 else grey_of(picture, _PNG_KINDS.get(kind, "colours"), notes)


def _png_spacing(path: Path) -> tuple[float | None, float | None, float | None]:
    """Millimetres from the pixels per metre of a PNG; nothing where they are those of a printer or screen."""
    with path.open("rb") as file:
        content = chunk_before_pixels(file, b"pHYs", 9)
    if content is None:
        return None, None, None
    across, down, unit = struct.unpack(">IIB", content)
    printed = all(round(value * 0.0254) in PRINTERS for value in (across, down))
    if unit != 1 or not across or not down or printed:
        return None, None, None
    return 1e3 / across, 1e3 / down, None
