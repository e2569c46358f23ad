"""Sound files for the fuzz to damage: each `make_` writes those of a kind into a folder."""

from __future__ import annotations

import json
import struct
import sys
import zlib
from pathlib import Path

import numpy as np

PHOTOGRAPH_SHAPE = (40, 50)


def _array(dtype: str = "i2") -> np.ndarray:
    return np.random.default_rng(7).integers(0, 100, (4, 5, 6)).astype(dtype)


def make_nrrd(folder: Path) -> None:
    """Raw with every field, packed, of four axes, and detached."""
    fields = "type: short\ndimension: 3\nsizes: 6 5 4\nendian: little\n"
    space = (
        "space: LPS\nspace directions: (2,0,0) (0,2,0) (0,0,3)\nspace origin: (1,2,3)\nkinds: domain domain domain\n"
    )
    mins = 'spacings: 2 2 3\naxis mins: 0 0 0\naxis maxs: 1 1 1\ncenterings: cell cell cell\nunits: "mm" "mm" "mm"\n'
    raw = _array().tobytes()
    (folder / "a.nrrd").write_bytes(f"NRRD0005\n{fields}{space}encoding: raw\nbyte skip: 0\n\n".encode() + raw)
    packed = zlib.compressobj(wbits=31)
    data = packed.compress(raw) + packed.flush()
    (folder / "b.nrrd").write_bytes(f"NRRD0005\n{fields}{mins}encoding: gzip\nline skip: 0\n\n".encode() + data)
    four = (
        fields.replace("dimension: 3", "dimension: 4").replace("6 5 4", "2 3 5 4")
        + "kinds: list domain domain domain\n"
    )
    (folder / "c.nrrd").write_bytes(f"NRRD0005\n{four}encoding: raw\n\n".encode() + raw)
    (folder / "d.nhdr").write_bytes(f"NRRD0005\n{fields}{space}encoding: raw\ndata file: d.raw\n".encode())
    (folder / "d.raw").write_bytes(raw)


def make_metaimage(folder: Path) -> None:
    """Raw, packed, text and detached."""
    head = "ObjectType = Image\nNDims = 3\nTransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 1 2 3\n"
    head += "ElementSpacing = 1 2 3\nDimSize = 6 5 4\n"
    kind = "ElementType = MET_SHORT\nBinaryData = True\nBinaryDataByteOrderMSB = False\n"
    raw = _array().tobytes()
    (folder / "a.mha").write_bytes(f"{head}{kind}CompressedData = False\nElementDataFile = LOCAL\n".encode() + raw)
    packed = f"{head}{kind}CompressedData = True\nElementDataFile = LOCAL\n".encode() + zlib.compress(raw)
    (folder / "b.mha").write_bytes(packed)
    text = " ".join(map(str, _array().ravel())).encode()
    (folder / "c.mha").write_bytes(
        f"{head}ElementType = MET_FLOAT\nBinaryData = False\nElementDataFile = LOCAL\n".encode() + text
    )
    (folder / "d.mhd").write_bytes(f"{head}{kind}HeaderSize = 0\nElementDataFile = d.raw\n".encode())
    (folder / "d.raw").write_bytes(raw)


def make_nifti(folder: Path) -> None:
    """NIfTI-1 and -2, scaled, of time points, packed."""
    import nibabel as nib

    image = nib.Nifti1Image(_array().T, np.diag([2.0, 2, 3, 1]))
    image.set_qform(np.diag([-2.0, -2, 3, 1]), 1)
    nib.save(image, folder / "a.nii")
    nib.save(image, folder / "b.nii.gz")
    image.header.set_slope_inter(0.5, 3)
    nib.save(image, folder / "c.nii")
    nib.save(nib.Nifti2Image(np.stack([_array().T] * 2, axis=3), np.eye(4)), folder / "d.nii")


def make_pair(folder: Path) -> None:
    """A NIfTI header with its voxels beside it."""
    import nibabel as nib

    nib.save(nib.Nifti1Pair(_array().T, np.diag([2.0, 2, 3, 1])), folder / "a.hdr")


