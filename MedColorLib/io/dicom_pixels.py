"""DICOM pixels in: stored numbers as they are in the file, GDCM (in SimpleITK) for packed ones, and each frame's rescale."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..errors import InputError
from .dicom_file import NATIVE, quiet_pydicom
from .dicom_header import Frame, Pixels
from .quiet import itk_name, quiet_itk, quiet_stderr

_RUN_LENGTHS = "1.2.840.10008.1.2.5"
_LARGE, _MAX_RATIO = 1 << 26, 10_000  # no frame of so many bytes is packed so well
_SECONDARY_CAPTURE = "1.2.840.10008.5.1.4.1.1.7"


def value_type(frames: Sequence[Frame]) -> np.dtype:
    """The smallest type that holds the rescaled numbers of all frames; float32 for scaled numbers of up to 16 bits."""
    dtype = np.result_type(*{_value_type(frame) for frame in frames})
    narrow = all(frame.pixels and not frame.pixels.real and frame.pixels.bits[1] <= 16 for frame in frames)
    return np.dtype("f4") if dtype.kind == "f" and narrow else dtype  # holds scaled 16-bit numbers to 6e-8


def _value_type(frame: Frame) -> np.dtype:
    pixels, (slope, intercept) = frame.pixels, frame.rescale
    assert pixels is not None
    if (slope, intercept) == (1.0, 0.0):
        return pixels.stored
    if pixels.real or not (slope.is_integer() and intercept.is_integer()):
        return np.dtype("f4" if pixels.bits[1] <= 16 or pixels.real == "f4" else "f8")
    ends = sorted(slope * limit + intercept for limit in pixels.limits)
    for name in ("u1", "i1", "i2", "u2", "i4", "u4"):
        limits = np.iinfo(name)
        if np.dtype(name).itemsize >= pixels.stored.itemsize and limits.min <= ends[0] and ends[1] <= limits.max:
            return np.dtype(name)
    return np.dtype("f8")


def values(frame: Frame, dtype: np.dtype, notes: set[str] | None = None) -> np.ndarray:
    """(rows, columns) of one frame, or of its tile, rescaled; MONOCHROME1 is turned so that larger is brighter.

    Padding that would look brighter than the darkest pixel becomes as dark as that.

    Args:
        notes: gets what was decided about padding.

    Raises:
        InputError: cannot be decoded.
    """
    pixels = frame.pixels
    assert pixels is not None
    try:
        stored = _stored(frame, pixels)
    except (InputError, OSError, MemoryError):
        raise
    except Exception as error:  # whatever damaged pixels make the decoders raise
        raise InputError(_not_decoded(frame, pixels.syntax)) from error
    if frame.tiles > 1:
        columns, rows = frame.size
        row, column = divmod(frame.number, frame.tiles)
        stored = stored[row * rows : (row + 1) * rows, column * columns : (column + 1) * columns]
    padded = None if pixels.padding is None else (stored >= pixels.padding[0]) & (stored <= pixels.padding[1])
    if pixels.inverted:
        low, high = pixels.limits
        stored = (low + high - stored.astype(np.int64)).astype(pixels.stored)
    slope, intercept = frame.rescale
    plain = (slope, intercept) == (1.0, 0.0)
    scaled = (stored if plain else stored * np.float64(slope) + intercept).astype(dtype, copy=False)
    return scaled if padded is None else _darkened(scaled, padded, notes)


def _darkened(scaled: np.ndarray, padded: np.ndarray, notes: set[str] | None) -> np.ndarray:
    """Final values, (rows, columns): a falling scale makes the smallest stored number the brightest."""
    if not padded.any() or padded.all():
        return scaled
    least = scaled[~padded].min()
    if not scaled[padded].max() > least:
        return scaled
    if notes is not None:
        notes.add("padding is no measurement: it was made as dark as the darkest pixel of its slice")
    return np.where(padded, least, scaled)


def _not_decoded(frame: Frame, syntax: str) -> str:
    import pydicom

    packed = "" if syntax in NATIVE else f" (packed as {pydicom.uid.UID(syntax).name})"
    remedy = "export the series again" + (", uncompressed, or unpack it with gdcmconv --raw" if packed else "")
    return f"DICOM slice {frame.instance:g}{packed} cannot be decoded; {remedy}"


def _stored(frame: Frame, pixels: Pixels) -> np.ndarray:
    """(rows, columns) of the file's own numbers."""
    number = 0 if frame.tiles > 1 else frame.number
    shape, size = (pixels.rows, pixels.columns), pixels.rows * pixels.columns * pixels.stored.itemsize
    if pixels.syntax in NATIVE:
        with frame.path.open("rb") as file:
            file.seek(pixels.offset + number * size)
            data = file.read(size)
    elif pixels.offset < 0:
        data = _unpacked(frame.path)[number * size : (number + 1) * size]
    elif pixels.syntax == _RUN_LENGTHS:  # GDCM refuses some that are as the standard wants them
        return _used_bits(_run_lengths(frame.path, number, pixels).reshape(shape).astype(pixels.stored), pixels)
    else:
        return _by_gdcm(_packed_frames(frame.path, pixels.frames)[number], pixels)
    if len(data) < size:
        raise InputError(f"DICOM slice {frame.instance:g} is cut short; copy or export it again")
    order = ">" if pixels.syntax == NATIVE[2] else "<"
    stored = np.frombuffer(data, pixels.stored.newbyteorder(order)).reshape(shape)
    return _used_bits(stored.astype(pixels.stored), pixels)


