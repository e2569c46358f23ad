"""Stage *references*: the header of a picture file and its pixels, by Pillow or OpenCV, within bounds.

Sizes are known from the header before memory is taken. Damage of any kind becomes an InputError with the reason alone.
"""

from __future__ import annotations

import logging
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from ..device import is_out_of_memory
from ..errors import InputError
from ..io.label_picture import has_whole_chunks
from ..io.quiet import quiet_cv2, quiet_package, quiet_stderr
from ..io.tiff import TIFF_MAX_RATIO, TIFF_STARTS
from .to_srgb import TAG_GROUPS

if TYPE_CHECKING:
    from PIL import Image

log = logging.getLogger("MedColorLib")

# fmt: off
# Of Pillow's: those that run no other program and hold no volume. TGA has no mark of its own: only under its name.
_FORMATS = (
    "PNG", "JPEG", "MPO", "TIFF", "BMP", "DIB", "WEBP", "AVIF", "GIF", "JPEG2000", "PPM", "PSD", "SGI", "SUN", "PCX",
    "QOI", "DDS", "ICO", "ICNS",
)
# fmt: on
MAX_PIXELS = 178_956_970  # of more, Pillow, too, takes a picture for a decompression bomb

_UNREADABLE = "not a picture that can be read; use PNG, JPEG or TIFF"
_CUT = "the picture is damaged or cut short; copy or export it again"
IS_GREY = "a grey picture; the reference must be a colour photograph (RGB)"
_RGB, _YCBCR = 2, 6
_EXTRA = 338
_BITS, _SAMPLES, _PLANAR, _SEPARATE = 258, 277, 284, 2
_MOST_PLANES = 4
_MAX_FILE_BYTES = 2 << 30  # for OpenCV; MAX_PIXELS of four channels with 16 bits and no compression are less
# PNG, JPEG, GIF, BMP, RIFF: what Pillow does not take for one is damaged; OpenCV would take gigabytes for some of them.
_PILLOWS = (b"\x89PNG", b"\xff\xd8", b"GIF8", b"BM", b"RIFF")
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
_FLOATING = {
    b"#?RADIANCE": "Radiance HDR",
    b"#?RGBE": "Radiance HDR",
    b"PF\n": "PFM",
    b"Pf\n": "PFM",
    b"\x76\x2f\x31\x01": "OpenEXR",
}
ORIENTATION = 0x0112
TURNS = range(2, 9)  # EXIF's numbers of what does not lie upright
_SHORT = 3  # TIFF's number of 16-bit values


def opened(stream: BinaryIO, name: str) -> Image.Image | None:
    """The header, by Pillow; None where Pillow knows no such picture."""
    from PIL import Image, UnidentifiedImageError

    Image.init()
    formats = [kind for kind in _FORMATS if kind in Image.OPEN]
    if name.lower().endswith(".tga"):
        formats.append("TGA")
    try:
        return Image.open(stream, formats=formats)
    except UnidentifiedImageError:
        return None
    except Image.DecompressionBombError as error:
        raise InputError(_too_large(_one_line(error))) from error


def upright(values: np.ndarray, orientation: int | None) -> np.ndarray:
    """Undo an EXIF orientation of (h, w[, c])."""
    if orientation not in TURNS:
        return values
    if orientation >= 5:
        values = values.swapaxes(0, 1)
    rows = -1 if orientation in (3, 4, 7, 8) else 1
    columns = -1 if orientation in (2, 3, 6, 7) else 1
    return np.ascontiguousarray(values[::rows, ::columns])


def check_size(width: int, height: int) -> None:
    """Refuse more than MAX_PIXELS, and nothing at all.

    Raises:
        InputError: with the remedy.
    """
    if width * height > MAX_PIXELS:
        raise InputError(_too_large(f"{width} x {height} pixels"))
    if width < 1 or height < 1:
        raise InputError("it has no pixels; export it again")


def _too_large(what: str) -> str:
    limit = MAX_PIXELS // 1_000_000
    return f"{what}: more than {limit} megapixels are not read; make it smaller, 2000 pixels are enough"


