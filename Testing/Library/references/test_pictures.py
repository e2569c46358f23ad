"""Picture files become upright sRGB, whatever the way they are stored, and small before anything is computed."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO

import cv2
import numpy as np
import pytest
from pictures_samples import LOSSY, SHAPE, SRGB_D50, STORED, far, matrix_profile
from PIL import Image, ImageCms

from MedColorLib.errors import InputError
from MedColorLib.references.pictures import load_picture

ADOBE_D50 = np.array([[0.6097, 0.3111, 0.0195], [0.2053, 0.6257, 0.0609], [0.1492, 0.0632, 0.7446]])


def encoded(linear) -> np.ndarray:
    """The formula of IEC 61966-2-1."""
    linear = np.clip(linear, 0, 1)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def adobe_as_srgb(colors: np.ndarray) -> np.ndarray:
    """What values of Adobe RGB look like: matrix and curves in double precision, by the white of D50."""
    linear = (colors / 255.0) ** (563 / 256) @ ADOBE_D50 @ np.linalg.inv(SRGB_D50)
    return encoded(linear)


class TestOrientation:
    @pytest.mark.parametrize("number", STORED)
    @pytest.mark.parametrize("ending", [".jpg", ".png", ".tif", ".webp"])
    def test_turned_upright_whatever_the_number(self, colors, number, ending, tmp_path):
        exif = Image.Exif()
        exif[0x0112] = number
        path = tmp_path / f"p{ending}"
        options = {".jpg": {"quality": 98, "subsampling": 0}, ".webp": {"lossless": True}}.get(ending, {})
        Image.fromarray(np.ascontiguousarray(STORED[number](colors))).save(path, exif=exif, **options)
        picture = load_picture(path)
        assert far(picture.rgb, colors) <= LOSSY.get(ending, 0) and picture.shape == SHAPE
        assert any("turned upright" in note for note in picture.notes) == (number != 1)

    @pytest.mark.parametrize("number", [3, 6, 8])
    @pytest.mark.parametrize("ending", [".png", ".tif"])
    def test_sixteen_bits_are_turned_too(self, colors, number, ending, tmp_path):
        stored = np.ascontiguousarray(STORED[number](colors)[..., ::-1]).astype(np.uint16) * 257
        cv2.imwrite(str(tmp_path / f"p{ending}"), stored)
        data = (tmp_path / f"p{ending}").read_bytes()
        (tmp_path / f"p{ending}").write_bytes(
            png_with_exif(data, number) if ending == ".png" else tiff_turned(data, number)
        )
        assert far(load_picture(tmp_path / f"p{ending}").rgb, colors) == 0

    @pytest.mark.parametrize("number", [0, 9, 65535])
    def test_numbers_that_mean_nothing(self, colors, number, tmp_path):
        exif = Image.Exif()
        exif[0x0112] = number
        Image.fromarray(colors).save(tmp_path / "p.png", exif=exif)
        assert far(load_picture(tmp_path / "p.png").rgb, colors) == 0

    @pytest.mark.parametrize("content", [b"Exif\0\0II*\0\xff\xff\xff\x7f", b"Exif\0\0rubbish", b"Exif\0\0"])
    def test_damaged_tags_are_passed_over(self, colors, content, tmp_path):
        Image.fromarray(colors).save(tmp_path / "p.jpg", exif=content, quality=98, subsampling=0)
        assert far(load_picture(tmp_path / "p.jpg").rgb, colors) <= LOSSY[".jpg"]

    def test_transparency_is_turned_with_it(self, colors, tmp_path):
        alpha = np.full((*SHAPE, 1), 255, np.uint8)
        alpha[:, 50:] = 0
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(np.ascontiguousarray(np.rot90(np.dstack([colors, alpha])))).save(tmp_path / "p.png", exif=exif)
        picture = load_picture(tmp_path / "p.png")
        np.testing.assert_array_equal(picture.opaque, alpha[..., 0] > 0)
        assert far(picture.rgb[:, :50], colors[:, :50]) == 0


def png_with_exif(data: bytes, number: int) -> bytes:
    """The PNG with an eXIf chunk behind its pixels, where it may stand."""
    content = b"II*\0\x08\0\0\0" + struct.pack("<HHHII", 1, 0x0112, 3, 1, number) + bytes(4)
    chunk = struct.pack(">I", len(content)) + b"eXIf" + content + struct.pack(">I", zlib.crc32(b"eXIf" + content))
    return data[:-12] + chunk + data[-12:]


def tiff_turned(data: bytes, number: int) -> bytes:
    """OpenCV's little TIFF with its tag Orientation set."""
    at = struct.unpack_from("<I", data, 4)[0]
    count = struct.unpack_from("<H", data, at)[0]
    entries = [data[at + 2 + 12 * n : at + 14 + 12 * n] for n in range(count)]
    entries = [e for e in entries if struct.unpack_from("<H", e)[0] != 0x0112]
    entries.append(struct.pack("<HHIHH", 0x0112, 3, 1, number, 0))
    entries.sort(key=lambda e: struct.unpack_from("<H", e)[0])
    directory = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
    return data[:4] + struct.pack("<I", len(data)) + data[8:] + directory


