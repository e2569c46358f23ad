"""DICOM headers in: every file becomes frames, one for each plane of pixels, by `pydicom`; no pixel is read here.

A classic file is one frame. A multi-frame file is as many as it has, each with the position, the rescale and the contrast
of its own functional groups. A Siemens mosaic is as many as it has tiles.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .dicom_file import NATIVE, PIXEL_TAGS, read_header, syntax_of
from .dicom_traits import Words, frame_traits, traits_of, values_of

_NO_SCANS = ("SEG", "RTDOSE", "RTSTRUCT", "RTPLAN", "PR", "KO", "SR", "DOC", "REG")
_FILMS = (0x00181063, 0x00181065)  # FrameTime, FrameTimeVector: what FrameIncrementPointer says of a film
_FILMERS = ("US", "IVUS", "XA", "RF", "ES", "GM", "XC", "OP")
_MAX_FRAMES = 1 << 20


@dataclass(frozen=True)
class Pixels:
    """Where and how a file holds its stored numbers; `offset` is -1 where only the decoder of a whole file finds them."""

    offset: int
    frames: int
    rows: int
    columns: int
    syntax: str
    bits: tuple[int, int, int]  # allocated, stored, high
    signed: bool
    real: str | None  # "f4" or "f8" of parametric maps
    inverted: bool  # MONOCHROME1
    padding: tuple[int, int] | None = None  # stored numbers from .. to that are no measurement

    @property
    def stored(self) -> np.dtype:
        """Type of the stored numbers, of the machine's byte order."""
        return np.dtype(self.real or f"{'i' if self.signed else 'u'}{self.bits[0] // 8}")

    @property
    def limits(self) -> tuple[int, int]:
        """Smallest and largest integer that the bits hold."""
        top = 1 << (self.bits[1] - self.signed)
        return -top * self.signed, top - 1


@dataclass(frozen=True)
class Frame:
    """What the header says of one plane of pixels."""

    path: Path
    number: int  # of the frame in the file, or of the tile in its mosaic
    tiles: int  # along an edge of the mosaic; 1: none
    pixels: Pixels | None  # None: colour
    series: str  # SeriesInstanceUID
    study: str
    image: str  # SOPInstanceUID
    whole: str  # what a multi-frame file is a part of: its concatenation, or itself; "": a classic file
    modality: str
    series_number: str
    size: tuple[int, int]  # columns, rows
    spacing_mm: tuple[float, float] | None  # along i, j
    thickness_mm: float
    axes: tuple[float, ...]  # direction cosines of i, then of j; empty: not given
    position_mm: tuple[float, ...]  # of the first pixel, LPS; empty: not given
    place: float  # orders what has no position
    instance: float
    rescale: tuple[float, float]
    window: tuple[float, float] | None
    windows: int
    traits: dict[str, Any] = field(default_factory=dict)  # what may tell volumes at one place apart
    rescaled: bool = True  # the header gives slope or intercept
    zero_slope: bool = False  # and the slope is 0, which 1 stands for
    table: bool = False  # a modality look-up table is in the header
    equidistant: bool = False  # the position is reckoned from that of the first frame and the header's distance

    @property
    def label(self) -> str:
        """Modality and series number, no other words of the header."""
        return f"{self.modality or 'DICOM'} series {self.series_number}".rstrip()


def read_frames(path: Path) -> list[Frame]:
    """The frames of a file; none for other objects and damaged files."""
    try:
        return _frames(path, *read_header(path))
    except (OSError, MemoryError):
        raise
    except Exception:  # pydicom raises whatever a damaged header makes its parts raise
        return []


def _frames(path: Path, header, tag: int, offset: int, length: int) -> list[Frame]:
    modality = str(header.get("Modality", "") or "")
    if not tag or modality in _NO_SCANS:
        return []
    pixels, color = _pixels(header, tag, offset)
    if pixels.syntax in NATIVE and not color:
        stored = pixels.frames * pixels.rows * pixels.columns * pixels.bits[0] // 8
        if min(length, path.stat().st_size - offset) < stored:
            return []  # cut short
    common = {
        "path": path,
        "pixels": None if color else pixels,
        "series": str(header.get("SeriesInstanceUID", "")),
        "study": str(header.get("StudyInstanceUID", "")),
        "image": str(header.get("SOPInstanceUID", "")) or str(path),
        "modality": modality,
        "series_number": str(header.get("SeriesNumber", "") if header.get("SeriesNumber") is not None else ""),
        "instance": _number(header.get("InstanceNumber"), 0.0),
        "whole": "",
    }
    groups = header.get("PerFrameFunctionalGroupsSequence") or []
    if "MOSAIC" in str(header.get("ImageType", "")) and pixels.frames == 1:
        return _mosaic(header, common, pixels)
    if pixels.frames == 1 and not groups:
        return [_frame(Words(header), common, 0, pixels)]
    common["whole"] = str(header.get("ConcatenationUID", "")) or common["image"]
    return _multi_frame(header, groups, common, pixels)


