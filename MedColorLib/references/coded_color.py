"""Colours by a gamma and primary colours, as a PNG without a profile gives them: cICP, sRGB, gAMA and cHRM (PNG 3, 4.3).

Screens show gamma 1/2.2 and sRGB alike, and programs write one for the other: both are taken as sRGB.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from ..color.lab import WHITE_XYZ, XYZ_TO_RGB, linear_to_srgb, srgb_to_linear
from ..errors import InputError
from ..io.label_picture import chunk_before_pixels

if TYPE_CHECKING:
    from PIL import Image

_SRGB = (0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06)  # x, y of white, red, green, blue
# ITU-T H.273: what the code numbers of cICP stand for
_PRIMARIES = {
    1: _SRGB,
    9: (0.3127, 0.3290, 0.708, 0.292, 0.170, 0.797, 0.131, 0.046),  # BT.2020
    12: (0.3127, 0.3290, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060),  # Display P3
}
_GAMMAS = {1: None, 4: None, 5: 1 / 2.8, 6: None, 8: 1.0, 13: None, 14: None, 15: None}  # None: as sRGB
_HDR = {16: "PQ", 18: "HLG"}
_SAME = 0.003  # of a chromaticity: programs round
_LIKE_SRGB = (0.43, 0.48)  # gammas that are taken as sRGB
_USABLE = (0.1, 10.0)
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


@dataclass(frozen=True)
class CodedColor:
    """How sample values became colours.

    Attributes:
        gamma: exponent from light to sample; None: as sRGB.
        primaries: x and y of white, red, green and blue; None: those of sRGB.
        notes: what cannot be used.
        before_profile: whether it is said by cICP, which goes before an embedded profile; the others do not.
    """

    gamma: float | None = None
    primaries: tuple[float, ...] | None = None
    notes: tuple[str, ...] = ()
    before_profile: bool = False


ADOBE_RGB = CodedColor(256 / 563, (0.3127, 0.3290, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06))


def png_color(image: Image.Image, stream: BinaryIO) -> CodedColor | None:
    """What the header says; None: sRGB, or nothing, or a profile says it.

    cICP goes before a profile, that before sRGB, and that before gAMA and cHRM (PNG 3, 4.3).

    Raises:
        InputError: colours for screens that are brighter than those of computers.
    """
    if image.format != "PNG":
        return None
    codes = _cicp(stream)
    known = codes and _of_codes(*codes)
    if known:
        return known
    notes = (_not_known(codes, image.info),) if codes else ()
    if "icc_profile" in image.info or "srgb" in image.info:
        return CodedColor(notes=notes) if notes else None
    gamma, primaries = image.info.get("gamma"), image.info.get("chromaticity")
    if gamma is not None and not _USABLE[0] <= gamma <= _USABLE[1]:
        notes += (f"the gamma of its header ({gamma:g}) is not used",)
        gamma = None
    if gamma is not None and _LIKE_SRGB[0] < gamma < _LIKE_SRGB[1]:
        gamma = None
    if primaries is not None and (len(primaries) != 8 or np.abs(np.subtract(primaries, _SRGB)).max() < _SAME):
        primaries = None
    if primaries is not None and not _is_triangle(primaries):
        primaries, notes = None, (*notes, "the primary colours of its header (cHRM) are not used")
    return CodedColor(gamma, primaries, notes) if gamma or primaries or notes else None


def decoded_color(rgb: np.ndarray, color: CodedColor) -> np.ndarray:
    """(h, w, 3) uint8 as sRGB."""
    if color.gamma is None and color.primaries is None:
        return rgb
    levels = np.linspace(0, 1, 256, dtype=np.float32)
    linear = srgb_to_linear(rgb) if color.gamma is None else (levels ** (1 / color.gamma))[rgb]
    if color.primaries is not None:
        linear = np.clip(linear @ _to_srgb(color.primaries).T.astype(np.float32), 0, 1)
    return np.rint(255 * linear_to_srgb(linear)).astype(np.uint8)


def words(color: CodedColor) -> tuple[str, ...]:
    """What was done, for the notes."""
    parts = [f"gamma {color.gamma:.3g}"] if color.gamma is not None else []
    parts += ["primary colours"] if color.primaries is not None else []
    said = f"converted from the {' and the '.join(parts)} of its PNG header to sRGB"
    return (*color.notes, *([said] if parts else []))


def _cicp(stream: BinaryIO) -> tuple[int, int, int] | None:
    """Code numbers of primaries, transfer and matrix, before the pixels; the stream stays where it is."""
    here = stream.tell()
    try:
        content = chunk_before_pixels(stream, b"cICP", 4)
    finally:
        stream.seek(here)
    return None if content is None else (content[0], content[1], content[2])


def _of_codes(primaries: int, transfer: int, matrix: int) -> CodedColor | None:
    """None: not known, or unspecified."""
    if transfer in _HDR:
        raise InputError(f"its colours are made for HDR screens ({_HDR[transfer]}); save it as sRGB")
    if primaries not in _PRIMARIES or transfer not in _GAMMAS or matrix:
        return None
    corners = _PRIMARIES[primaries]
    return CodedColor(_GAMMAS[transfer], None if corners == _SRGB else corners, before_profile=True)


def _not_known(codes: tuple[int, int, int], info: dict) -> str:
    others = {"icc_profile", "srgb", "gamma", "chromaticity"} & {*info}
    instead = "what else its header says is used" if others else "taken as sRGB"
    return f"its colour space (cICP {', '.join(map(str, codes))}) is not known: {instead}"


def _is_triangle(primaries: tuple[float, ...]) -> bool:
    white, *corners = np.reshape(primaries, (4, 2))
    sides = np.array([*corners, white])
    area = np.linalg.det(np.column_stack([sides[:3], np.ones(3)]))
    return bool(np.isfinite(sides).all() and (sides[:, 1] > 0).all() and abs(area) > 1e-3)


def _to_srgb(primaries: tuple[float, ...]) -> np.ndarray:
    """(3, 3) from linear values of these primaries to those of sRGB, whites made equal (Bradford)."""
    white, *corners = np.reshape(primaries, (4, 2))
    xyz = np.array([[x / y, 1, (1 - x - y) / y] for x, y in corners]).T
    xyz_white = np.array([white[0] / white[1], 1, (1 - white.sum()) / white[1]])
    xyz = xyz * np.linalg.solve(xyz, xyz_white)
    own = _BRADFORD @ WHITE_XYZ / (_BRADFORD @ xyz_white)
    adapted = np.linalg.inv(_BRADFORD) @ np.diag(own) @ _BRADFORD
    return XYZ_TO_RGB @ adapted @ xyz
