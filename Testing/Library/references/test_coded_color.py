"""Colours that a PNG describes by numbers in place of a profile, and inks whose sense only Adobe's mark tells."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from pictures_samples import SRGB_D50, far, matrix_profile
from PIL import Image, ImageCms

from MedColorLib.errors import InputError
from MedColorLib.references.pictures import load_picture

# CSS Color 4, 10.3 and sample code: linear Display P3 and Adobe RGB to linear sRGB
P3 = np.array([[1.2249402, -0.2249402, 0], [-0.0420570, 1.0420570, 0], [-0.0196376, -0.0786360, 1.0982736]])
ADOBE = np.array([[1.3983557, -0.3983557, 0], [0, 1, 0], [0, -0.0429290, 1.0429290]])
P3_XY = (0.3127, 0.3290, 0.680, 0.320, 0.265, 0.690, 0.150, 0.060)
ADOBE_XY = (0.3127, 0.3290, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06)
SRGB_XY = (0.3127, 0.3290, 0.64, 0.33, 0.30, 0.60, 0.15, 0.06)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def gama(gamma: float) -> bytes:
    return chunk(b"gAMA", struct.pack(">I", round(gamma * 1e5)))


def chrm(xy: tuple[float, ...]) -> bytes:
    return chunk(b"cHRM", struct.pack(">8I", *(round(value * 1e5) for value in xy)))


def save(path: Path, colors: np.ndarray, *chunks: bytes, deep: bool = False) -> None:
    values = colors[..., ::-1].astype(np.uint16) * 257 if deep else colors[..., ::-1]
    data = cv2.imencode(".png", values)[1].tobytes()
    path.write_bytes(data[:33] + b"".join(chunks) + data[33:])


def linear(colors: np.ndarray) -> np.ndarray:
    levels = colors / 255.0
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def shown(light: np.ndarray) -> np.ndarray:
    light = np.clip(light, 0, 1)
    return np.rint(255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055))


@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize(
    "chunks, look, words",
    [
        ([gama(1.0)], lambda c: shown(c / 255), "gamma 1 of"),
        ([gama(1 / 1.8)], lambda c: shown((c / 255) ** 1.8), "gamma 0.556 of"),
        ([chrm(P3_XY)], lambda c: shown(linear(c) @ P3.T), "primary colours"),
        ([gama(1 / 2.2), chrm(P3_XY)], lambda c: shown(linear(c) @ P3.T), "primary colours"),
        ([chunk(b"cICP", bytes([12, 13, 0, 1]))], lambda c: shown(linear(c) @ P3.T), "primary colours"),
        ([gama(256 / 563), chrm(ADOBE_XY)], lambda c: shown(linear(c) @ ADOBE.T), "primary colours"),
        ([chunk(b"cICP", bytes([1, 8, 0, 1])), gama(1 / 2.2)], lambda c: shown(c / 255), "gamma 1 of"),
        ([gama(1.0), chrm(P3_XY)], lambda c: shown((c / 255) @ P3.T), "gamma 1 and the primary colours"),
    ],
)
def test_numbers_in_place_of_a_profile(chunks, look, words, deep, colors, tmp_path) -> None:
    save(tmp_path / "p.png", colors, *chunks, deep=deep)
    picture = load_picture(tmp_path / "p.png")
    assert far(picture.rgb, look(colors)) <= 2 and far(colors, look(colors)) > 8
    (note,) = picture.notes
    assert note.startswith("converted from the ") and words in note


@pytest.mark.parametrize(
    "chunks",
    [
        [gama(1 / 2.2), chrm(SRGB_XY)],
        [gama(0.4545), chunk(b"sRGB", b"\0")],
        [chunk(b"sRGB", b"\0"), gama(1.0), chrm(P3_XY)],
        [chunk(b"cICP", bytes([1, 13, 0, 1])), gama(1 / 2.2)],
        [chunk(b"cICP", bytes([1, 4, 0, 1]))],
        [chunk(b"cICP", bytes([1, 13, 0, 1])), gama(1.0), chrm(P3_XY)],
    ],
)
def test_srgb_changes_nothing(chunks, colors, tmp_path) -> None:
    save(tmp_path / "p.png", colors, *chunks)
    picture = load_picture(tmp_path / "p.png")
    assert far(picture.rgb, colors) == 0 and not picture.notes


def test_a_profile_goes_before_gamma(colors, tmp_path) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    save(tmp_path / "p.png", colors, chunk(b"iCCP", b"x\0\0" + zlib.compress(profile)), gama(1.0))
    assert far(load_picture(tmp_path / "p.png").rgb, colors) == 0


LIGHT = matrix_profile(SRGB_D50, 1.0, "Light")
ICCP = chunk(b"iCCP", b"x\0\0" + zlib.compress(LIGHT))


@pytest.mark.parametrize(
    "chunks, look, words",
    [
        ([], lambda c: c, "is not known: taken as sRGB"),
        ([ICCP, gama(1 / 1.8)], lambda c: shown(c / 255), "converted from its colour profile (Light)"),
        ([chunk(b"sRGB", b"\0"), gama(1.0)], lambda c: c, "is not known: what else its header says is used"),
        ([gama(1 / 1.8)], lambda c: shown((c / 255) ** 1.8), "gamma 0.556 of"),
        ([gama(1.0), chrm(P3_XY)], lambda c: shown((c / 255) @ P3.T), "gamma 1 and the primary colours"),
    ],
)
def test_codes_that_say_nothing_leave_it_to_the_rest(chunks, look, words, colors, tmp_path) -> None:
    """2: unspecified (ITU-T H.273)."""
    save(tmp_path / "p.png", colors, chunk(b"cICP", bytes([2, 2, 0, 1])), *chunks)
    picture = load_picture(tmp_path / "p.png")
    assert far(picture.rgb, look(colors)) <= 2
    assert "its colour space (cICP 2, 2, 0) is not known" in picture.notes[0] and words in picture.notes[-1]


@pytest.mark.parametrize(
    "codes, look, notes", [((1, 13), lambda c: c, 0), ((12, 13), lambda c: shown(linear(c) @ P3.T), 1)]
)
def test_codes_that_are_known_go_before_a_profile(codes, look, notes, colors, tmp_path) -> None:
    save(tmp_path / "p.png", colors, chunk(b"cICP", bytes([*codes, 0, 1])), ICCP)
    picture = load_picture(tmp_path / "p.png")
    assert far(picture.rgb, look(colors)) <= (2 if notes else 0) and len(picture.notes) == notes


@pytest.mark.parametrize(
    "chunks, words",
    [
        ([gama(0)], "gamma of its header (0) is not used"),
        ([gama(21000)], "gamma of its header (21000) is not used"),
        ([chrm((0.3, 0.3) * 4)], "(cHRM) are not used"),
        ([chrm((0.3127, 0.3290, 0, 0, 0, 0, 0, 0))], "(cHRM) are not used"),
        ([chunk(b"cICP", bytes([77, 99, 0, 1]))], "(cICP 77, 99, 0) is not known: taken as sRGB"),
    ],
)
def test_numbers_that_cannot_be_meant(chunks, words, colors, tmp_path) -> None:
    save(tmp_path / "p.png", colors, *chunks)
    picture = load_picture(tmp_path / "p.png")
    assert far(picture.rgb, colors) == 0 and words in picture.notes[0]


@pytest.mark.parametrize("code, name", [(16, "PQ"), (18, "HLG")])
def test_colors_for_brighter_screens_are_refused(code, name, colors, tmp_path) -> None:
    save(tmp_path / "p.png", colors, chunk(b"cICP", bytes([9, code, 0, 1])))
    with pytest.raises(InputError, match=rf"HDR screens \({name}\); save it as sRGB"):
        load_picture(tmp_path / "p.png")


def test_inks_of_a_jpeg_without_adobes_mark(colors, tmp_path) -> None:
    """Pillow writes inks turned round, with the mark; here they are stored plainly, and the mark is cut out."""
    inks = np.dstack([255 - colors, np.zeros(colors.shape[:2], np.uint8)])
    file = io.BytesIO()
    Image.frombytes("CMYK", inks.shape[1::-1], (255 - inks).tobytes()).save(file, "JPEG", quality=100)
    data = file.getvalue()
    at = data.index(b"\xff\xee")
    end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    assert b"Adobe" in data[at:end]
    (tmp_path / "p.jpg").write_bytes(data[:at] + data[end:])
    picture = load_picture(tmp_path / "p.jpg")
    assert far(picture.rgb, colors) <= 8 and "as it does not bear Adobe's mark" in picture.notes[0]