def _pixels(header, tag: int, offset: int) -> tuple[Pixels, bool]:
    color = int(header.get("SamplesPerPixel", 1)) != 1 or "PALETTE" in str(header.get("PhotometricInterpretation", ""))
    allocated = int(header.BitsAllocated)
    stored = int(header.get("BitsStored", allocated))
    high = int(header.get("HighBit", stored - 1))
    real = PIXEL_TAGS[tag]
    frames, rows, columns = int(header.get("NumberOfFrames", 1) or 1), int(header.Rows), int(header.Columns)
    if min(rows, columns, frames) < 1 or frames > _MAX_FRAMES:
        raise ValueError("no pixels")
    if allocated not in ((8, 16, 32) if real is None else (32, 64)) or not 0 < stored <= high + 1 <= allocated:
        raise ValueError("bits that no scanner stores")
    signed = bool(int(header.get("PixelRepresentation", 0))) and real is None
    inverted = str(header.get("PhotometricInterpretation", "")).strip() == "MONOCHROME1" and real is None
    bits = (allocated, stored, high)
    pixels = Pixels(offset, frames, rows, columns, syntax_of(header), bits, signed, real, inverted)
    return pixels if real else replace(pixels, padding=_padding(header, pixels.stored)), color


def _padding(header, stored: np.dtype) -> tuple[int, int] | None:
    """The range of numbers that fill what was not scanned; some write them with the wrong sign."""
    ends = [
        _number(header.get(name), math.nan)
        for name in ("PixelPaddingValue", "PixelPaddingRangeLimit")
        if name in header
    ]
    if not ends or not all(map(math.isfinite, ends)):
        return None
    size = 1 << (8 * stored.itemsize)
    low, high = sorted(
        int(np.array(int(end) % size, f"u{stored.itemsize}").view(stored)) for end in (ends[0], ends[-1])
    )
    return low, high


def _frame(words: Words, common: dict, number: int, pixels: Pixels, **changed) -> Frame:
    """One frame, of which `words` tell."""

    def values(name: str) -> tuple[float, ...]:
        return _numbers(words.get(name))

    spacing = values("PixelSpacing") or values("ImagerPixelSpacing") or values("NominalScannedPixelSpacing")
    axes, position = values("ImageOrientationPatient"), values("ImagePositionPatient")
    slope, intercept = values("RescaleSlope") or values("DoseGridScaling"), values("RescaleIntercept")
    centers, widths = values("WindowCenter"), values("WindowWidth")
    window = None
    if centers and widths and widths[0] > 0:
        window = (centers[0] - widths[0] / 2, centers[0] + widths[0] / 2)
    known = {
        "number": number,
        "tiles": 1,
        "size": (pixels.columns, pixels.rows),
        "spacing_mm": spacing[1::-1] if len(spacing) == 2 and min(spacing) > 0 else None,  # rows come first there
        "thickness_mm": (*values("SpacingBetweenSlices"), *values("SliceThickness"), 0.0),
        "axes": axes if len(axes) == 6 and _is_frame(axes) else (),
        "position_mm": position if len(position) == 3 else (),
        "place": common["instance"],
        "rescale": (slope[0] if slope and slope[0] else 1.0, intercept[0] if intercept else 0.0),
        "rescaled": bool(slope or intercept),
        "zero_slope": slope[:1] == (0.0,),
        "table": words.get("ModalityLUTSequence") is not None,
        "window": window,
        "windows": len(centers),
        "traits": changed["traits"] if "traits" in changed else traits_of(words),
    }
    known["thickness_mm"] = abs(known["thickness_mm"][0])
    return Frame(**{**common, **known, **changed})


def _is_frame(axes: tuple[float, ...]) -> bool:
    """Two directions of some length that are not one."""
    lengths = math.hypot(*axes[:3]), math.hypot(*axes[3:])
    return min(lengths) > 0.1 and float(np.linalg.norm(np.cross(axes[:3], axes[3:]))) > 0.1 * lengths[0] * lengths[1]


