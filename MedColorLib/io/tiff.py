"""TIFF in, by `tifffile`: the stacks of a file (series, channels, time points), their voxel sizes, and their planes as grey."""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import InputError, MissingPackageError
from .choice import checked_count
from .grey import grey_of
from .quiet import quiet_cv2, quiet_package
from .tiff_spacing import spacing_mm
from .voxel_data import IS_TRUNCATED, check_size

_SLICES = "ZIQT"  # axes that may be the stack, the first of them that is there
_INKS = {5: "inks (CMYK)", 8: "CIE L*a*b*", 9: "ICC L*a*b*", 10: "ITU L*a*b*"}
TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
TIFF_MAX_RATIO = 4096  # of packed pages; no scan or photograph is packed more than that


@dataclass(frozen=True)
class TiffStack:
    """One stack of a file.

    Attributes:
        label: such as "channel 2"; empty where there is no choice.
        series: index of the series in the file, or -1: the pages one by one.
        pages: indices of its planes in the series.
        size: columns, rows.
        spacing_mm: along i, j, k; None: not said.
        source: where the spacing is from.
        notes: what was decided about the axes.
    """

    label: str
    series: int
    pages: tuple[int, ...]
    size: tuple[int, int]
    dtype: np.dtype
    spacing_mm: tuple[float | None, float | None, float | None]
    source: str
    notes: tuple[str, ...] = ()


@contextmanager
def _opened(path: Path) -> Iterator:
    """The file, without the others that its own words may name; every complaint about damage is an `InputError`."""
    try:
        import tifffile
    except ImportError as error:
        raise MissingPackageError("TIFF needs the package tifffile: pip install tifffile") from error
    try:
        with quiet_package("tifffile"), path.open("rb") as stream:
            with tifffile.TiffFile(stream, name=path.name, _multifile=False) as file:
                len(file.pages)  # counts them, and so notices pages that lead round in a circle; reading on would not
                if not (file.is_ome and any(page is None for series in file.series for page in series.pages)):
                    yield file
                    return
            stream.seek(0)  # one file of many: its words speak of pages that lie in others
            with tifffile.TiffFile(stream, name=path.name, is_ome=False) as alone:
                len(alone.pages)
                yield alone
    except (InputError, OSError, MemoryError, MissingPackageError):
        raise
    except Exception as error:  # whatever a damaged file makes its parts raise
        raise InputError(f"not a readable TIFF, or cut short ({error}); copy or export it again") from error


def tiff_stacks(path: Path) -> list[TiffStack]:
    """The stacks of a file, the largest first; of equal ones the first channel and time point first.

    Raises:
        InputError: damaged.
    """
    pages = _page_count(path)
    with _opened(path) as file:
        if len(file.pages) != pages:
            raise InputError(IS_TRUNCATED)
        held = sum(len(series.pages) for series in file.series)
        if file.series and file.series[0].kind == "generic" and held < pages:
            raise InputError(f"{pages - held} of its {pages} pages hold no picture; copy or export it again")
        found: list[TiffStack] = []
        pictures = [index for index, series in enumerate(file.series) if not series.keyframe.is_reduced]
        chosen = pictures or range(len(file.series))  # without previews, where there is anything else
        for index in chosen:
            found += _stacks(file, index, file.series[index], len(chosen))
        if not found:
            raise InputError("the TIFF holds no picture; copy or export it again")
        found = _joined(file, found)
    return sorted(found, key=lambda stack: -len(stack.pages))


def _joined(file, stacks: list[TiffStack]) -> list[TiffStack]:
    """Pages that each count as a series of their own, as programs write them one by one, are one stack where they are alike."""
    if any(len(stack.pages) > 1 for stack in stacks):
        return stacks
    alike: dict[tuple, list[TiffStack]] = {}
    for stack in stacks:
        alike.setdefault((stack.size, stack.dtype), []).append(stack)
    joined = []
    for group in alike.values():
        numbers = tuple(file.series[stack.series].keyframe.index for stack in group)
        one_page = all(len(file.series[stack.series].pages) == 1 for stack in group)
        if len(group) < 2 or not one_page or not all(isinstance(number, int) for number in numbers):
            joined += group
            continue
        label = f"pages of {group[0].size[0]} x {group[0].size[1]}" if len(alike) > 1 else ""
        note = f"{len(group)} pages that the TIFF holds one by one were put together in their order"
        joined.append(replace(group[0], label=label, series=-1, pages=numbers, notes=(*group[0].notes, note)))
    return joined


