"""Label pictures: the stored numbers of grey and palette PNG files, whatever a picture reader would make of them."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from MedColorLib.errors import InputError
from MedColorLib.io.label_picture import read_label_picture


class TestLabelPicture:
    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    def test_grey(self, tmp_path, rng, dtype):
        values = rng.integers(0, np.iinfo(dtype).max + 1, (13, 17)).astype(dtype)
        cv2.imwrite(str(tmp_path / "a.png"), values)
        found = read_label_picture(tmp_path / "a.png")
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, values)

    @pytest.mark.parametrize("bits", [1, 2, 4, 8])
    @pytest.mark.parametrize("palette", [True, False])
    def test_palette_and_grey_of_few_bits_keep_their_numbers(self, tmp_path, rng, bits, palette):
        values = rng.integers(0, 1 << bits, (11, 13)).astype(np.uint8)
        (tmp_path / "a.png").write_bytes(png(values, bits, palette, rng))
        np.testing.assert_array_equal(read_label_picture(tmp_path / "a.png"), values)

    def test_what_is_no_label_picture(self, tmp_path, rng):
        cv2.imwrite(str(tmp_path / "color.png"), rng.integers(0, 255, (5, 5, 3), np.uint8))
        cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((5, 5), np.uint8))
        whole = png(np.zeros((5, 5), np.uint8), 8, True, rng)
        (tmp_path / "cut.png").write_bytes(whole[:20])
        (tmp_path / "hollow.png").write_bytes(whole[:33])
        for name, words in (
            ("color.png", "a colour picture"),
            ("a.jpg", "not a PNG"),
            ("cut.png", "damaged"),
            ("hollow.png", "damaged"),
            ("none.png", "no file"),
        ):
            with pytest.raises(InputError, match=words):
                read_label_picture(tmp_path / name)


def test_more_pixels_than_a_photograph_may_have_are_refused_by_the_header(tmp_path, monkeypatch):
    whole = bytearray(png(np.zeros((4, 4), np.uint8), 8, False, np.random.default_rng(0)))
    whole[16:24] = struct.pack(">II", 40_000, 20_000)
    (tmp_path / "bomb.png").write_bytes(whole)
    monkeypatch.setattr("cv2.imdecode", lambda *_: pytest.fail("was decoded"))
    with pytest.raises(InputError, match=r"bomb\.png: 40000 x 20000 pixels, more than 178 megapixels"):
        read_label_picture(tmp_path / "bomb.png")


def png(values, bits, palette, rng) -> bytes:
    """A PNG by the letter of its specification: one number per pixel, packed, with a palette of chance colours."""

    def chunk(what, content):
        return struct.pack(">I", len(content)) + what + content + struct.pack(">I", zlib.crc32(what + content))

    packed = [np.packbits(np.unpackbits(row[:, None], axis=1)[:, 8 - bits :].ravel()).tobytes() for row in values]
    header = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], bits, 3 if palette else 0, 0, 0, 0)
    colors = chunk(b"PLTE", rng.integers(0, 256, 3 << bits, np.uint8).tobytes()) if palette else b""
    data = chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row for row in packed)))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"gAMA", struct.pack(">I", 45455))
        + colors
        + data
        + chunk(b"IEND", b"")
    )