def _multi_frame(header, groups, common: dict, pixels: Pixels) -> list[Frame]:
    shared = next(iter(header.get("SharedFunctionalGroupsSequence") or []), None)
    common_words = Words(values_of(_macros(shared)), *_detector(header), header)
    offsets = _numbers(header.get("GridFrameOffsetVector"))
    film = _is_film(header) and not groups
    frames = []
    for number in range(pixels.frames):
        own = values_of(_macros(groups[number] if number < len(groups) else None))
        words = Words(own, common_words)
        traits, place = frame_traits(words, own, number)
        changed = {"traits": traits, "place": float(number) if place is None else place}
        frame = _frame(words, common, number, pixels, **changed)
        if film:
            changed = {"place": 0.0, "traits": {**traits, "frame of a film": number + 1}}
        elif not groups and frame.position_mm and frame.axes:
            changed["position_mm"] = _along(frame, offsets, number, changed["place"])
            changed["equidistant"] = not offsets
        frames.append(replace(frame, **changed))
    return frames


def _is_film(header) -> bool:
    """Frames that follow each other in time or around the patient, not in space."""
    if header.get("SliceVector") is not None:
        return False
    pointers = [int(tag) for tag in _listed(header.get("FrameIncrementPointer"))]
    by_modality = str(header.get("Modality", "")) in _FILMERS and header.get("ImagePositionPatient") is None
    return by_modality or any(tag in _FILMS or tag >> 16 == 0x0054 for tag in pointers)


def _along(frame: Frame, offsets: tuple[float, ...], number: int, place: float) -> tuple[float, ...]:
    """The position of a frame of a stack whose header gives that of the first alone."""
    normal = np.cross(frame.axes[:3], frame.axes[3:])
    height = offsets[number] - offsets[0] if number < len(offsets) else place * (frame.thickness_mm or 1.0)
    return tuple(np.add(frame.position_mm, height * normal).tolist())


def _macros(group) -> list:
    """The first item of every sequence of a functional group."""
    if group is None:
        return []
    return [element.value[0] for element in group if element.VR == "SQ" and element.value]


def _detector(header) -> list:
    """Nuclear medicine keeps position and orientation with the detector."""
    return list(header.get("DetectorInformationSequence") or [])[:1]


def _mosaic(header, common: dict, pixels: Pixels) -> list[Frame]:
    """Slices as tiles of one picture. Siemens writes the position that a picture as large as the mosaic would have."""
    common["whole"] = common["image"]
    count, normal = _mosaic_slices(header)
    tiles = math.ceil(math.sqrt(max(count, 1)))
    if count < 1 or tiles > min(pixels.rows, pixels.columns):
        return [_frame(Words(header), common, 0, pixels, tiles=0)]  # refused by name where it is chosen
    columns, rows = pixels.columns // tiles, pixels.rows // tiles  # a rest stays empty at the end
    whole = _frame(Words(header), common, 0, pixels)
    step = _numbers(header.get("SpacingBetweenSlices")) or (whole.thickness_mm or 1.0,)
    frames = []
    for number in range(count):
        position: tuple[float, ...] = ()
        if whole.position_mm and whole.axes and whole.spacing_mm:
            axes = np.reshape(whole.axes, (2, 3))
            inward = np.array([pixels.columns, pixels.rows]) * (1 - 1 / tiles) / 2 * whole.spacing_mm
            up = np.cross(*axes) if normal is None or not np.any(normal) else np.asarray(normal)
            position = tuple((whole.position_mm + inward @ axes + number * abs(step[0]) * up).tolist())
        frames.append(
            replace(whole, number=number, tiles=tiles, size=(columns, rows), position_mm=position, place=float(number))
        )
    return frames


def _mosaic_slices(header) -> tuple[int, np.ndarray | None]:
    """How many, and their normal where the private header gives it."""
    count = _numbers(header[0x0019, 0x100A].value) if (0x0019, 0x100A) in header else ()
    from nibabel.nicom import csareader

    def look_up(get: Callable):
        try:
            csa = csareader.get_csa_header(header)
            return None if csa is None else get(csa)
        except Exception:  # as with headers: whatever damage makes its parts raise
            return None

    return int(count[0] if count else look_up(csareader.get_n_mosaic) or 0), look_up(csareader.get_slice_normal)


def _listed(value) -> list:
    return (
        []
        if value is None
        else list(value)
        if isinstance(value, (list, tuple)) or hasattr(value, "append")
        else [value]
    )


def _numbers(value) -> tuple[float, ...]:
    """Finite numbers of an element; nothing if one of them is none."""
    try:
        found = tuple(float(part) for part in _listed(value))
    except (TypeError, ValueError):
        return ()
    return found if all(map(math.isfinite, found)) else ()


def _number(value, default: float) -> float:
    return (_numbers(value) or (default,))[0]