def _stacks(file, index: int, series, count: int) -> list[TiffStack]:
    """The stacks of one series; `count`: of all series that are looked at."""
    axes, shape = series.axes, series.shape
    if "Y" not in axes or "X" not in axes:
        return []
    planes = [place for place, axis in enumerate(axes) if axis not in "YXS"]
    along, notes = _slices_along(axes, shape, planes)
    spacing, source = spacing_mm(file, index, series)
    others = [place for place in planes if place != along]
    checked_count(math.prod(shape[place] for place in others))
    stride = {place: math.prod(shape[q] for q in planes if q > place) for place in planes}
    slices = 1 if along is None else shape[along]
    size = (int(shape[axes.index("X")]), int(shape[axes.index("Y")]))
    stacks = []
    for choice in itertools.product(*(range(shape[place]) for place in others)):
        first = sum(stride[place] * value for place, value in zip(others, choice))
        words = [f"{_word(axes[place])} {value + 1}" for place, value in zip(others, choice) if shape[place] > 1]
        if count > 1:
            words.insert(0, f"series {index + 1}")
        numbers = tuple(first + n * stride.get(along, 0) for n in range(slices))
        stacks.append(TiffStack(", ".join(words), index, numbers, size, np.dtype(series.dtype), spacing, source, notes))
    return stacks


def _slices_along(axes: str, shape: tuple[int, ...], planes: list[int]) -> tuple[int | None, tuple[str, ...]]:
    """Which axis is the stack, and what was decided; None: there is one plane."""
    long = [place for place in planes if shape[place] > 1]
    for kind in _SLICES:
        found = [place for place in long if axes[place] == kind]
        if len(found) > 1:
            longest = max(found, key=lambda place: (shape[place], place))
            return longest, ("the axes of the TIFF have no names; the longest is taken as that of the slices",)
        if found and kind == "T":
            return found[0], ("the only stack of the TIFF is one of time points; they are taken as slices",)
        if found:
            return found[0], ()
    return next((place for place in long if axes[place] != "C"), None), ()


def _word(axis: str) -> str:
    return {"C": "channel", "T": "time point", "Z": "slice", "R": "tile", "A": "angle"}.get(axis, f"axis {axis}")


def tiff_planes(path: Path, stack: TiffStack, max_bytes: int, notes: set[str]) -> Iterator[np.ndarray]:
    """(rows, columns) of a stack, grey, in order.

    Args:
        notes: gets what was decided about colours.

    Raises:
        InputError: colour, damaged, cut short, or more than `max_bytes`.
    """
    with _opened(path) as file:
        scale = _calibration(file)
        for plane in _stored_planes(file, path, stack, max_bytes, notes):
            yield plane if scale is None else _calibrated(plane, *scale, notes)


def _stored_planes(file, path: Path, stack: TiffStack, max_bytes: int, notes: set[str]) -> Iterator[np.ndarray]:
    if stack.series < 0:
        for number in stack.pages:
            yield _plane(path, file.pages[number].aspage(), max_bytes, notes)
        return
    series = file.series[stack.series]
    pages = list(series.pages)
    leading = math.prod(n for axis, n in zip(series.axes, series.shape) if axis not in "YXS")
    if len(pages) == leading and all(page is not None for page in pages):
        for number in stack.pages:
            yield _plane(path, pages[number].aspage(), max_bytes, notes)
        return
    page = pages[0].aspage()
    check_size(series.shape, series.dtype, max_bytes)
    if series.dataoffset is None or series.dataoffset + series.nbytes > path.stat().st_size or "S" in series.axes:
        raise InputError("the TIFF names more planes than it holds; save it again, one page a slice")
    whole = series.asarray(maxworkers=1).reshape(leading, *series.shape[-2:])
    for number in stack.pages:
        yield _grey(page, whole[number], "YX", notes)


def _calibration(file) -> tuple[float, float] | None:
    """(intercept, slope) where ImageJ's words say that the values are a straight line of the stored numbers."""
    words = (file.imagej_metadata or {}) if file.is_imagej else {}
    values = [words.get(name) for name in ("cf", "c0", "c1")]
    if values[0] != 0 or not all(isinstance(value, (int, float)) and math.isfinite(value) for value in values):
        return None
    return None if values[1:] == [0, 1] or values[2] == 0 else (float(values[1]), float(values[2]))


def _calibrated(plane: np.ndarray, intercept: float, slope: float, notes: set[str]) -> np.ndarray:
    notes.add(f"the values are calibrated as ImageJ's words say: {intercept:g} + {slope:g} times the stored number")
    if slope != 1 or not intercept.is_integer() or plane.dtype.kind != "u" or plane.dtype.itemsize > 2:
        return (intercept + slope * plane.astype(np.float64)).astype(np.float32)
    ends = np.array([0, np.iinfo(plane.dtype).max]) + int(intercept)
    fits = np.iinfo(np.int16).min <= ends[0] and ends[1] <= np.iinfo(np.int16).max
    return (plane.astype(np.int64) + int(intercept)).astype(np.int16 if fits else np.int32)