def checked_unknown(stream: BinaryIO) -> dict:
    """Refuse, by its header, what OpenCV cannot read or not within bounds; else the tags, if it is a TIFF."""
    stream.seek(0)
    start = stream.read(16)
    if not start:
        raise InputError("the file is empty; copy or export it again")
    for magic, kind in _FLOATING.items():
        if start.startswith(magic):
            raise InputError(f"{kind} holds floating point; save it with 8 or 16 bits per channel, as PNG or TIFF")
    if start[4:8] == b"ftyp" and start[8:12] in _HEIF_BRANDS:
        raise InputError("a HEIC picture, as telephones store them; export it as JPEG or PNG")
    if start.startswith(_PILLOWS):
        raise InputError(_UNREADABLE)
    if start[:4] not in TIFF_STARTS:
        return {}
    tags = _tiff_tags(stream)
    width, height = tags.get(256), tags.get(257)
    if not isinstance(width, int) or not isinstance(height, int):
        raise InputError(_UNREADABLE)
    check_size(width, height)
    return tags


def _tiff_tags(stream: BinaryIO) -> dict:
    """Number -> value of the first directory."""
    import tifffile

    stream.seek(0)
    with decoding(), quiet_package("tifffile"), tifffile.TiffFile(stream, is_ome=False, _multifile=False) as file:
        return {tag.code: _plain(tag.value) for tag in file.pages[0].tags}


def _plain(value):
    """An array of numbers as the tuple that it is in other tags: comparing it would be no answer."""
    return tuple(value.tolist()) if isinstance(value, np.ndarray) else value


def _from_planes(stream: BinaryIO) -> np.ndarray:
    """A TIFF with a plane for each colour, at most four, which OpenCV reads wrongly."""
    import tifffile

    stream.seek(0)
    with decoding(), quiet_package("tifffile"):
        try:
            with tifffile.TiffFile(stream, is_ome=False, _multifile=False) as file:
                page = file.pages[0]
                if page.axes != "SYX" or page.shape[0] > _MOST_PLANES:
                    sizes = " x ".join(map(str, page.shape))
                    raise InputError(
                        f"a TIFF with more than the planes of one colour picture ({sizes}); save it as RGB"
                    )
                planes = page.asarray(maxworkers=1)
        except (ValueError, KeyError) as error:
            if "imagecodecs" in str(error):
                raise InputError(
                    "a TIFF with a packed plane for each colour; save it as an ordinary TIFF or PNG"
                ) from error
            raise
    values = np.moveaxis(planes, 0, -1)[..., [2, 1, 0, 3][: len(planes)]] if len(planes) > 2 else planes[0]
    return np.ascontiguousarray(values)


def check_strips(tags: dict, size: int) -> None:
    """Refuse a TIFF of which a part is not there: Pillow leaves it black, OpenCV as its memory was.

    Args:
        tags: number -> value of its directory.
        size: of the file in bytes.

    Raises:
        InputError: strips or tiles are fewer than its size needs, or lie outside the file.
    """
    with decoding():
        whole = _has_whole_strips(tags, size)
    if not whole:
        raise InputError(_CUT)


