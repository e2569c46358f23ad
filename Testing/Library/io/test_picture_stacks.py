"""Stacks of pictures: order by names, several series, pages and channels, voxel sizes, grey saved as colours."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from MedColorLib.errors import InputError
from MedColorLib.io.files import list_volumes, read_volume

A = np.random.default_rng(8).integers(0, 65536, (12, 7, 9)).astype(np.uint16)
ASSUMED = "pictures carry no geometry: 1 mm voxels are assumed, x to the left, y to the back, slices upwards"


def save_named(folder: Path, names: list[str], array: np.ndarray = A) -> None:
    folder.mkdir(exist_ok=True)
    for name, plane in zip(names, array):
        if name.endswith(".png"):
            (folder / name).write_bytes(cv2.imencode(".png", plane)[1].tobytes())
        else:
            tifffile.imwrite(folder / name, plane)


@pytest.mark.parametrize(
    "names, note",
    [
        ([f"z{n}.png" for n in range(12)], None),
        ([f"slice-{n + 1:03}.png" for n in range(12)], None),
        ([f"z{3 * n - 15}.png" for n in range(12)], "taken as a minus"),
        ([f"{n - 6}.png" for n in range(12)], "taken as a minus"),
        ([f"z{n - 6:+}.png" for n in range(12)], "taken as a minus"),
        ([f"z{(n - 5) * 0.5:g}.png" for n in range(12)], "taken as decimals"),
        ([f"z{n * 0.25:.2f}.png" for n in range(12)], "taken as decimals"),
        ([f"z{n * 0.25:g}.png" for n in range(12)], "taken as decimals"),
        ([f"z{n * 0.25:g}.png".replace(".", ",", f"{n * 0.25:g}".count(".")) for n in range(12)], "taken as decimals"),
        ([f"1.{n}.png" for n in range(1, 13)], "one by one, not as decimals"),
        ([f"2023-01-15_{n}.png" for n in range(12)], None),
        ([f"z{n}.tif" for n in range(12)], None),
        ([f"2023-01-{15 + n % 2}_img{n}.png" for n in range(12)], None),
        ([f"{n}_{99 - n}.png" for n in range(12)], "two numbers of the names tell different orders"),
        ([f"{'abcdefghijkl'[n]}.png" for n in range(12)], "in alphabetical order"),
        ([f"IM_{n:04}_2023010112{n * 7:04}.png" for n in range(12)], None),
        ([f"avf{1001 + n // 3}{'abc'[n % 3]}.png" for n in range(12)], None),
        ([f"slice-{n + 1}.png" for n in range(12)], "taken as a dash, not as a minus"),
    ],
)
def test_order_of_names(names: list[str], note: str | None, tmp_path: Path) -> None:
    save_named(tmp_path, names)
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert volume.notes[-1] == ASSUMED
    said = " ".join(volume.notes[:-1])
    assert (note in said) if note else said == ""


def test_series_in_one_folder(tmp_path: Path) -> None:
    save_named(tmp_path, [f"ct_{n:03}.png" for n in range(12)])
    save_named(tmp_path, [f"mask_{n:03}.png" for n in range(8)], A[::-1])
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert (
        "left out: 2: mask_000.png to mask_007.png (9 x 7 x 8)" in volume.notes[0] and "--volume N" in volume.notes[0]
    )
    np.testing.assert_array_equal(read_volume(tmp_path, volume=2).array, A[::-1][:8])


def test_channels_by_two_numbers_in_the_names(tmp_path: Path) -> None:
    save_named(tmp_path, [f"z{n // 2}_c{n % 2}.png" for n in range(12)])
    np.testing.assert_array_equal(read_volume(tmp_path).array, A[::2])
    np.testing.assert_array_equal(read_volume(tmp_path, volume=2).array, A[1::2])


def test_missing_numbers_are_said(tmp_path: Path) -> None:
    save_named(tmp_path, [f"s{n + 3 * (n > 5)}.png" for n in range(12)])
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert "numbers are missing in the names (5 to 9, where 1 apart is usual)" in volume.notes[0]


# --- TIFF -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_tiffs_of_many_pages_in_a_folder(compression: str | None, tmp_path: Path) -> None:
    for n in range(3):
        tifffile.imwrite(
            tmp_path / f"part{n + 1}.tif", A[4 * n : 4 * n + 4], photometric="minisblack", compression=compression
        )
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert "3 TIFFs of 4, 4, 4 pages were put together in the order of their names" in volume.notes[0]
    np.testing.assert_array_equal(read_volume(tmp_path / "part2.tif").array, A[4:8])
    for n in (1, 3):
        (tmp_path / f"part{n}.tif").unlink()
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A[4:8])
    assert volume.notes == (ASSUMED,)


@pytest.mark.parametrize("dtype", ["u1", "u2"])
@pytest.mark.parametrize("where", ["stack", "folder", "lzw"])
def test_white_is_zero(dtype: str, where: str, tmp_path: Path) -> None:
    array = (A >> 8).astype(dtype) if dtype == "u1" else A
    top = np.iinfo(dtype).max
    if where == "lzw":  # OpenCV packs so; the tag of the photometric interpretation is changed by hand
        assert cv2.imwritemulti(str(tmp_path / "a.tif"), [top - p for p in array], [cv2.IMWRITE_TIFF_COMPRESSION, 5])
        with tifffile.TiffFile(tmp_path / "a.tif", mode="r+b") as file:
            for page in file.pages:
                page.tags[262].overwrite(0)
        source = tmp_path / "a.tif"
    elif where == "stack":
        source = tmp_path / "a.tif"
        tifffile.imwrite(source, top - array, photometric="miniswhite")
    else:
        source = tmp_path
        for n, plane in enumerate(array):
            tifffile.imwrite(tmp_path / f"{n}.tif", top - plane, photometric="miniswhite")
    volume = read_volume(source)
    np.testing.assert_array_equal(volume.array, array)
    assert volume.notes[0].startswith(
        f"WhiteIsZero: larger numbers are meant to look darker; they were turned round ({top}"
    )


@pytest.mark.parametrize("dtype", ["i2", "f4", "u4"])
def test_white_is_zero_of_other_types(dtype: str, tmp_path: Path) -> None:
    """The order of brightness is turned; what is largest is darkest."""
    array = (A.astype(np.int64) - 20000).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", array, photometric="miniswhite")
    volume = read_volume(tmp_path / "a.tif")
    top = {"i2": -1, "f4": 0, "u4": 2**32 - 1}[dtype]
    np.testing.assert_array_equal(volume.array, top - array.astype(np.int64 if dtype != "f4" else dtype))
    assert f"turned round ({top} minus the number)" in volume.notes[0]


@pytest.mark.parametrize("white_is_zero", [False, True])
@pytest.mark.parametrize("bits", [2, 4, 12])
def test_numbers_of_few_bits(bits: int, white_is_zero: bool, tmp_path: Path) -> None:
    """Written by hand after TIFF 6.0: numbers side by side, rows filled up to whole bytes."""
    array = (A[:2, :, :7] % (1 << bits)).astype(np.uint16)
    stored = (1 << bits) - 1 - array if white_is_zero else array
    places = np.arange(bits)[::-1]
    rows = [np.packbits((row[:, None] >> places) & 1).tobytes() for plane in stored for row in plane]
    size = len(rows[0]) * 7
    data = bytearray(b"II*\0" + struct.pack("<I", 8 + 2 * size) + b"".join(rows))
    for page in range(2):
        values = {
            256: 7,
            257: 7,
            258: bits,
            259: 1,
            262: int(not white_is_zero),
            273: 8 + page * size,
            277: 1,
            278: 7,
            279: size,
        }
        data += struct.pack("<H", len(values)) + b"".join(
            struct.pack("<HHII", tag, 4, 1, v) for tag, v in values.items()
        )
        data += struct.pack("<I", len(data) + 4 if page == 0 else 0)
    (tmp_path / "a.tif").write_bytes(data)
    volume = read_volume(tmp_path / "a.tif")
    np.testing.assert_array_equal(volume.array, array)


def test_imagej_hyperstack(tmp_path: Path) -> None:
    channels = np.stack([A, A[::-1]], axis=1)  # Z, C
    meta = {"spacing": 2.5, "unit": "um", "axes": "ZCYX"}
    tifffile.imwrite(tmp_path / "a.tif", channels, imagej=True, resolution=(0.5, 0.25), metadata=meta)
    volume = read_volume(tmp_path / "a.tif")
    np.testing.assert_array_equal(volume.array, A)
    np.testing.assert_allclose(volume.spacing_mm, (2e-3, 4e-3, 2.5e-3))
    assert "channel 1 (9 x 7 x 12) was read, the first of 2 volumes; left out: 2: channel 2" in volume.notes[0]
    assert "voxels of 0.002 x 0.004 x 0.0025 mm, from ImageJ; directions are assumed" in volume.notes[1]
    np.testing.assert_array_equal(read_volume(tmp_path / "a.tif", volume=2).array, A[::-1])
    assert [choice.label for choice in list_volumes(tmp_path / "a.tif")[0]] == ["channel 1", "channel 2"]
    (tmp_path / "folder").mkdir()
    (tmp_path / "a.tif").rename(tmp_path / "folder" / "a.tif")
    np.testing.assert_array_equal(read_volume(tmp_path / "folder", volume=2).array, A[::-1])


def test_ome(tmp_path: Path) -> None:
    stack = np.stack([np.stack([A, A[::-1]]), np.stack([A // 2, A // 3])])  # T, C, Z
    meta = {
        "axes": "TCZYX",
        "PhysicalSizeX": 0.5,
        "PhysicalSizeY": 0.5,
        "PhysicalSizeZ": 1.5,
        "PhysicalSizeZUnit": "mm",
    }
    tifffile.imwrite(tmp_path / "a.ome.tif", stack, metadata=meta, photometric="minisblack")
    volume = read_volume(tmp_path / "a.ome.tif")
    np.testing.assert_array_equal(volume.array, A)
    np.testing.assert_allclose(volume.spacing_mm, (5e-4, 5e-4, 1.5))
    for number, expected in enumerate((A, A[::-1], A // 2, A // 3), 1):
        np.testing.assert_array_equal(read_volume(tmp_path / "a.ome.tif", volume=number).array, expected)


def test_a_file_that_names_others_does_not_open_them(tmp_path: Path) -> None:
    """OME words may name any file; what lies in this one is read."""
    secret = tmp_path / "secret.ome.tif"
    tifffile.imwrite(secret, A, metadata={"axes": "ZYX"}, photometric="minisblack")
    data = tifffile.tiffcomment(secret).replace("secret", "others")
    tifffile.imwrite(tmp_path / "a.ome.tif", A // 2, description=data.encode(), metadata=None, photometric="minisblack")
    secret.rename(tmp_path / "others.ome.tif")
    np.testing.assert_array_equal(read_volume(tmp_path / "a.ome.tif").array, A // 2)


def test_slices_whose_words_speak_of_the_whole_stack(tmp_path: Path) -> None:
    """As microscopes save them: every file says that there are 12 planes, and holds one."""
    tifffile.imwrite(
        tmp_path / "whole.ome.tif", A, metadata={"axes": "ZYX", "PhysicalSizeX": 2.0}, photometric="minisblack"
    )
    words = tifffile.tiffcomment(tmp_path / "whole.ome.tif")
    (tmp_path / "whole.ome.tif").unlink()
    for n, plane in enumerate(A):
        tifffile.imwrite(tmp_path / f"z{n}.ome.tif", plane, description=words.encode(), metadata=None)
    np.testing.assert_array_equal(read_volume(tmp_path).array, A)


def test_pixels_per_metre_of_a_png(tmp_path: Path) -> None:
    from PIL import Image

    for name, dots, spacing in (("scan", 2540, 0.01), ("print", 300, 1.0)):
        (tmp_path / name).mkdir()
        for n, plane in enumerate(A):
            Image.fromarray(plane).save(tmp_path / name / f"{n}.png", dpi=(dots, dots))
        volume = read_volume(tmp_path / name)
        np.testing.assert_array_equal(volume.array, A)
        np.testing.assert_allclose(volume.spacing_mm, [spacing] * 3)
        assert ("from the resolution in the pictures" in volume.notes[0]) == (name == "scan")


@pytest.mark.parametrize("kind", ["tiled", "big", "jpeg", "bilevel", "float", "signed"])
def test_other_ways_of_tiff(kind: str, tmp_path: Path) -> None:
    options = {"tiled": {"tile": (16, 16)}, "big": {"bigtiff": True, "byteorder": ">"}}.get(kind, {})
    dtype = {"float": "f4", "signed": "i2", "bilevel": bool}.get(kind, "u2")
    array = (A > 30000) if kind == "bilevel" else A.astype(np.int64).astype(dtype)
    if kind == "jpeg":
        array = np.repeat(np.arange(12, dtype=np.uint8)[:, None, None] * 20, 256, axis=1).repeat(16, axis=2)
        assert cv2.imwritemulti(str(tmp_path / "a.tif"), list(array), [cv2.IMWRITE_TIFF_COMPRESSION, 7])
    else:
        tifffile.imwrite(tmp_path / "a.tif", array, photometric="minisblack", **options)
    volume = read_volume(tmp_path / "a.tif")
    np.testing.assert_allclose(
        volume.array, array * 255 if kind == "bilevel" else array, atol=2 if kind == "jpeg" else 0
    )
    assert volume.notes == (ASSUMED,)


@pytest.mark.parametrize(
    "resolution, unit, spacing",
    [((200, 100), "CENTIMETER", (0.05, 0.1)), ((300, 300), "INCH", None), ((1, 1), "NONE", None)],
)
def test_voxel_size_in_resolution_tags(resolution: tuple, unit: str, spacing: tuple | None, tmp_path: Path) -> None:
    for n, plane in enumerate(A):
        tifffile.imwrite(tmp_path / f"{n}.tif", plane, resolution=resolution, resolutionunit=unit)
    volume = read_volume(tmp_path)
    np.testing.assert_allclose(volume.spacing_mm, (*spacing, spacing[0]) if spacing else (1, 1, 1))
    if spacing:
        assert (
            "from the resolution tags, the distance of the slices is not said: it is taken to be that of the"
            in volume.notes[0]
        )
    else:
        assert volume.notes == (ASSUMED,)


def test_pages_that_differ_and_pages_that_are_missing(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        writer.write(A, photometric="minisblack")
        writer.write(A[0, :3, :3], photometric="minisblack")  # a thumbnail
    volume = read_volume(tmp_path / "a.tif")
    np.testing.assert_array_equal(volume.array, A)
    assert "left out: 2: series 2 (3 x 3 x 1)" in volume.notes[0]


# --- grey saved as colours ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", ["rgb", "rgba", "grey and alpha", "palette", "tiff rgb", "tiff planar", "tiff palette"]
)
def test_grey_saved_as_colours_is_read_as_grey(kind: str, tmp_path: Path) -> None:
    from PIL import Image

    array = (A >> 8).astype(np.uint8)
    for n, plane in enumerate(array):
        alpha = np.full_like(plane, 200)
        if kind.startswith("tiff"):
            path, three = tmp_path / f"{n}.tif", np.repeat(plane[None], 3, axis=0)
            if kind == "tiff palette":
                grey = np.repeat(np.arange(256, dtype=np.uint16)[None] * 257, 3, axis=0)
                tifffile.imwrite(path, plane, photometric="palette", colormap=grey)
            elif kind == "tiff planar":
                tifffile.imwrite(path, three, photometric="rgb", planarconfig="separate")
            else:
                tifffile.imwrite(path, np.moveaxis(three, 0, -1), photometric="rgb")
            continue
        picture = Image.fromarray(plane)
        if kind == "palette":
            picture = Image.frombytes("P", plane.shape[::-1], (255 - plane).tobytes())
            picture.putpalette([255 - v for v in range(256) for _ in range(3)])
        elif kind == "grey and alpha":
            picture = Image.merge("LA", [picture, Image.fromarray(alpha)])
        elif kind == "rgba":
            picture = Image.merge("RGBA", [picture] * 3 + [Image.fromarray(alpha)])
        else:
            picture = picture.convert("RGB")
        picture.save(tmp_path / f"{n}.png")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, array)
    assert volume.array.dtype == np.uint8 and volume.notes[0].startswith("grey saved as ")
    assert "the channels are equal, one of them is read" in volume.notes[0]


def test_transparency_that_varies_is_said_and_colours_are_refused(tmp_path: Path) -> None:
    plane = np.repeat((A[0] >> 8).astype(np.uint8)[..., None], 4, axis=2)
    for n in range(2):
        cv2.imwrite(
            str(tmp_path / f"{n}.png"), np.dstack([plane[..., :3], np.arange(63, dtype=np.uint8).reshape(7, 9)])
        )
    assert "the transparency of the pictures is left out" in read_volume(tmp_path).notes
    plane[3, 3, 1] += 1
    cv2.imwrite(str(tmp_path / "1.png"), plane[..., :3])
    with pytest.raises(InputError, match=r"slice 1.png: a colour or vector image"):
        read_volume(tmp_path)


def test_size_is_checked_before_memory_is_taken(tmp_path: Path) -> None:
    """Headers of pictures that would take gigabytes."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", 60000, 60000, 16, 0, 0, 0, 0)
    text = (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(99))) + chunk(b"IEND", b"")
    )
    for n in range(2):
        (tmp_path / f"{n}.png").write_bytes(text)
    with pytest.raises(InputError, match="ends before"):
        read_volume(tmp_path)
    with pytest.raises(InputError, match="GiB"):
        read_volume(tmp_path, max_bytes=1 << 20)
    tifffile.imwrite(tmp_path / "a.tif", A, photometric="minisblack", compression="zlib")
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+b") as file:
        for page in file.pages:
            page.tags[256].overwrite(60000)
            page.tags[257].overwrite(60000)
            page.tags[278].overwrite(60000)
    with pytest.raises(InputError, match="ends before"):
        read_volume(tmp_path / "a.tif")