def _used_bits(stored: np.ndarray, pixels: Pixels) -> np.ndarray:
    """Without what lies in bits above and below the number (overlays), and with its sign."""
    allocated, bits, high = pixels.bits
    if pixels.real or bits == allocated:
        return stored
    return (stored << (allocated - high - 1)) >> (allocated - bits)


def _unpacked(path: Path) -> bytes:
    """The pixels of a file that is packed as a whole."""
    import pydicom

    with quiet_pydicom():
        return pydicom.dcmread(path, force=True).PixelData


def _run_lengths(path: Path, number: int, pixels: Pixels) -> np.ndarray:
    """One frame, unpacked by pydicom, which would drop the bits above the number, wherever that begins."""
    import pydicom

    allocated, stored, high = pixels.bits
    with quiet_pydicom():
        source = path
        if high != stored - 1:
            source = pydicom.dcmread(path, force=True)
            source.BitsStored, source.HighBit = allocated, allocated - 1
        try:
            from pydicom.pixels import pixel_array
        except ImportError:  # pydicom 2, as Python 3.9 needs it
            whole = pydicom.dcmread(path, force=True).pixel_array
            return whole[number] if whole.ndim == 3 else whole
        return pixel_array(source, index=number, raw=True)


@lru_cache(maxsize=1)
def _packed_frames(path: Path, count: int) -> list[bytes]:
    """The packed frames of a file, the pictures of JPEG and so on."""
    import pydicom
    from pydicom import encaps

    with quiet_pydicom(), path.open("rb") as file:
        data = pydicom.dcmread(file, force=True).PixelData
        if hasattr(encaps, "generate_frames"):
            return list(encaps.generate_frames(data, number_of_frames=count))
        return list(encaps.generate_pixel_data_frame(data, count))  # pydicom 2, as Python 3.9 needs it


def _by_gdcm(packed: bytes, pixels: Pixels) -> np.ndarray:
    """One packed frame, unpacked by GDCM from a file of its own that holds nothing else of the header."""
    import SimpleITK as sitk

    size = pixels.rows * pixels.columns * pixels.stored.itemsize
    if size > _LARGE and len(packed) * _MAX_RATIO < size:
        raise ValueError("less than the frame that the header speaks of")
    with tempfile.TemporaryDirectory() as folder, quiet_itk(), quiet_stderr():
        path = Path(folder, "frame.dcm")
        _write_frame(path, packed, pixels)
        reader = sitk.ImageFileReader()
        reader.SetImageIO("GDCMImageIO")
        with itk_name(path) as name:
            reader.SetFileName(name)
            decoded = sitk.GetArrayFromImage(reader.Execute())
    if decoded.shape != (1, pixels.rows, pixels.columns):
        raise ValueError("not as large as the header says")
    return decoded[0].astype(pixels.stored)


def _write_frame(path: Path, packed: bytes, pixels: Pixels) -> None:
    import pydicom
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.encaps import encapsulate

    frame = Dataset()
    frame.file_meta = FileMetaDataset()
    frame.file_meta.TransferSyntaxUID = pydicom.uid.UID(pixels.syntax)
    frame.file_meta.MediaStorageSOPClassUID = frame.SOPClassUID = _SECONDARY_CAPTURE
    frame.file_meta.MediaStorageSOPInstanceUID = frame.SOPInstanceUID = pydicom.uid.generate_uid()
    frame.Rows, frame.Columns, frame.SamplesPerPixel = pixels.rows, pixels.columns, 1
    frame.PhotometricInterpretation, frame.PixelRepresentation = "MONOCHROME2", int(pixels.signed)
    frame.BitsAllocated, frame.BitsStored, frame.HighBit = pixels.bits
    frame.PixelData = encapsulate([packed])
    frame["PixelData"].is_undefined_length = True
    with quiet_pydicom():
        if int(pydicom.__version__.split(".")[0]) >= 3:
            frame.save_as(path, enforce_file_format=True)
        else:
            frame.is_little_endian, frame.is_implicit_VR = True, False
            frame.save_as(path, write_like_original=False)
