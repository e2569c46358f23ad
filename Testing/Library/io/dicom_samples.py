"""DICOM files that the tests of the reader write: classic slices, enhanced multi-frame files, mosaics."""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence as Items
from pydicom.uid import (
    EnhancedMRImageStorage,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    MRImageStorage,
    generate_uid,
)

SPACING_MM = (0.75, 0.5)  # along i, along j
STEP_MM = 3.0
ORIGIN_MM = (-20.5, 30.25)
AXIAL = (1, 0, 0, 0, 1, 0)


def planes(count: int = 10, rows: int = 6, columns: int = 5) -> np.ndarray:
    """(k, j, i) uint16, all voxels different."""
    return (100 + np.arange(count * rows * columns, dtype=np.uint16)).reshape(count, rows, columns)


def _image(kind: str, plane: np.ndarray, series: str, number: int) -> Dataset:
    ds = Dataset()
    ds.file_meta = FileMetaDataset()
    ds.file_meta.MediaStorageSOPClassUID = ds.SOPClassUID = kind
    ds.file_meta.MediaStorageSOPInstanceUID = ds.SOPInstanceUID = generate_uid()
    ds.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    ds.Modality, ds.SeriesNumber, ds.InstanceNumber = "MR", 7, number
    ds.PatientName, ds.SeriesDescription = "DOE^JANE", "JANE HEAD"
    ds.StudyInstanceUID, ds.SeriesInstanceUID = "1.2.3", series
    ds.Rows, ds.Columns, ds.SamplesPerPixel, ds.PhotometricInterpretation = *plane.shape, 1, "MONOCHROME2"
    ds.BitsAllocated, ds.BitsStored, ds.HighBit, ds.PixelRepresentation = 16, 16, 15, 0
    return ds


def classic(plane: np.ndarray, height_mm: float, number: int, series: str = "1.2.3.4", **fields) -> Dataset:
    """One transverse slice of 0.75 x 0.5 mm pixels; `fields` set or replace elements, None removes one."""
    ds = _image(MRImageStorage, plane, series, number)
    ds.PixelSpacing, ds.SliceThickness = list(SPACING_MM[::-1]), STEP_MM
    ds.ImageOrientationPatient, ds.ImagePositionPatient = list(AXIAL), [*ORIGIN_MM, float(height_mm)]
    ds.PixelData = np.ascontiguousarray(plane, "<u2").tobytes()
    for name, value in fields.items():
        if value is None:
            delattr(ds, name)
        else:
            setattr(ds, name, value)
    return ds


def save(ds: Dataset, path: Path, *, preamble: bool = True, implicit: bool = False) -> None:
    """By pydicom 3, or 2 as Python 3.9 needs it. Without `preamble` bare elements, their kinds left `implicit` or not."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if "enforce_file_format" in signature(ds.save_as).parameters:
        bare = {} if preamble else {"implicit_vr": implicit, "little_endian": True}
        ds.save_as(path, enforce_file_format=preamble, **bare)
    else:
        syntax = ds.file_meta.TransferSyntaxUID if preamble else None
        ds.is_little_endian = syntax != ExplicitVRBigEndian
        ds.is_implicit_VR = implicit or syntax == ImplicitVRLittleEndian
        ds.save_as(path, write_like_original=not preamble)


def save_stack(
    folder: Path, array: np.ndarray, heights: Sequence[float], first: int = 1, prefix: str = "", **fields
) -> None:
    """Slices numbered from `first` on; the file names are in another order."""
    for n, (plane, height) in enumerate(zip(array, heights)):
        ds = classic(plane, height, first + n, **{k: v(n) if callable(v) else v for k, v in fields.items()})
        save(ds, folder / f"{prefix}{(n * 7) % 11:02}.dcm")


def macro(**fields) -> Items:
    item = Dataset()
    for name, value in fields.items():
        setattr(item, name, value)
    return Items([item])


def enhanced(
    frames: Sequence[np.ndarray], heights: Sequence[float], groups: Sequence[dict] = (), series: str = "1.2.3.5"
) -> Dataset:
    """Enhanced MR; `groups`: for each frame macro keyword -> its elements, as {"MREchoSequence": {"EffectiveEchoTime": 5.0}}."""
    ds = _image(EnhancedMRImageStorage, frames[0], series, 1)
    ds.NumberOfFrames = len(frames)
    shared = Dataset()
    shared.PlaneOrientationSequence = macro(ImageOrientationPatient=list(AXIAL))
    shared.PixelMeasuresSequence = macro(PixelSpacing=list(SPACING_MM[::-1]), SliceThickness=STEP_MM)
    ds.SharedFunctionalGroupsSequence = Items([shared])
    ds.PerFrameFunctionalGroupsSequence = Items([])
    for n, height in enumerate(heights):
        item = Dataset()
        item.PlanePositionSequence = macro(ImagePositionPatient=[*ORIGIN_MM, float(height)])
        for name, fields in (groups[n] if groups else {}).items():
            setattr(item, name, macro(**fields))
        ds.PerFrameFunctionalGroupsSequence.append(item)
    ds.PixelData = np.stack(frames).astype("<u2").tobytes()
    return ds


def mosaic(
    array: np.ndarray, corner_mm: Sequence[float], number: int = 1, count_known: bool = True, **fields
) -> Dataset:
    """Slices as tiles of one picture, with the position that Siemens writes for slices that begin at `corner_mm`."""
    count, rows, columns = array.shape
    edge = int(np.ceil(np.sqrt(count)))
    tiles = np.zeros((edge * edge, rows, columns), np.uint16)
    tiles[:count] = array
    picture = tiles.reshape(edge, edge, rows, columns).transpose(0, 2, 1, 3).reshape(edge * rows, edge * columns)
    half = [(edge - 1) * columns / 2 * SPACING_MM[0], (edge - 1) * rows / 2 * SPACING_MM[1]]
    position = [corner_mm[0] - half[0], corner_mm[1] - half[1], corner_mm[2]]
    kind = ["ORIGINAL", "PRIMARY", "M", "ND", "MOSAIC"]
    options = {"ImageType": kind, "ImagePositionPatient": position, "SpacingBetweenSlices": STEP_MM, **fields}
    ds = classic(picture, 0, number, **options)
    if count_known:
        ds.private_block(0x0019, "SIEMENS MR HEADER", create=True).add_new(0x0A, "US", count)
    return ds
