"""Stage *references*: a picture file becomes upright sRGB of 8 bits, made small before anything is computed with it.

Pillow reads the header first (size, orientation, colour profile), then the pixels, of a JPEG at a half to an eighth of its
size where that is enough. OpenCV reads what Pillow does not: 16 bits a channel, and rarer kinds of TIFF.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from ..device import is_out_of_memory
from ..errors import InputError
from ..io.quiet import quiet_package, quiet_stderr
from ..io.voxel_data import natural_key
from .coded_color import CodedColor, png_color
from .decoding import (
    IS_GREY,
    ORIENTATION,
    TURNS,
    by_opencv,
    check_size,
    check_strips,
    checked_unknown,
    decoding,
    exif_of,
    has_16_bits,
    opened,
    pages,
    upright,
)
from .to_srgb import to_srgb

if TYPE_CHECKING:
    from PIL import Image

# What a folder is searched for; a file that is named is known by its content. EPS and PDF are programs, not pictures.
# fmt: off
PICTURE_SUFFIXES = (
    ".png", ".apng", ".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".tif", ".tiff", ".bmp", ".dib", ".webp", ".avif",
    ".gif", ".jp2", ".j2k", ".jpx", ".jpc", ".jpf", ".ppm", ".pnm", ".pxm", ".pam", ".tga", ".psd", ".sgi", ".rgb",
    ".rgba", ".ras", ".sr", ".sun", ".pcx", ".qoi", ".dds", ".ico", ".icns", ".hdr", ".pic", ".exr", ".pfm", ".heic",
    ".heif",
)
# fmt: on
LONG_SIDE_PX = 2048  # of what is read; the body in it is cut out and made smaller still (`library.LONG_SIDE_PX`)

_GREY = ("1", "L", "LA", "La", "I", "F")  # and I;16 of several orders of bytes
_TURNED = "turned upright, as the orientation in its header says"
_BAND_BYTES = 16 << 20  # of rows that are made smaller together
_PROFILE = 34675  # the tag of an embedded ICC profile
_TRANSPARENT = 127  # of 255, and below


@dataclass(frozen=True)
class Picture:
    """A picture as people see it.

    Attributes:
        rgb: (h, w, 3) uint8 sRGB, upright; black where it is transparent.
        opaque: (h, w) bool, False where it is transparent; None where nothing is.
        shape: (H, W) of the whole picture, upright, before it was made smaller.
        notes: what was decided, one clause each.
    """

    rgb: np.ndarray
    opaque: np.ndarray | None
    shape: tuple[int, int]
    notes: tuple[str, ...] = ()


def read_picture(path: str | os.PathLike, long_side: int | None = None) -> np.ndarray:
    """The colours alone of `load_picture`, (h, w, 3) uint8 sRGB; of the whole size where no longest side is given."""
    return load_picture(path, long_side).rgb


def load_picture(path: str | os.PathLike, long_side: int | None = LONG_SIDE_PX) -> Picture:
    """Read a colour picture, turned as EXIF or TIFF says, its colour profile applied, at most `long_side` pixels long.

    Raises:
        InputError: missing, unreadable, cut short, too large, transparent, floating point, or grey (a reference must have
            colour).
    """
    name = os.path.basename(os.fspath(path))
    if not os.path.isfile(path):
        raise InputError(f"reference: no file {path}")
    try:
        with open(path, "rb") as stream, quiet_package("PIL"):
            return _read(stream, name, long_side)
    except InputError as error:
        raise InputError(f"reference {name}: {error}") from error
    except OSError as error:
        if is_out_of_memory(error):
            raise
        raise InputError(f"reference {name}: cannot be read ({error.strerror}); check the permissions") from error


def reduced(rgb: np.ndarray, long_side: int) -> np.ndarray:
    """A picture (h, w, 3) uint8 that is in memory, at most `long_side` pixels long; the array itself where it is already."""
    from PIL import Image

    if max(rgb.shape) <= long_side:
        return rgb

    def rows(top: int, end: int) -> Image.Image:
        return Image.fromarray(np.ascontiguousarray(rgb[top:end]))

    return np.array(_smaller(rgb.shape[1::-1], rows, long_side))


def pictures_in(folder: Path, below: bool = False) -> list[Path]:
    """The pictures of a folder (and of those below it) by their endings, in natural order; hidden files are none."""
    found = folder.rglob("*") if below else folder.iterdir()
    files = [p for p in found if p.suffix.lower() in PICTURE_SUFFIXES and not p.name.startswith(".") and p.is_file()]
    return sorted(files, key=lambda file: natural_key(file.relative_to(folder)))


def _read(stream: BinaryIO, name: str, long_side: int | None) -> Picture:
    with decoding():
        image = opened(stream, name)
    if image is None:
        tags = checked_unknown(stream)
        about = _About(profile=tags.get(_PROFILE), exif=tags)
        return _picture(by_opencv(stream), about, long_side)
    check_size(*image.size)
    whole, is_tiff, is_deep = image.size, image.format == "TIFF", has_16_bits(image)
    about = _About(
        profile=image.info.get("icc_profile"),
        notes=pages(image),
        png=png_color(image, stream),
        plain_inks=image.mode == "CMYK" and image.format in ("JPEG", "MPO") and "adobe" not in image.info,
    )
    if is_tiff:  # Pillow turns a TIFF while it loads it, and forgets how; of a PNG, EXIF may follow the pixels
        check_strips(dict(image.tag_v2), os.fstat(stream.fileno()).st_size)
        about = replace(about, exif=exif_of(image))
    if long_side and max(whole) > long_side:
        image.draft(None, _fitting(whole, long_side))
    damage = _loaded(image) if not (is_tiff and is_deep) else None
    if damage and not is_tiff:
        raise damage
    if damage or is_deep:
        about = about if is_tiff else replace(about, exif=exif_of(image))
        del image
        return _picture(by_opencv(stream), about, long_side)
    if is_tiff:
        return _picture(image, about.turned_already(), long_side)
    return _picture(image, replace(about, exif=exif_of(image)), long_side, whole)


def _loaded(image: Image.Image) -> InputError | None:
    """Decode the pixels; returns why that cannot be done."""
    try:
        with decoding(), quiet_stderr() if image.format == "TIFF" else nullcontext():
            image.load()
    except InputError as error:
        return error
    return None


@dataclass(frozen=True)
class _About:
    """What the header says of the pixels: ICC profile, tags, notes; the tags' orientation is still to be undone.

    `plain_inks`: CMYK that Pillow has turned round, as Adobe's programs store it, though nothing says that they did.
    """

    profile: bytes | None = None
    exif: dict = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    png: CodedColor | None = None
    plain_inks: bool = False

    @property
    def turned(self) -> int | None:
        """EXIF's number of what does not lie upright, or None."""
        number = self.exif.get(ORIENTATION)
        return number if number in TURNS else None

    def turned_already(self) -> _About:
        """The same of pixels that lie upright now."""
        notes = (_TURNED, *self.notes) if self.turned else self.notes
        return replace(self, exif={**self.exif, ORIENTATION: 1}, notes=notes)


