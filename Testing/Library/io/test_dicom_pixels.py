"""DICOM pixels: bits, byte orders, packed pictures, MONOCHROME1; SimpleITK and pydicom are the references."""

from __future__ import annotations

import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_samples import classic, enhanced, planes, save
from pydicom.dataelem import RawDataElement
from pydicom.encaps import encapsulate
from pydicom.uid import DeflatedExplicitVRLittleEndian, ExplicitVRBigEndian, ImplicitVRLittleEndian, RLELossless

from MedColorLib.errors import InputError
from MedColorLib.io.files import read_volume

PLANE = (planes(1)[0] * 7).astype(np.uint16)


def test_byte_orders_and_deflated(tmp_path: Path) -> None:
    for syntax in (ImplicitVRLittleEndian, ExplicitVRBigEndian, DeflatedExplicitVRLittleEndian):
        ds = classic(PLANE, 0, 1)
        ds.file_meta.TransferSyntaxUID = syntax
        if syntax == ExplicitVRBigEndian:
            ds.PixelData = PLANE.astype(">u2").tobytes()
        save(ds, tmp_path / syntax / "a.dcm")
        np.testing.assert_array_equal(read_volume(tmp_path / syntax).array[0], PLANE)


def test_file_of_zeros_is_no_header_of_millions_of_elements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr("pydicom.filereader.RawDataElement", lambda *values: seen.append(1) or RawDataElement(*values))
    save(classic(PLANE, 0, 1), tmp_path / "sound.dcm")
    sound = (tmp_path / "sound.dcm").read_bytes()
    for beginning in (b"", bytes(128) + b"DICM", sound[:-200]):
        (tmp_path / "a.dcm").write_bytes(beginning + bytes(8_000_000))
        with pytest.raises(InputError, match="no readable DICOM image"):
            read_volume(tmp_path / "a.dcm")
    assert 0 < len(seen) < 100_000


