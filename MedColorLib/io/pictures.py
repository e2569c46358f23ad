"""Pictures in: a folder of PNG or TIFF slices, or a TIFF of many pages, as a `Volume`."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume
from .voxel_data import IS_COLOR, IS_FLAT, IS_TRUNCATED, LPS_TO_RAS, check_size, natural_key, title

PICTURE_ENDINGS = (".png", ".tif", ".tiff")


@contextmanager
def quiet_cv2() -> Iterator[None]:
    """Keep OpenCV's complaints about damaged files off stderr; they become an `InputError`."""
    import cv2

    log = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging  # OpenCV 4, as NumPy 1 needs it; OpenCV 5
    level = log.getLogLevel()
    log.setLogLevel(0)  # silent
    try:
        yield
    finally:
        log.setLogLevel(level)


def _decoded(data: np.ndarray) -> np.ndarray:
    """The first image of a file's bytes, scalar, in its own type."""
    import cv2

    picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if picture is None:
        raise InputError("not a readable PNG or TIFF image, or cut short; copy or export it again")
    if picture.ndim != 2:
        raise InputError(IS_COLOR)
    return picture


def read_picture_folder(files: Sequence[Path], max_bytes: int) -> Volume:
    """PNG or TIFF slices of one size and type, in natural order of their names, slice 0 first."""
    import cv2

    files = sorted(files, key=natural_key)
    array = np.empty(0)
    with quiet_cv2():
        for number, file in enumerate(files):
            try:
                picture = _decoded(np.fromfile(file, np.uint8))
            except (InputError, cv2.error) as error:
                raise InputError(f"slice {file.name}: {error}") from error
            if number == 0:
                check_size((len(files), *picture.shape), picture.dtype, max_bytes)
                array = np.empty((len(files), *picture.shape), picture.dtype)
            if (picture.shape, picture.dtype) != (array.shape[1:], array.dtype):
                raise InputError(
                    f"slice {file.name} is {picture.shape[1]} x {picture.shape[0]} {picture.dtype}, {files[0].name} "
                    f"is {array.shape[2]} x {array.shape[1]} {array.dtype}; all slices need one size and type"
                )
            array[number] = picture
    return _picture_volume(array, files[0].parent.name)


def read_tiff(path: Path, max_bytes: int) -> Volume:
    """A multi-page TIFF, one page per slice."""
    import cv2

    data = np.fromfile(path, np.uint8)
    pages = _tiff_page_count(data.data)
    with quiet_cv2():
        try:
            first = _decoded(data)
            if pages == 1:
                raise InputError(IS_FLAT)
            check_size((pages, *first.shape), first.dtype, max_bytes)
            _, pictures = cv2.imdecodemulti(data, cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            raise InputError(f"not a readable TIFF ({error})") from error
    if len(pictures) != pages:  # OpenCV gives the pages before the damage
        raise InputError(IS_TRUNCATED)
    if {(picture.shape, picture.dtype) for picture in pictures} != {(first.shape, first.dtype)}:
        raise InputError("the pages of the TIFF differ in size or type; all slices need one size and type")
    return _picture_volume(np.stack(pictures), title(path))


def _tiff_page_count(data: memoryview) -> int:
    """Number of pages in the chain of directories of a TIFF or BigTIFF (TIFF 6.0, section 2)."""
    order = {b"II": "<", b"MM": ">"}.get(bytes(data[:2]), "<")
    offsets = set()
    try:
        (magic,) = struct.unpack_from(f"{order}H", data, 2)
        count, entry, offset_type, at = {42: ("H", 12, "I", 4), 43: ("Q", 20, "Q", 8)}[magic]
        (offset,) = struct.unpack_from(order + offset_type, data, at)
        while offset and offset not in offsets:
            offsets.add(offset)
            (entries,) = struct.unpack_from(order + count, data, offset)
            at = offset + struct.calcsize(order + count) + entries * entry
            (offset,) = struct.unpack_from(order + offset_type, data, at)
    except KeyError as error:
        raise InputError("not a TIFF image") from error
    except (struct.error, OverflowError) as error:
        raise InputError(IS_TRUNCATED) from error
    return len(offsets)


def _picture_volume(array: np.ndarray, name: str) -> Volume:
    note = "pictures carry no geometry: 1 mm voxels are assumed, x to the left, y to the back, slices upwards"
    return Volume(array, LPS_TO_RAS, name=name, notes=(note,))
