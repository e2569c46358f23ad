"""Voxels, geometries and files that the tests of the volume readers and writers share."""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import nibabel as nib
import nrrd
import numpy as np
import SimpleITK as sitk

SHAPE = (4, 5, 6)
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
GEOMETRIES = {"rotated": (0.0, 1.0), "left-handed": (0.0, -1.0), "sheared": (0.3, 1.0)}


def voxels(dtype: np.dtype, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    generator = np.random.default_rng(7)
    if dtype.kind == "f":
        return generator.normal(0, 1000, shape).astype(dtype)
    limits = np.iinfo(dtype)
    array = generator.integers(limits.min, limits.max, shape, dtype=dtype, endpoint=True)
    array.flat[:2] = limits.min, limits.max
    return array


def geometry(name: str, seed: int = 3) -> np.ndarray:
    """(4, 4) IJK to RAS: columns of any length, rotated by any angle."""
    shear, hand = GEOMETRIES[name]
    generator = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    rotation[:, 2] *= hand * np.sign(np.linalg.det(rotation))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ (np.diag(generator.uniform(0.3, 3, 3)) + shear * np.eye(3, k=2))
    matrix[:3, 3] = generator.uniform(-200, 200, 3)
    return matrix


def save_nrrd(path: Path, array: np.ndarray, matrix: np.ndarray = LPS, **fields) -> None:
    """Header in LPS unless `fields` say otherwise; None removes a field."""
    lps = LPS @ matrix
    header = {
        "space": "left-posterior-superior",
        "space directions": lps[:3, :3].T,
        "space origin": lps[:3, 3],
        "encoding": "gzip",
        **fields,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        nrrd.write(str(path), array, {k: v for k, v in header.items() if v is not None}, index_order="C")


def sound_files(folder: Path) -> list[Path]:
    array = voxels(np.dtype("i2"))
    save_nrrd(folder / "gzip.nrrd", array)
    save_nrrd(folder / "raw.nrrd", array, encoding="raw")
    sitk.WriteImage(sitk.GetImageFromArray(array), folder / "packed.mha", useCompression=True)
    sitk.WriteImage(sitk.GetImageFromArray(array), folder / "raw.mha")
    nib.save(nib.Nifti1Image(array.T, LPS), folder / "packed.nii.gz")
    nib.save(nib.Nifti1Image(array.T, LPS), folder / "raw.nii")
    cv2.imwritemulti(str(folder / "pages.tif"), list(array))
    return sorted(folder.iterdir())