def _picture(decoded: Image.Image | np.ndarray, about: _About, long_side: int | None, whole=None) -> Picture:
    """Everything after decoding: smaller, sRGB, upright.

    Args:
        whole: (width, height) as stored, where the decoder has made it smaller.
    """
    if isinstance(decoded, np.ndarray):
        whole = decoded.shape[1::-1]
        small = _smaller(whole, lambda top, end: _eight_bits(decoded[top:end]), long_side)
    else:
        whole, mode = whole or decoded.size, _mode(decoded)
        small = _smaller(decoded.size, lambda top, end: _rows(decoded, mode, top, end), long_side)
    opaque, notes = None, about.notes
    if small.mode == "RGBA":
        opaque = np.asarray(small.getchannel("A")) > _TRANSPARENT
        small = small.convert("RGB")
        if not opaque.any():
            raise InputError("every pixel is transparent; save it without transparency")
        if opaque.all():
            opaque = None
        else:
            notes += (f"{100 * (1 - opaque.mean()):.0f} % of it is transparent, which is no tissue",)
    if max(small.size) < max(whole):
        notes += (f"{whole[0]} x {whole[1]} pixels, read as {small.width} x {small.height}",)
    if about.plain_inks:
        from PIL import ImageChops

        small = ImageChops.invert(small)
        notes += ("its inks are taken as they are stored, as it does not bear Adobe's mark",)
    srgb, said = to_srgb(small, about.profile, about.exif, about.png)
    rgb = np.array(srgb)
    if opaque is not None:
        rgb[~opaque] = 0
    if about.turned:
        rgb, opaque = upright(rgb, about.turned), opaque if opaque is None else upright(opaque, about.turned)
        whole = whole[::-1] if about.turned >= 5 else whole
        notes = (_TURNED, *notes)
    return Picture(rgb, opaque, whole[::-1], notes + said)


def _mode(image: Image.Image) -> str:
    """The mode in which its rows are made smaller."""
    if image.mode in _GREY or image.mode.startswith("I;16"):
        raise InputError(IS_GREY)
    if image.mode in ("CMYK", "LAB"):
        return image.mode
    return "RGBA" if image.mode in ("RGBA", "RGBa", "PA") or "transparency" in image.info else "RGB"


def _rows(image: Image.Image, mode: str, top: int, end: int) -> Image.Image:
    part = image if (top, end) == (0, image.height) else image.crop((0, top, image.width, end))
    return part if part.mode == mode and "transparency" not in part.info else part.convert(mode)


def _eight_bits(values: np.ndarray) -> Image.Image:
    from PIL import Image

    if values.dtype == np.uint16:
        values = ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)
    return Image.fromarray(np.ascontiguousarray(values[..., [2, 1, 0, 3][: values.shape[2]]]))


def _smaller(size: tuple[int, int], band: Callable[[int, int], Image.Image], long_side: int | None) -> Image.Image:
    """The mean of what each pixel covers; `band(top, end)` gives rows of the picture. Transparent pixels do not count."""
    from PIL import Image

    width, height = size
    if not long_side or max(size) <= long_side:
        return band(0, height)
    factor = max(size) // long_side  # whole pixels first, a few rows at a time
    rows = max(1, _BAND_BYTES // (4 * width * factor)) * factor
    joined = None
    for top in range(0, height, rows):
        piece = band(top, min(top + rows, height))
        piece = (piece.convert("RGBa") if piece.mode == "RGBA" else piece).reduce(factor)
        joined = joined or Image.new(piece.mode, (piece.width, -(-height // factor)))
        joined.paste(piece, (0, top // factor))
    covered = (0, 0, width / factor, height / factor)  # then by a triangle, which knows parts of pixels
    small = joined.resize(_fitting(size, long_side), Image.Resampling.BILINEAR, box=covered)
    return small.convert("RGBA") if small.mode == "RGBa" else small


def _fitting(size: tuple[int, int], long_side: int) -> tuple[int, int]:
    """Width and height of the same shape, the longer one `long_side`."""
    scale = long_side / max(size)
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