def make_dicom(folder: Path) -> None:
    """Slices, an enhanced file, a mosaic, run lengths, JPEG 2000; each in a folder of its own."""
    import SimpleITK as sitk
    from pydicom.uid import RLELossless

    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "Library" / "io"))
    from dicom_samples import classic, enhanced, mosaic, planes, save

    array = planes(4)
    for n, plane in enumerate(array):
        fields = {
            "WindowCenter": 300,
            "WindowWidth": 100,
            "RescaleSlope": 2,
            "RescaleIntercept": -5,
            "EchoTime": 1 + n % 2,
        }
        save(classic(plane, 3 * (n // 2), n + 1, **fields), folder / "slices" / f"{n}.dcm")
    content = [
        {"FrameContentSequence": {"DimensionIndexValues": [n + 1, 1], "InStackPositionNumber": n + 1}} for n in range(4)
    ]
    save(enhanced(array, [0, 3, 6, 12], content), folder / "enhanced" / "a.dcm")
    save(mosaic(array, (0, 0, 0)), folder / "mosaic" / "a.dcm")
    packed = enhanced(array, [0, 3, 6, 9])
    packed.compress(RLELossless, generate_instance_uid=False)
    save(packed, folder / "runs" / "a.dcm")
    (folder / "jpeg").mkdir()
    writer = sitk.ImageFileWriter()
    writer.UseCompressionOn()
    writer.SetCompressor("JPEG2000")
    writer.SetFileName(str(folder / "jpeg" / "a.dcm"))
    writer.Execute(sitk.GetImageFromArray(planes(1, 40, 50)))  # GDCM packs no smaller ones
    for number, path in enumerate(sorted(folder.glob("*/*.dcm"))):
        _without_chance(path, number)


def _without_chance(path: Path, number: int) -> None:
    """The same identifiers in every run, so that a case can be repeated."""
    import pydicom
    from dicom_samples import save

    header = pydicom.dcmread(path)
    header.SOPInstanceUID = header.file_meta.MediaStorageSOPInstanceUID = f"1.2.826.{number}"
    for name in ("StudyInstanceUID", "SeriesInstanceUID", "StudyDate", "StudyTime", "FrameOfReferenceUID"):
        if name in header and path.parent.name == "jpeg":
            delattr(header, name)
    save(header, path)


def make_png(folder: Path) -> None:
    """Folders of slices: grey, palette."""
    import cv2

    for name, kind in (("grey", "u2"), ("colors", "u1")):
        (folder / name).mkdir()
        for n, plane in enumerate(_array(kind)):
            picture = np.repeat(plane[..., None], 3, axis=2) if name == "colors" else plane
            (folder / name / f"{n}.png").write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def make_tiff(folder: Path) -> None:
    """Pages, packed pages, a hyperstack, OME, LZW."""
    import cv2
    import tifffile

    array = _array("u2")
    tifffile.imwrite(
        folder / "a.tif", array, photometric="miniswhite", resolution=(20, 20), resolutionunit="CENTIMETER"
    )
    tifffile.imwrite(folder / "b.tif", array, photometric="minisblack", compression="zlib", predictor=True)
    channels = np.stack([array, array], axis=1)
    tifffile.imwrite(folder / "c.tif", channels, imagej=True, metadata={"spacing": 2.5, "unit": "um", "axes": "ZCYX"})
    tifffile.imwrite(
        folder / "d.ome.tif", channels, metadata={"axes": "ZCYX", "PhysicalSizeX": 2.0}, photometric="minisblack"
    )
    cv2.imwritemulti(str(folder / "e.tif"), list(array), [cv2.IMWRITE_TIFF_COMPRESSION, 5])


def make_plain(folder: Path) -> None:
    """Folders of slices: BMP, JPEG."""
    from PIL import Image

    for kind in ("bmp", "jpg"):
        (folder / kind).mkdir()
        for n, plane in enumerate(_array("u1")):
            Image.fromarray(np.kron(plane, np.ones((4, 4), np.uint8))).save(folder / kind / f"{n}.{kind}")


def make_photographs(folder: Path) -> None:
    """Formats and what tells their colours and orientation: profiles, gamma and primaries, EXIF, inks, 16 bits, transparency."""
    import cv2
    from PIL import Image, ImageCms

    rows, columns = PHOTOGRAPH_SHAPE
    colors = np.zeros((rows, columns, 3), np.uint8)
    colors[..., 0], colors[..., 1], colors[..., 2] = 190, np.arange(columns) * 4, np.arange(rows)[:, None] * 5
    image, exif = Image.fromarray(colors), Image.Exif()
    exif[0x112] = 3
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    image.save(folder / "p.jpg", exif=exif, icc_profile=profile)
    image.convert("CMYK").save(folder / "p.jpeg")
    image.save(folder / "p.tif", exif=exif, icc_profile=profile)
    image.save(folder / "p.webp", exif=exif, lossless=True)
    image.save(folder / "p.bmp")
    image.convert("P").save(folder / "p.gif", transparency=3)
    deep = np.dstack([colors[..., ::-1].astype(np.uint16) * 257, np.full((rows, columns), 65535, np.uint16)])
    data = cv2.imencode(".png", deep)[1].tobytes()
    (folder / "p.png").write_bytes(data)
    numbers = (31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)
    parts = [(b"gAMA", struct.pack(">I", 50000)), (b"cHRM", struct.pack(">8I", *numbers)), (b"cICP", b"\x0c\x0d\0\1")]
    chunks = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in parts)
    (folder / "p.apng").write_bytes(data[:33] + b"".join(chunks) + data[33:])


def make_colors(folder: Path) -> None:
    """Colour volumes: raw, packed and detached."""
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(np.repeat(_array("u1")[..., None] + 1, 3, axis=3), isVector=True)
    for name in ("a.mha", "b.mha", "c.mhd", "d.nrrd", "e.nii", "f.nii.gz"):
        sitk.WriteImage(image, str(folder / name), useCompression=name == "b.mha")


def make_labels(folder: Path) -> None:
    """Label pictures: 8 bits, 16 bits, palette."""
    import cv2

    for name, dtype in (("a.png", "u1"), ("b.png", "u2")):
        (folder / name).write_bytes(cv2.imencode(".png", _array(dtype)[0])[1].tobytes())
    head = struct.pack(">IIBBBBB", 4, 2, 4, 3, 0, 0, 0)
    parts = [(b"IHDR", head), (b"PLTE", bytes(48)), (b"IDAT", zlib.compress(b"\0\x12\x34\0\x56\x78")), (b"IEND", b"")]
    chunks = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in parts)
    (folder / "c.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


def make_library(folder: Path) -> None:
    """A library of one picture."""
    import cv2

    data = cv2.imencode(".png", np.full((9, 9, 3), (40, 60, 190), np.uint8))[1].tobytes()
    (folder / "a.png").write_bytes(data)
    entry = {
        "file": "a.png",
        "source": "a",
        "sha256": "00",
        "sha256_prepared": "00",
        "removed": 0.1,
        "mm_per_pixel": 0.3,
    }
    about = {
        "format": 1,
        "title": "t",
        "credit": "c",
        "licence": "l",
        "complete": True,
        "left_out": [],
        "pictures": [entry],
    }
    (folder / "library.json").write_text(json.dumps(about, indent=1))