class TestColors:
    def test_a_profile_is_applied(self, colors, tmp_path):
        profile = matrix_profile(ADOBE_D50, 563 / 256, "wide test profile")
        Image.fromarray(colors).save(tmp_path / "p.png", icc_profile=profile)
        picture = load_picture(tmp_path / "p.png")
        assert far(picture.rgb, adobe_as_srgb(colors)) <= 2
        assert far(picture.rgb, colors) > 15, "the test would not see it"
        assert picture.notes == ("converted from its colour profile (wide test profile) to sRGB",)

    def test_with_sixteen_bits_and_transparency(self, colors, tmp_path):
        profile = matrix_profile(ADOBE_D50, 563 / 256, "wide")
        rgba = np.dstack([colors, np.full(SHAPE, 255, np.uint8)])
        rgba[:5, :, 3] = 0
        Image.fromarray(rgba).save(tmp_path / "p.png", icc_profile=profile)
        Image.fromarray(rgba).save(tmp_path / "p.tif", icc_profile=profile)
        for name in ("p.png", "p.tif"):
            picture = load_picture(tmp_path / name)
            assert far(picture.rgb[5:], adobe_as_srgb(colors)[5:]) <= 2 and not picture.opaque[:5].any()

    def test_the_profile_of_srgb_changes_nothing(self, colors, tmp_path):
        profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
        Image.fromarray(colors).save(tmp_path / "p.png", icc_profile=profile)
        picture = load_picture(tmp_path / "p.png")
        assert far(picture.rgb, colors) == 0 and not picture.notes

    @pytest.mark.parametrize(
        "profile",
        [b"rubbish", bytes(200), matrix_profile(ADOBE_D50, 2.2, "other", b"CMYK")],
        ids=["text", "zeros", "CMYK"],
    )
    def test_a_profile_that_cannot_be_used_is_said(self, colors, profile, tmp_path):
        Image.fromarray(colors).save(tmp_path / "p.png", icc_profile=profile)
        picture = load_picture(tmp_path / "p.png")
        assert far(picture.rgb, colors) == 0 and "profile cannot be used" in picture.notes[0]

    def test_a_camera_set_to_adobe_rgb_embeds_no_profile(self, colors, tmp_path):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA001] = 0xFFFF
        exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
        Image.fromarray(colors).save(tmp_path / "p.jpg", quality=100, subsampling=0, exif=exif)
        picture = load_picture(tmp_path / "p.jpg")
        assert far(picture.rgb, adobe_as_srgb(colors)) <= 12 and "Adobe RGB" in picture.notes[0]

    @pytest.mark.parametrize("ending", [".jpg", ".tif"])
    def test_cmyk_without_a_profile(self, colors, ending, tmp_path):
        Image.fromarray(colors).convert("CMYK").save(tmp_path / f"p{ending}", quality=98)
        picture = load_picture(tmp_path / f"p{ending}")
        assert far(picture.rgb, colors) <= LOSSY.get(ending, 0) and "CMYK without" in picture.notes[0]

    def test_lab(self, colors, tmp_path):
        lab = cv2.cvtColor(colors.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
        values = np.dstack([lab[..., 0] * 2.55, lab[..., 1], lab[..., 2]]).round().astype(np.int16).astype(np.uint8)
        Image.frombytes("LAB", SHAPE[::-1], values.tobytes()).save(tmp_path / "p.tif")
        assert (
            np.abs(load_picture(tmp_path / "p.tif").rgb.astype(int) - colors).mean() < 8
        )  # OpenCV's white is D65, the file's D50

    def test_palette_and_its_transparency(self, colors, tmp_path):
        few = (colors // 64) * 64 + 32
        image = Image.fromarray(few).quantize(64)
        expected = np.array(image.convert("RGB"))
        image.save(tmp_path / "p.png")
        assert far(load_picture(tmp_path / "p.png").rgb, expected) == 0
        image.save(tmp_path / "t.png", transparency=image.getpixel((55, 35)))
        picture = load_picture(tmp_path / "t.png")
        assert not picture.opaque[35, 55] and picture.opaque[5, 5] and "transparent" in picture.notes[0]

    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    def test_transparent_is_told(self, colors, dtype, tmp_path):
        alpha = np.zeros(SHAPE, np.uint8)
        alpha[5:30, 5:50] = 255
        factor = 257 if dtype == np.uint16 else 1
        cv2.imwrite(str(tmp_path / "p.png"), np.dstack([colors[..., ::-1], alpha]).astype(dtype) * factor)
        picture = load_picture(tmp_path / "p.png")
        np.testing.assert_array_equal(picture.opaque, alpha > 0)
        assert far(picture.rgb[alpha > 0], colors[alpha > 0]) == 0 and not picture.rgb[alpha == 0].any()
        cv2.imwrite(str(tmp_path / "o.png"), np.dstack([colors[..., ::-1], np.full(SHAPE, 255)]).astype(dtype) * factor)
        assert load_picture(tmp_path / "o.png").opaque is None

    def test_nothing_but_transparent(self, colors, tmp_path):
        Image.fromarray(np.dstack([colors, np.zeros(SHAPE, np.uint8)])).save(tmp_path / "p.png")
        with pytest.raises(InputError, match="every pixel is transparent"):
            load_picture(tmp_path / "p.png")


def test_a_damaged_profile_of_any_length_never_ends_the_process(colors, tmp_path, rng):
    profile = matrix_profile(ADOBE_D50, 2.2, "test")
    for _ in range(60):
        broken = bytearray(profile)
        for at in rng.integers(0, len(broken), 6):
            broken[at] = rng.integers(0, 256)
        stream = BytesIO()
        Image.fromarray(colors).save(stream, "PNG", icc_profile=bytes(broken))
        (tmp_path / "p.png").write_bytes(stream.getvalue())
        assert load_picture(tmp_path / "p.png").rgb.shape == colors.shape
