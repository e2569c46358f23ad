"""Picture files of every format and size: read within bounds, made small by the mean, refused in one sentence."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest
from pictures_samples import LOSSY, SHAPE, STORED, far
from PIL import Image

from MedColorLib.errors import InputError
from MedColorLib.references import decoding
from MedColorLib.references.decoding import stored_values
from MedColorLib.references.pictures import LONG_SIDE_PX, load_picture, pictures_in, reduced

ENDINGS = ("png", "jpg", "jpe", "jfif", "tif", "tiff", "bmp", "dib", "gif", "webp", "jp2", "ppm", "sgi", "pcx", "tga")
ENDINGS += ("qoi", "dds", "ico", "ras", "avif")


def header_of_png(width: int, height: int, kind: int = 2) -> bytes:
    """A PNG that promises so many pixels and holds next to none."""
    header = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    parts = [struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


class TestFormats:
    @pytest.mark.parametrize("ending", ENDINGS)
    def test_by_name_and_in_a_folder(self, colors, ending, tmp_path):
        path = tmp_path / f"p.{ending}"
        write = {"ras": lambda: cv2.imwrite(str(path), colors[..., ::-1])}.get(
            ending, lambda: Image.fromarray(colors).save(path, **({"sizes": [SHAPE[::-1]]} if ending == "ico" else {}))
        )
        try:
            write()
        except (OSError, KeyError, ValueError) as error:
            pytest.skip(f"Pillow cannot write {ending} here: {error}")
        assert pictures_in(tmp_path) == [path]
        found = load_picture(path).rgb
        assert found.shape == colors.shape and np.abs(found.astype(int) - colors).mean() < 8
        path.rename(tmp_path / "without")
        if ending != "tga":  # it has no mark of its own
            np.testing.assert_array_equal(load_picture(tmp_path / "without").rgb, found)

    @pytest.mark.parametrize("mode", ["L", "LA", "1", "I;16", "I", "F"])
    def test_grey(self, colors, mode, tmp_path):
        path = tmp_path / ("p.png" if mode == "LA" else "p.tif")
        Image.fromarray(colors).convert("L").convert(mode).save(path)
        with pytest.raises(InputError, match="a grey picture; the reference must be a colour photograph"):
            load_picture(path)

    def test_several_pictures_in_a_file(self, colors, tmp_path):
        first, second = Image.fromarray(colors), Image.fromarray(colors[::-1])
        first.save(tmp_path / "p.tif", save_all=True, append_images=[second])
        picture = load_picture(tmp_path / "p.tif")
        assert far(picture.rgb, colors) == 0 and picture.notes == ("the first of 2 pictures in the file",)

    def test_a_camera_with_a_preview_behind_the_picture(self, colors, tmp_path):
        small = Image.fromarray(colors).resize((30, 20))
        Image.fromarray(colors).save(
            tmp_path / "p.mpo", save_all=True, append_images=[small], quality=98, subsampling=0
        )
        picture = load_picture(tmp_path / "p.mpo")
        assert far(picture.rgb, colors) <= LOSSY[".jpg"] and not picture.notes

    def test_a_tiff_that_pillow_does_not_know(self, colors, tmp_path, monkeypatch):
        """OpenCV reads it, and is told nothing that the header does not promise."""
        Image.fromarray(np.ascontiguousarray(STORED[6](colors))).save(tmp_path / "p.tif", tiffinfo={0x0112: 6})
        monkeypatch.setattr(decoding, "_FORMATS", ("PNG",))
        assert far(load_picture(tmp_path / "p.tif").rgb, colors) == 0
        monkeypatch.setattr(decoding, "MAX_PIXELS", 2000)
        monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
        with pytest.raises(InputError, match="more than"):
            load_picture(tmp_path / "p.tif")

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            (b"\0\0\0\x18ftypheic" + bytes(100), "HEIC picture, as telephones store them; export it as JPEG or PNG"),
            (b"#?RADIANCE\n" + bytes(100), "floating point; save it with 8 or 16 bits"),
            (b"PF\n2 2\n-1.0\n" + bytes(48), "floating point"),
            (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "not a picture that can be read"),
            (b"%PDF-1.4\n", "not a picture that can be read"),
            (b"", "the file is empty; copy or export it again"),
            (bytes(4000), "not a picture that can be read"),
            (b"II*\0\x08\0\0\0" + bytes(60), "not a picture that can be read|damaged"),
            (b"GIF89a" + bytes(3), "not a picture that can be read|damaged"),
        ],
    )
    def test_what_is_no_picture_for_us(self, content, words, tmp_path, capfd):
        (tmp_path / "p.png").write_bytes(content)
        with pytest.raises(InputError, match=rf"reference p\.png: .*({words})"):
            load_picture(tmp_path / "p.png")
        assert capfd.readouterr().err == ""

    @pytest.mark.parametrize("damage", [5, 12, 30, 44])
    def test_a_damaged_header_never_reaches_opencv(self, colors, damage, tmp_path, monkeypatch, capfd):
        """It took 4 GB for a PNG of 60 x 40 pixels with one wrong byte."""
        monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was given to OpenCV"))
        Image.fromarray(colors).save(tmp_path / "p.png")
        data = bytearray((tmp_path / "p.png").read_bytes())
        data[damage] ^= 0xFF
        (tmp_path / "p.png").write_bytes(data)
        with pytest.raises(InputError, match=r"reference p\.png: "):
            load_picture(tmp_path / "p.png")
        assert capfd.readouterr().err == ""

    @pytest.mark.parametrize("dtype", ["u1", "u2"])
    @pytest.mark.parametrize("kind", ["strips", "planar", "tiles", "packed", "big"])
    def test_a_tiff_of_which_a_part_is_not_there(self, kind, dtype, colors, tmp_path):
        """Pillow would leave it black, OpenCV as its memory was."""
        import tifffile

        options = {"strips": {"rowsperstrip": 7}, "planar": {"planarconfig": "separate"}, "tiles": {"tile": (16, 16)}}
        options |= {"packed": {"compression": "zlib"}, "big": {"bigtiff": True}}
        values = colors.astype(dtype) * (257 if dtype == "u2" else 1)
        values = np.moveaxis(values, -1, 0) if kind == "planar" else values
        tifffile.imwrite(tmp_path / "p.tif", values, photometric="rgb", **options[kind])
        data = (tmp_path / "p.tif").read_bytes()
        assert far(load_picture(tmp_path / "p.tif").rgb, colors) == 0
        for length in (len(data) * 2 // 3, len(data) - 3):
            (tmp_path / "p.tif").write_bytes(data[:length])
            with pytest.raises(InputError, match=r"reference p\.tif: the picture is damaged or cut short"):
                load_picture(tmp_path / "p.tif")
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            at, wide = file.pages[0].tags[257].valueoffset, file.pages[0].tags[257].dtype
        more = struct.pack("<H" if wide == 3 else "<I", 4000)
        (tmp_path / "p.tif").write_bytes(data[:at] + more + data[at + len(more) :])
        with pytest.raises(InputError, match="damaged or cut short"):
            load_picture(tmp_path / "p.tif")

    def test_a_tiff_that_names_bits_by_the_thousand(self, tmp_path):
        """Tags so long are arrays, which cannot be compared with a number."""
        import tifffile

        tifffile.imwrite(tmp_path / "p.tif", np.zeros((60, 60, 3), np.uint8), photometric="rgb")
        data = (tmp_path / "p.tif").read_bytes()
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            at = file.pages[0].tags[258].offset + 4
        with pytest.raises(InputError, match="damaged or cut short"):
            stored_values(io.BytesIO(data[:at] + struct.pack("<I", 3075) + data[at + 4 :]))

    @pytest.mark.parametrize("channels", [3, 4])
    @pytest.mark.parametrize("compression", [None, "zlib"])
    def test_planes_of_single_colours_with_sixteen_bits(self, compression, channels, colors, tmp_path):
        """OpenCV takes them for pixels."""
        import tifffile

        values = np.dstack([colors, np.full(SHAPE, 255, np.uint8)])[..., :channels].astype(np.uint16) * 257
        extra = {"extrasamples": ["unassalpha"]} if channels == 4 else {}
        planes, options = np.moveaxis(values, -1, 0), {"photometric": "rgb", "planarconfig": "separate", **extra}
        tifffile.imwrite(tmp_path / "p.tif", planes, compression=compression, **options)
        assert far(load_picture(tmp_path / "p.tif").rgb, colors) == 0

    @pytest.mark.parametrize("dtype", ["u1", "u2"])
    @pytest.mark.parametrize("channels, depth", [(5, 1), (300, 1), (3, 8)])
    def test_more_planes_than_colours_are_never_decoded(self, channels, depth, dtype, tmp_path, monkeypatch):
        """Their number is not in the size of the picture, and would multiply the memory that this bounds."""
        import tifffile

        planes = np.zeros((channels, depth, *SHAPE), dtype)
        options = {"photometric": "rgb", "planarconfig": "separate", "volumetric": depth > 1}
        tifffile.imwrite(tmp_path / "p.tif", planes if depth > 1 else planes[:, 0], **options)
        reached: list = []
        monkeypatch.setattr(tifffile.TiffPage, "asarray", lambda *_, **__: reached.append(1))
        with pytest.raises(InputError, match=r"reference p\.tif: a TIFF with .* save it as RGB"):
            load_picture(tmp_path / "p.tif")
        assert not reached

    @pytest.mark.parametrize("order", ["<", ">"])
    @pytest.mark.parametrize("dtype", ["u1", "u2"])
    @pytest.mark.parametrize("big", [False, True])
    def test_a_fourth_channel_of_a_tiff_that_is_no_transparency(self, big, dtype, order, colors, tmp_path):
        import tifffile

        values = np.dstack([colors, np.zeros(SHAPE, np.uint8)]).astype(dtype) * (257 if dtype == "u2" else 1)
        options = {"photometric": "rgb", "extrasamples": ["unspecified"], "bigtiff": big, "byteorder": order}
        tifffile.imwrite(tmp_path / "p.tif", values, **options)
        picture = load_picture(tmp_path / "p.tif")
        assert far(picture.rgb, colors) == 0 and picture.opaque is None

    @pytest.mark.parametrize("length", [0x7FFFFFFF, 0x10000000])
    def test_a_chunk_longer_than_the_file_never_reaches_opencv(self, length, colors, tmp_path, monkeypatch):
        """It would take as much memory as the chunk says that it holds."""
        data = cv2.imencode(".png", colors.astype(np.uint16) * 257)[1].tobytes()
        at = data.index(b"IDAT") - 4
        (tmp_path / "p.png").write_bytes(data[:at] + struct.pack(">I", length) + data[at + 4 :])
        reached: list = []
        monkeypatch.setattr(cv2, "imdecode", lambda *_: reached.append(1))
        with pytest.raises(InputError, match="damaged or cut short"):
            load_picture(tmp_path / "p.png")
        assert not reached

    @pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate", "jpeg"])
    def test_a_damaged_tiff_is_told_in_one_sentence(self, compression, tmp_path, capfd, rng):
        noise = rng.integers(0, 256, (60, 80, 3), np.uint8)
        Image.fromarray(noise).save(tmp_path / "p.tif", compression=compression)
        data = bytearray((tmp_path / "p.tif").read_bytes())
        data[200:] = bytes(len(data) - 200)
        (tmp_path / "p.tif").write_bytes(data)
        with pytest.raises(InputError, match=r"reference p\.tif: "):
            load_picture(tmp_path / "p.tif")
        assert capfd.readouterr().err == ""

    @pytest.mark.parametrize("ending", ["png", "jpg", "tif", "bmp", "webp", "jp2", "ppm", "gif"])
    def test_cut_short_anywhere(self, colors, ending, tmp_path, capfd):
        noise = np.random.default_rng(1).integers(0, 256, (50, 50, 3), np.uint8)
        Image.fromarray(noise).save(tmp_path / f"p.{ending}")
        data = (tmp_path / f"p.{ending}").read_bytes()
        for share in (0.01, 0.1, 0.3, 0.6, 0.9):
            (tmp_path / "cut").write_bytes(data[: int(share * len(data))])
            with pytest.raises(InputError, match="reference cut: "):
                load_picture(tmp_path / "cut")
        assert capfd.readouterr().err == ""


class TestSize:
    @pytest.mark.parametrize(
        "content",
        [header_of_png(50_000, 50_000), header_of_png(20_000, 10_000), header_of_png(2**31 - 1, 2**31 - 1)],
        ids=["2500 MP", "200 MP", "2^62"],
    )
    def test_a_bomb_is_refused_by_its_header(self, content, tmp_path, monkeypatch):
        (tmp_path / "bomb.png").write_bytes(content)
        monkeypatch.setattr(Image.Image, "load", lambda self: pytest.fail("was decoded"))
        monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
        with pytest.raises(InputError, match=r"bomb\.png: .*more than 178 megapixels are not read; make it smaller"):
            load_picture(tmp_path / "bomb.png")

    def test_pillows_own_limit_does_not_matter(self, colors, tmp_path, monkeypatch):
        Image.fromarray(colors).save(tmp_path / "p.png")
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", None)
        assert far(load_picture(tmp_path / "p.png").rgb, colors) == 0
        (tmp_path / "bomb.png").write_bytes(header_of_png(20_000, 10_000))
        with pytest.raises(InputError, match="20000 x 10000 pixels: more than 178 megapixels"):
            load_picture(tmp_path / "bomb.png")

    @pytest.mark.parametrize(("ending", "tolerance"), [(".png", 1), (".tif", 1), (".jpg", 7)])
    @pytest.mark.parametrize("size", [(5000, 3100), (2300, 1500), (700, 9001)])
    def test_made_smaller_by_the_mean(self, colors, ending, tolerance, size, tmp_path):
        large = cv2.resize(colors, size, interpolation=cv2.INTER_LINEAR)
        Image.fromarray(large).save(tmp_path / f"p{ending}", **({"quality": 95} if ending == ".jpg" else {}))
        picture = load_picture(tmp_path / f"p{ending}")
        assert max(picture.rgb.shape) == LONG_SIDE_PX and picture.shape == size[::-1]
        expected = cv2.resize(large, picture.rgb.shape[1::-1], interpolation=cv2.INTER_AREA)
        assert far(picture.rgb, expected) <= tolerance + 2 * (size[0] < 1000)  # 159 pixels stand for 159.2
        assert f"{size[0]} x {size[1]} pixels, read as" in picture.notes[0]
        if ending == ".png":
            np.testing.assert_array_equal(reduced(large, LONG_SIDE_PX), picture.rgb)

    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    def test_colors_of_transparent_pixels_do_not_bleed(self, dtype, tmp_path):
        rgba = np.zeros((3000, 4500, 4), np.uint8)
        rgba[...] = (0, 255, 0, 0)
        rgba[500:2502, 700:3703] = (20, 40, 160, 255)  # B, G, R, A
        cv2.imwrite(str(tmp_path / "p.png"), rgba.astype(dtype) * (257 if dtype == np.uint16 else 1))
        picture = load_picture(tmp_path / "p.png")
        assert np.abs(picture.rgb[picture.opaque].astype(int) - (160, 40, 20)).max() <= 1
        assert picture.opaque.mean() == pytest.approx(2002 * 3003 / (3000 * 4500), rel=0.002)

    def test_turned_and_made_smaller(self, colors, tmp_path):
        exif = Image.Exif()
        exif[0x0112] = 6
        large = cv2.resize(colors, (4500, 3000))
        Image.fromarray(np.ascontiguousarray(np.rot90(large))).save(tmp_path / "p.jpg", exif=exif, quality=95)
        picture = load_picture(tmp_path / "p.jpg")
        assert picture.shape == (3000, 4500) and picture.rgb.shape == (1365, 2048, 3)
        assert far(picture.rgb, cv2.resize(large, (2048, 1365), interpolation=cv2.INTER_AREA)) <= 6

    @pytest.mark.parametrize(("name", "most_mb"), [("p.jpg", 50), ("p.png", 130)])
    def test_memory_is_the_decoded_picture_and_little_more(self, name, most_mb, tmp_path):
        """24 megapixels, 72 MB as RGB, 96 MB as Pillow holds them, beside a picture of a thousand pixels."""
        pytest.importorskip("resource")
        small = cv2.resize(np.arange(600, dtype=np.uint8).reshape(10, 20, 3), (1024, 683))
        Image.fromarray(small).save(tmp_path / "small.png")
        options = {"quality": 85} if name == "p.jpg" else {"compress_level": 1}
        Image.fromarray(small).resize((6000, 4000)).save(tmp_path / name, **options)
        code = (
            "import resource, sys\n"
            "from MedColorLib.references.pictures import load_picture\n"
            "load_picture(sys.argv[1])\n"
            "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
            "load_picture(sys.argv[2])\n"
            "print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1000)"
        )
        command = [sys.executable, "-c", code, str(tmp_path / "small.png"), str(tmp_path / name)]
        used = subprocess.run(command, capture_output=True, text=True, check=True)
        assert int(used.stdout) < most_mb


def test_hidden_files_are_no_pictures(colors, tmp_path):
    """macOS leaves ._NAME beside each file on foreign disks."""
    Image.fromarray(colors).save(tmp_path / "a.png")
    (tmp_path / "._a.png").write_bytes(b"\0\x05\x16\x07")
    (tmp_path / "folder.png").mkdir()
    Image.fromarray(colors).save(tmp_path / "folder.png" / "b.JPG")
    assert [p.name for p in pictures_in(tmp_path)] == ["a.png"]
    assert [p.name for p in pictures_in(tmp_path, below=True)] == ["a.png", "b.JPG"]
