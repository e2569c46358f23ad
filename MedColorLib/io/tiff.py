"""TIFF in, by `tifffile`: the stacks of a file (series, channels, time points), their voxel sizes, and their planes as grey."""

from __future__ import annotations

import itertools
import logging
import math
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError, MissingPackageError
from .choice import checked_count
from .grey import grey_of
from .quiet import quiet_cv2
from .voxel_data import IS_TRUNCATED, check_size

_SLICES = "ZIQT"  # axes that may be the stack, the first of them that is there
_MM = {
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1.0),
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm", "\\u00b5m", "micron", "microns", "micrometer", "micrometre"), 1e-3),
    **{"nm": 1e-6, "cm": 10.0, "m": 1e3, "in": 25.4, "inch": 25.4, "\u00c5": 1e-7, "pm": 1e-9},
}
PRINTERS = {
    72,
    75,
    90,
    96,
    100,
    120,
    144,
    150,
    180,
    200,
    240,
    300,
    350,
    360,
    400,
    600,
    720,
    1200,
    2400,
}  # dots per inch
_MAX_RATIO = 4096  # of packed pages; no scan is packed more than that


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
    logger = logging.getLogger("tifffile")
    before, logger.disabled = logger.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with path.open("rb") as stream, tifffile.TiffFile(stream, name=path.name, _multifile=False) as file:
                if file.is_ome and any(page is None for series in file.series for page in series.pages):
                    stream.seek(0)  # one file of many: its words speak of pages that lie in others
                    with tifffile.TiffFile(stream, name=path.name, is_ome=False) as alone:
                        yield alone
                else:
                    yield file
    except (InputError, OSError, MemoryError, MissingPackageError):
        raise
    except Exception as error:  # whatever a damaged file makes its parts raise
        raise InputError(f"not a readable TIFF, or cut short ({error}); copy or export it again") from error
    finally:
        logger.disabled = before


def tiff_stacks(path: Path) -> list[TiffStack]:
    """The stacks of a file, the largest first; of equal ones the first channel and time point first.

    Raises:
        InputError: damaged.
    """
    pages = _page_count(path)
    with _opened(path) as file:
        if len(file.pages) != pages:
            raise InputError(IS_TRUNCATED)
        found: list[TiffStack] = []
        for index, series in enumerate(file.series):
            found += _stacks(file, index, series)
        if not found:
            raise InputError("the TIFF holds no picture; copy or export it again")
    return sorted(found, key=lambda stack: -len(stack.pages))


def _stacks(file, index: int, series) -> list[TiffStack]:
    axes, shape = series.axes, series.shape
    if "Y" not in axes or "X" not in axes:
        return []
    planes = [(axis, length) for axis, length in zip(axes, shape) if axis not in "YXS"]
    along = next((axis for kind in _SLICES for axis, n in planes if axis == kind and n > 1), None)
    along = along or next((axis for axis, n in planes if n > 1 and axis != "C"), None)
    size = (int(shape[axes.index("X")]), int(shape[axes.index("Y")]))
    notes = []
    if along == "T":
        notes.append("the only stack of the TIFF is one of time points; they are taken as slices")
    spacing, source = _spacing(file, index, series)
    stacks = []
    others = [(axis, n) for axis, n in planes if axis != along]
    checked_count(math.prod(n for _, n in others))
    strides = np.cumprod([1, *[n for _, n in planes][::-1]])[:-1][::-1]
    offset = {axis: int(stride) for (axis, _), stride in zip(planes, strides)}
    count = next((n for axis, n in planes if axis == along), 1)
    for choice in itertools.product(*(range(n) for _, n in others)):
        first = sum(offset[axis] * value for (axis, _), value in zip(others, choice))
        words = [f"{_word(axis)} {value + 1}" for (axis, n), value in zip(others, choice) if n > 1]
        if len(file.series) > 1:
            words.insert(0, f"series {index + 1}")
        numbers = tuple(first + n * offset.get(along or "", 0) for n in range(count))
        stacks.append(
            TiffStack(", ".join(words), index, numbers, size, np.dtype(series.dtype), spacing, source, tuple(notes))
        )
    return stacks


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


def _plane(path: Path, page, max_bytes: int, notes: set[str]) -> np.ndarray:
    size = check_size(page.shape, page.dtype, max_bytes)
    packed = sum(page.databytecounts)
    end = max((a + b for a, b in zip(page.dataoffsets, page.databytecounts)), default=0)
    bits = math.prod(page.shape) * page.bitspersample // 8
    ratio = 1 if page.compression == 1 else _MAX_RATIO
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
        try:
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


# --- voxel size -----------------------------------------------------------------------------------------------------


def _spacing(file, index: int, series) -> tuple[tuple[float | None, float | None, float | None], str]:
    """((i, j, k) in millimetres or None, where they are from)."""
    if file.is_ome and any(found := _ome_spacing(file.ome_metadata, index)):
        return found, "OME"
    plane = next((page for page in series.pages if page is not None), None)
    tags = {} if plane is None else plane.aspage().tags
    across = [_ratio(tags, 282), _ratio(tags, 283)]  # pixels per unit along x, y
    if file.is_imagej:
        return _imagej_spacing(file.imagej_metadata or {}, across)
    unit = tags.get(296)
    unit_mm = {2: 25.4, 3: 10.0}.get(2 if unit is None else int(unit.value))
    printed = unit_mm == 25.4 and all(ratio and round(ratio, 2) in PRINTERS for ratio in across)
    if unit_mm is None or not all(across) or printed:
        return (None, None, None), ""
    return (unit_mm / across[0], unit_mm / across[1], None), "the resolution tags"


def _imagej_spacing(
    words: dict, across: list[float | None]
) -> tuple[tuple[float | None, float | None, float | None], str]:
    scale = _MM.get(str(words.get("unit", "")).strip().lower())
    if scale is None:
        return (None, None, None), ""
    step = words.get("spacing")
    step = abs(float(step)) * scale if isinstance(step, (int, float)) and step else None
    i, j = (scale / ratio if ratio else None for ratio in across)
    return (i, j, step), "ImageJ"


def _ratio(tags, code: int) -> float | None:
    tag = tags.get(code)
    try:
        above, below = tag.value
        return above / below if above > 0 and below > 0 else None
    except (AttributeError, TypeError, ValueError):
        return None


def _ome_spacing(text: str, index: int) -> tuple[float | None, float | None, float | None]:
    from xml.etree import ElementTree

    try:
        pixels = [e for e in ElementTree.fromstring(text).iter() if e.tag.endswith("}Pixels") or e.tag == "Pixels"]
    except ElementTree.ParseError:
        return None, None, None
    if index >= len(pixels):
        return None, None, None

    def size(axis: str) -> float | None:
        scale = _MM.get(pixels[index].get(f"PhysicalSize{axis}Unit", "\u00b5m").lower())
        try:
            value = float(pixels[index].get(f"PhysicalSize{axis}", "nan"))
        except ValueError:
            return None
        return value * scale if scale and math.isfinite(value) and value > 0 else None

    return size("X"), size("Y"), size("Z")


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