def _has_whole_strips(tags: dict, size: int) -> bool:
    width, height, rows = tags.get(256, 0), tags.get(257, 0), tags.get(278, tags.get(257, 0))
    bits = tags.get(258, (1,))
    bits = sum(bits) if isinstance(bits, tuple) else bits * tags.get(277, 1)
    planes = tags.get(277, 1) if tags.get(284, 1) == 2 else 1
    tiled = 324 in tags
    places, lengths = (_listed(tags.get(code, ())) for code in ((324, 325) if tiled else (273, 279)))
    needed = width * height * bits // (24 if tags.get(262) == _YCBCR else 8)  # its colours may be fewer than its pixels
    if places and not lengths:  # as some old files are
        lengths = (needed // len(places),) * len(places)
    if not places or len(places) != len(lengths) or min(rows, tags.get(322, 1), tags.get(323, 1)) < 1:
        return False
    count = -(-width // tags[322]) * -(-height // tags[323]) if tiled else -(-height // rows)
    packed = 1 if tags.get(259, 1) == 1 else TIFF_MAX_RATIO
    inside = all(place + length <= size for place, length in zip(places, lengths))
    return inside and len(places) >= count * planes and sum(lengths) * packed >= needed


def _listed(values) -> tuple:
    return values if isinstance(values, tuple) else (values,)


def exif_of(image: Image.Image) -> dict:
    """Orientation, and what tells the colour space; without what is damaged."""
    found: dict = {}
    for part in (None, *TAG_GROUPS):
        try:
            tags = image.getexif()
            found.update(tags if part is None else {part: dict(tags.get_ifd(part))})
        except MemoryError:
            raise
        except Exception as error:  # tags are written by many hands, and their reader promises nothing
            log.debug("EXIF: %s", _one_line(error))
    return found


def has_16_bits(image: Image.Image) -> bool:
    """Whether its channels are stored with 16 bits, of which Pillow gives 8 (and of planes of single colours none)."""
    if image.format == "TIFF" and image.mode in ("RGB", "RGBA", "RGBX"):
        return 16 in _listed(image.tag_v2.get(_BITS, 8))
    arguments = image.tile[0][3] if image.tile else ""
    raw = arguments if isinstance(arguments, str) else next((a for a in arguments or () if isinstance(a, str)), "")
    return image.mode in ("RGB", "RGBA") and image.format == "PNG" and ";16" in raw


def pages(image: Image.Image) -> tuple[str, ...]:
    """A note where a file holds several pictures; a camera's MPO holds previews beside the first, an icon sizes."""
    with decoding():
        count = 1 if image.format in ("MPO", "ICO", "ICNS") else getattr(image, "n_frames", 1)
    return (f"the first of {count} pictures in the file",) if count > 1 else ()


def by_opencv(stream: BinaryIO) -> np.ndarray:
    """(h, w, 3 or 4) uint8 or uint16 in the order B, G, R[, A], as it is stored."""
    values = stored_values(stream)
    if values.ndim == 2 or values.shape[2] < 3:
        raise InputError(IS_GREY)
    if values.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{values.dtype} channels; save it with 8 or 16 bits per channel")
    return values


def stored_values(stream: BinaryIO) -> np.ndarray:
    """(h, w) or (h, w, channels) of any type, as OpenCV gives what is stored, not turned; its size was checked before."""
    import cv2

    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    if not 0 < size <= _MAX_FILE_BYTES:
        raise InputError(_UNREADABLE)
    data = np.empty(size, np.uint8)
    data = data[: stream.readinto(data.data)]
    start = data[:4].tobytes()
    if start == b"\x89PNG" and not has_whole_chunks(memoryview(data)):
        raise InputError(_CUT)
    if start in TIFF_STARTS:
        tags = _tiff_tags(stream)
        check_strips(tags, size)
        if tags.get(_PLANAR) == _SEPARATE and tags.get(_SAMPLES, 1) > 1:
            return _without_extra(_from_planes(stream), tags)
    else:
        tags = {}
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    with decoding(), quiet_cv2(), quiet_stderr():
        values = cv2.imdecode(_as_stored(data), flags)
    if values is None:
        raise InputError(_UNREADABLE)
    check_size(*values.shape[1::-1])
    return _without_extra(values, tags)


def _without_extra(values: np.ndarray, tags: dict) -> np.ndarray:
    """Without a fourth channel that the header of a TIFF does not call transparency."""
    extra = _listed(tags.get(_EXTRA, ()))
    unknown = bool(extra) and extra[0] == 0 and tags.get(262) == _RGB
    return np.ascontiguousarray(values[..., :3]) if unknown and values.ndim == 3 and values.shape[2] == 4 else values


def _as_stored(data: np.ndarray) -> np.ndarray:
    """The bytes (n,) of a file. A TIFF's orientation becomes 1, in place: which ones OpenCV undoes depends on its version."""
    if data[:4].tobytes() not in TIFF_STARTS:
        return data
    order, big = ("<" if data[0] == ord("I") else ">"), ord("+") in data[2:4]
    count, width, offset, at, value = ("Q", 20, "Q", 8, 12) if big else ("H", 12, "I", 4, 8)
    (start,) = struct.unpack_from(order + offset, data, at)
    (entries,) = struct.unpack_from(order + count, data, start)
    start += struct.calcsize(count)
    for entry in range(start, min(start + entries * width, len(data) - width + 1), width):
        if struct.unpack_from(order + "HH", data, entry) == (ORIENTATION, _SHORT):
            struct.pack_into(order + "H", data, entry + value, 1)
    return data


@contextmanager
def decoding() -> Iterator[None]:
    """Whatever a decoder makes of a damaged file is told as that. Memory and interruptions pass."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # SyntaxError, struct.error, zlib.error, KeyError, ...: decoders promise nothing
        if is_out_of_memory(error):
            raise
        raise InputError(
            f"the picture is damaged or cut short ({_one_line(error)}); copy or export it again"
        ) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