def test_deflated_file_that_unpacks_to_more_than_any_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Zeros behind the header; pydicom would unpack them all at once."""
    monkeypatch.setattr("MedColorLib.io.dicom_file._MAX_DEFLATED", 1 << 25)
    ds = classic(PLANE, 0, 1)
    ds.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    save(ds, tmp_path / "a.dcm")
    data = (tmp_path / "a.dcm").read_bytes()
    start = 144 + int.from_bytes(data[140:144], "little")
    plain = zlib.decompress(data[start:], -15)
    packer = zlib.compressobj(9, wbits=-15)
    packed = packer.compress(plain) + b"".join(packer.compress(bytes(1 << 24)) for _ in range(8)) + packer.flush()
    (tmp_path / "a.dcm").write_bytes(data[:start] + packed)
    tracemalloc.start()
    with pytest.raises(InputError, match="no readable DICOM image"):
        read_volume(tmp_path / "a.dcm")
    assert tracemalloc.get_traced_memory()[1] < 70 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("signed", [0, 1])
def test_overlay_in_the_upper_bits(signed: int, tmp_path: Path) -> None:
    values = np.arange(30).reshape(6, 5) * 70 - 1000 * signed
    raw = (values & 0x0FFF).astype(np.uint16) | np.uint16(0xA000)
    save(classic(raw, 0, 1, BitsStored=12, HighBit=11, PixelRepresentation=signed), tmp_path / "a.dcm")
    np.testing.assert_array_equal(read_volume(tmp_path / "a.dcm").array[0], values)


@pytest.mark.parametrize("signed", [0, 1])
@pytest.mark.parametrize("packed", [False, True])
def test_numbers_that_do_not_begin_at_the_lowest_bit(packed: bool, signed: int, tmp_path: Path) -> None:
    values = np.arange(30).reshape(6, 5) * 130 - 2048 * signed
    raw = ((values & 0x0FFF) << 3).astype(np.uint16) | np.uint16(0x8005)
    ds = classic(raw, 0, 1, BitsStored=12, HighBit=14, PixelRepresentation=signed)
    if packed:  # by hand: pydicom packs the lowest bits alone
        planes_of_bytes = [(raw >> shift).astype(np.uint8).tobytes() for shift in (8, 0)]
        halves = [bytes([len(half) - 1]) + half for half in planes_of_bytes]
        offsets = np.array([2, 64, 64 + len(halves[0]), *[0] * 13], "<u4")
        ds.file_meta.TransferSyntaxUID = RLELossless
        ds.PixelData = encapsulate([offsets.tobytes() + b"".join(halves)])
        ds["PixelData"].is_undefined_length = True
    save(ds, tmp_path / "a.dcm")
    np.testing.assert_array_equal(read_volume(tmp_path / "a.dcm").array[0], values)


@pytest.mark.parametrize(
    "slope, intercept, dtype", [("1", "-1024", "i4"), ("2", "0", "i4"), ("0.5", "-10", "f4"), ("1", "0", "u2")]
)
def test_rescale_in_the_smallest_type_as_itk(slope: str, intercept: str, dtype: str, tmp_path: Path) -> None:
    save(classic(PLANE, 0, 1, RescaleSlope=slope, RescaleIntercept=intercept), tmp_path / "a.dcm")
    volume = read_volume(tmp_path / "a.dcm")
    assert volume.array.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(volume.array, sitk.GetArrayFromImage(sitk.ReadImage(tmp_path / "a.dcm")))


@pytest.mark.parametrize("compressor", ["JPEG", "JPEG2000"])
def test_packed_slices(compressor: str, tmp_path: Path) -> None:
    """JPEG: lossless as ITK writes it."""
    array = np.random.default_rng(1).integers(0, 4000, (3, 40, 30)).astype(np.uint16)
    for n, plane in enumerate(array):
        image = sitk.GetImageFromArray(plane[None])
        for tag, value in {"0020|000e": "1.2.3", "0020|0032": f"0\\0\\{n}", "0020|0037": "1\\0\\0\\0\\1\\0"}.items():
            image.SetMetaData(tag, value)
        writer = sitk.ImageFileWriter()
        writer.KeepOriginalImageUIDOn()
        writer.UseCompressionOn()
        writer.SetCompressor(compressor)
        writer.SetFileName(str(tmp_path / f"{n}.dcm"))
        writer.Execute(image)
    assert pydicom.dcmread(tmp_path / "0.dcm").file_meta.TransferSyntaxUID.is_compressed
    np.testing.assert_array_equal(read_volume(tmp_path).array, array)


def test_packed_frames_and_their_rescale(tmp_path: Path) -> None:
    """Run lengths, frame by frame; `pydicom` packs and unpacks them by code of its own."""
    array = planes(4)
    groups = [{"PixelValueTransformationSequence": {"RescaleSlope": n + 1, "RescaleIntercept": 0}} for n in range(4)]
    ds = enhanced(array, [0, 3, 6, 9], groups)
    ds.compress(RLELossless, generate_instance_uid=False)
    save(ds, tmp_path / "a.dcm")
    expected = pydicom.dcmread(tmp_path / "a.dcm").pixel_array * np.arange(1, 5)[:, None, None]
    np.testing.assert_array_equal(read_volume(tmp_path / "a.dcm").array, expected)


def test_damaged_picture_is_one_sentence(tmp_path: Path) -> None:
    ds = classic(PLANE, 0, 5)
    ds.file_meta.TransferSyntaxUID = RLELossless
    ds.PixelData = encapsulate([b"no picture"])
    save(ds, tmp_path / "a.dcm")
    with pytest.raises(
        InputError, match=r"DICOM slice 5 \(packed as RLE Lossless\) cannot be decoded; export the series"
    ):
        read_volume(tmp_path / "a.dcm")


@pytest.mark.parametrize(
    "bits, signed, slope, intercept, window",
    [(12, 0, 1, 0, (400, 3000)), (16, 0, 2, -100, (0, 900)), (12, 1, 1, 0, (-500, 900))],
)
def test_monochrome1_turns_values_and_window(
    bits: int, signed: int, slope: float, intercept: float, window: tuple, tmp_path: Path
) -> None:
    """What the window shows darkest stays darkest: the brightest stored numbers."""
    stored = np.arange(30).reshape(6, 5) * 60 - 900 * signed
    fields = {"BitsStored": bits, "HighBit": bits - 1, "PixelRepresentation": signed}
    fields |= {"RescaleSlope": slope, "RescaleIntercept": intercept, "PhotometricInterpretation": "MONOCHROME1"}
    fields |= {"WindowCenter": sum(window) / 2, "WindowWidth": window[1] - window[0]}
    save(classic((stored & (2**bits - 1)).astype(np.uint16), 0, 1, **fields), tmp_path / "a.dcm")
    volume = read_volume(tmp_path / "a.dcm")
    low, high = volume.window
    meant = 1 - np.clip((stored * slope + intercept - window[0]) / (window[1] - window[0]), 0, 1)
    np.testing.assert_allclose(np.clip((volume.array[0] - low) / (high - low), 0, 1), meant, atol=1e-12)
    both = 2**bits - 1 if not signed else -1
    assert volume.notes == (
        "MONOCHROME1: larger stored numbers are meant to look darker; they were turned round "
        f"({both} minus the number), and the window with them",
    )
    if not signed:  # GDCM turns no signed numbers
        np.testing.assert_array_equal(volume.array, sitk.GetArrayFromImage(sitk.ReadImage(tmp_path / "a.dcm")))