def _plane(path: Path, page, max_bytes: int, notes: set[str]) -> np.ndarray:
    size = check_size(page.shape, page.dtype, max_bytes)
    packed = sum(page.databytecounts)
    end = max((a + b for a, b in zip(page.dataoffsets, page.databytecounts)), default=0)
    bits = math.prod(page.shape) * page.bitspersample // 8
    ratio = 1 if page.compression == 1 else TIFF_MAX_RATIO
    if end > path.stat().st_size or not all(page.databytecounts) or packed * ratio < min(size, bits):
        raise InputError(IS_TRUNCATED)
    if (
        page.compression == 1
        and page.bitspersample not in (1, 8, 16, 32, 64)
        and page.samplesperpixel == 1
        and not page.is_tiled
    ):
        return _grey(page, _packed_numbers(path, page), page.axes, notes)
    try:
        return _grey(page, page.asarray(maxworkers=1), page.axes, notes)
    except Exception as error:  # of different types, one for each way of packing
        if "imagecodecs" not in str(error):
            raise
    return _by_opencv(path, page, notes)


def _packed_numbers(path: Path, page) -> np.ndarray:
    """(rows, columns) of numbers of 2, 4, 12 ... bits side by side, rows filled up to whole bytes."""
    bits, columns = page.bitspersample, page.imagewidth
    length = (columns * bits + 7) // 8
    with path.open("rb") as file:
        parts = []
        for offset, count in zip(page.dataoffsets, page.databytecounts):
            file.seek(offset)
            parts.append(file.read(count))
    data = np.frombuffer(b"".join(parts), np.uint8)[: page.imagelength * length].reshape(page.imagelength, length)
    order = "little" if page.fillorder == 2 else "big"
    single = np.unpackbits(data, axis=1, bitorder=order)[:, : columns * bits].reshape(page.imagelength, columns, bits)
    return (single @ (1 << np.arange(bits)[::-1])).astype(page.dtype)


def _by_opencv(path: Path, page, notes: set[str]) -> np.ndarray:
    """Packed in a way that tifffile leaves to a large package; OpenCV knows the usual ones."""
    import cv2

    with quiet_cv2():
        try:  # OpenCV reads planes of single colours wrongly
            if page.planarconfig == 2 and page.samplesperpixel > 1:
                raise cv2.error
            _, found = cv2.imdecodemulti(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            found = ()
    if not isinstance(page.index, int) or page.index >= len(found) or found[page.index].shape[:2] != page.shape[:2]:
        raise InputError(
            f"TIFF compression {page.compression.name} cannot be unpacked here; pip install imagecodecs, or save it as "
            "uncompressed or deflate"
        )
    picture = found[page.index]
    if picture.ndim == 2 and page.photometric == 0 and picture.dtype == np.uint8:
        picture = 255 - picture  # OpenCV has turned it round already
    return _grey(page, picture, "YXS" if picture.ndim == 3 else "YX", notes, mapped=picture.ndim == 3)


def _grey(page, picture: np.ndarray, axes: str, notes: set[str], mapped: bool = False) -> np.ndarray:
    if page.photometric in _INKS:
        raise InputError(f"its colours are {_INKS[page.photometric]}; save the slices as grey")
    if page.tags.get(274) is not None and page.tags[274].value not in (0, 1):
        notes.add("the orientation tag of the TIFF is not applied to slices")
    if page.photometric == 3 and not mapped and page.colormap is not None:
        colors = page.colormap.T
        colors = (colors >> 8).astype(np.uint8) if picture.dtype.itemsize == 1 else colors
        return grey_of(colors[picture], "palette pictures", notes)
    picture = picture.astype(np.uint8) * 255 if picture.dtype == bool else picture
    if axes.startswith("S"):
        picture = np.moveaxis(picture, 0, -1)
    if picture.ndim == 3:
        kind = "pictures with an alpha channel" if picture.shape[-1] in (2, 4) else "RGB pictures"
        return grey_of(picture, kind, notes)
    if page.photometric == 0:
        top = 0 if picture.dtype.kind == "f" else -1 if picture.dtype.kind == "i" else _largest(picture.dtype, page)
        notes.add(
            f"WhiteIsZero: larger numbers are meant to look darker; they were turned round ({top} minus the number)"
        )
        return top - picture
    return picture


def _largest(dtype: np.dtype, page) -> int:
    return int(np.iinfo(dtype).max) if page.bitspersample in (1, 8, 16, 32, 64) else (1 << page.bitspersample) - 1


def _page_count(path: Path) -> int:
    """Directories in a TIFF or BigTIFF (TIFF 6.0, section 2), also where the file ends before the last."""
    size, offsets = path.stat().st_size, set()
    with path.open("rb") as file:

        def number(form: str, at: int) -> int:
            if at + struct.calcsize(form) > size:
                raise InputError(IS_TRUNCATED)
            file.seek(at)
            return struct.unpack(form, file.read(struct.calcsize(form)))[0]

        order = {b"II": "<", b"MM": ">"}.get(file.read(2))
        kinds = {42: ("H", 12, "I", 4), 43: ("Q", 20, "Q", 8)}
        kind = kinds.get(number(f"{order}H", 2)) if order else None
        if not kind:
            raise InputError("not a TIFF image")
        count, entry, pointer, at = kind
        offset = number(order + pointer, at)
        while offset and offset not in offsets:
            offsets.add(offset)
            at = offset + struct.calcsize(order + count) + number(order + count, offset) * entry
            offset = number(order + pointer, at)
    return len(offsets)
