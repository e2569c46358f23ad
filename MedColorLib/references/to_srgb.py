"""Stage *references*: the colours of a decoded picture become sRGB, by its embedded profile or by its kind."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from .coded_color import ADOBE_RGB, CodedColor, decoded_color, words

if TYPE_CHECKING:
    from PIL import Image

_RELATIVE, _BLACK_POINT = 1, 0x2000  # rendering intent and flag of LittleCMS, as in image editors
_ROUNDING = 2  # 8-bit levels that a conversion from sRGB to sRGB may change
_EXIF, _COLOR_SPACE, _UNCALIBRATED, _ADOBE = 0x8769, 0xA001, 0xFFFF, 2
_INTEROP, _INTEROP_INDEX = 0xA005, 1
TAG_GROUPS = (_EXIF, _INTEROP)  # of EXIF, wanted here
_SPACES = {"RGB": "RGB ", "CMYK": "CMYK", "LAB": "Lab "}


def to_srgb(
    image: Image.Image, profile: bytes | None, exif: dict, png: CodedColor | None = None
) -> tuple[Image.Image, tuple[str, ...]]:
    """Colours as sRGB, and what was decided.

    Args:
        image: of mode RGB, CMYK or LAB.
        profile: embedded ICC profile, or None.
        exif: nested tags; a camera set to Adobe RGB says so there and embeds no profile (DCF).
        png: what the header of a PNG says in place of a profile, or before it.

    Returns:
        An image of mode RGB, and notes.
    """
    if png is not None and (png.before_profile or not profile):
        return _decoded(image, png), words(png)
    if profile:
        converted, notes = _by_profile(image, profile)
        return converted, (*(png.notes if png else ()), *notes)
    if image.mode == "LAB":
        return _from_lab(image), ()
    if image.mode == "CMYK":
        note = "CMYK without a colour profile, its colours are approximate: convert it to sRGB in an image editor"
        return image.convert("RGB"), (note,)
    if _is_adobe_rgb(exif):
        return _decoded(image, ADOBE_RGB), ("converted from Adobe RGB, which its EXIF names, to sRGB",)
    return image, ()


def _by_profile(image, profile: bytes) -> tuple[Image.Image, tuple[str, ...]]:
    from PIL import ImageCms

    try:
        source = ImageCms.ImageCmsProfile(BytesIO(profile))
        name = " ".join(ImageCms.getProfileDescription(source).split()) or "without a name"
        if source.profile.xcolor_space != _SPACES[image.mode]:
            raise ImageCms.PyCMSError(f"it is for {source.profile.xcolor_space.strip()}")
        made = ImageCms.profileToProfile(
            image, source, ImageCms.createProfile("sRGB"), _RELATIVE, outputMode="RGB", flags=_BLACK_POINT
        )
    except (ImageCms.PyCMSError, OSError, TypeError, ValueError) as error:
        converted, notes = to_srgb(image, None, {})
        why = " ".join(str(error).split())
        return converted, (f"its colour profile cannot be used ({why}): taken as sRGB", *notes)
    if image.mode == "RGB":
        change = np.abs(np.asarray(made, np.int16) - np.asarray(image, np.int16)).max(initial=0)
        if change <= _ROUNDING:
            return image, ()
    return made, (f"converted from its colour profile ({name}) to sRGB",)


def _from_lab(image) -> Image.Image:
    from PIL import ImageCms

    lab, srgb = ImageCms.createProfile("LAB"), ImageCms.createProfile("sRGB")
    return ImageCms.profileToProfile(image, lab, srgb, _RELATIVE, outputMode="RGB")


def _is_adobe_rgb(exif: dict) -> bool:
    space, index = exif.get(_EXIF, {}).get(_COLOR_SPACE), exif.get(_INTEROP, {}).get(_INTEROP_INDEX)
    return space == _ADOBE or (space == _UNCALIBRATED and str(index)[:3] == "R03")


def _decoded(image, color: CodedColor) -> Image.Image:
    from PIL import Image

    return Image.fromarray(decoded_color(np.asarray(image.convert("RGB")), color))
