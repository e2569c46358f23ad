"""DICOM against the program that neuroimaging trusts, where both give a volume: frames, echoes, time points, mosaics."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from dicom_samples import ORIGIN_MM, STEP_MM, enhanced, mosaic, planes, save, save_stack

from MedColorLib.io.files import list_volumes, read_volume

A = planes()
B = (5000 - A).astype(np.uint16)
HEIGHTS = [STEP_MM * n for n in range(10)]


def echoes(folder: Path) -> None:
    save_stack(folder, A, HEIGHTS, prefix="a", EchoTime=10, EchoNumbers=1)
    save_stack(folder, B, HEIGHTS, prefix="b", EchoTime=90, EchoNumbers=2)


def content(place: int, contrast: int) -> dict:
    indices = {"StackID": "1", "InStackPositionNumber": place, "DimensionIndexValues": [place, contrast]}
    return {"FrameContentSequence": indices}


def frames_in_packages(folder: Path) -> None:
    order = [0, 3, 6, 9, 1, 4, 7, 2, 5, 8]
    groups = [content(n + 1, 1) for n in order]
    save(enhanced(A[order], [HEIGHTS[n] for n in order], groups), folder / "a.dcm")


def contrasts_with_rescale(folder: Path) -> None:
    rescale = [{"RescaleSlope": 1, "RescaleIntercept": 0}, {"RescaleSlope": 0.25, "RescaleIntercept": -50}]
    groups = [
        {**content(n % 10 + 1, n // 10 + 1), "PixelValueTransformationSequence": rescale[n // 10]} for n in range(20)
    ]
    save(enhanced([*A, *B], HEIGHTS * 2, groups), folder / "a.dcm")


def siemens_mosaic(folder: Path) -> None:
    ds = mosaic(A[:9], (*ORIGIN_MM, 0), Manufacturer="SIEMENS", AcquisitionNumber=1)
    save(ds, folder / "a.dcm")


def is_4d(path: Path) -> bool:
    return nib.load(path).ndim == 4


@pytest.mark.parametrize("make", [echoes, frames_in_packages, contrasts_with_rescale])
def test_same_volumes_at_the_same_places(make: Callable[[Path], None], tmp_path: Path) -> None:
    dcm2niix = pytest.importorskip("dcm2niix")
    make(tmp_path / "in")
    (tmp_path / "out").mkdir()
    command = [dcm2niix.bin, "-b", "n", "-z", "n", "-f", "%s_%e_%t", "-o", str(tmp_path / "out"), str(tmp_path / "in")]
    subprocess.run(command, check=True, capture_output=True)
    theirs = sorted((tmp_path / "out").glob("*.nii"))
    choices, _ = list_volumes(tmp_path / "in")
    images = [
        image for path in theirs for image in (nib.four_to_three(nib.load(path)) if is_4d(path) else [nib.load(path)])
    ]
    assert len(images) == len(choices)
    for number, image in enumerate(images, 1):
        ours = read_volume(tmp_path / "in", volume=number)
        flip = np.diag([1.0, -1, 1, 1])  # rows run the other way there
        flip[1, 3] = ours.array.shape[1] - 1
        np.testing.assert_allclose(image.affine @ flip, ours.ijk_to_ras, atol=1e-4)
        np.testing.assert_allclose(image.get_fdata()[:, ::-1].T, ours.array, atol=1e-3)


@pytest.mark.filterwarnings("ignore:The DICOM readers are highly experimental")
def test_mosaic_as_nibabel_lays_it(tmp_path: Path) -> None:
    from nibabel.nicom.dicomwrappers import MosaicWrapper

    siemens_mosaic(tmp_path)
    import pydicom

    header = pydicom.dcmread(tmp_path / "a.dcm")
    theirs = MosaicWrapper(
        header, csa_header={"tags": {"SliceNormalVector": {"vm": 3, "items": [0.0, 0.0, 1.0]}}}, n_mosaic=9
    )
    ours = read_volume(tmp_path / "a.dcm")
    data = header.pixel_array.reshape(3, 6, 3, 5).transpose(0, 2, 1, 3).reshape(9, 6, 5)
    np.testing.assert_array_equal(ours.array, data)
    np.testing.assert_allclose((np.diag([-1, -1, 1, 1]) @ theirs.affine)[:, [1, 0, 2, 3]], ours.ijk_to_ras, atol=1e-6)


@pytest.mark.filterwarnings("ignore:The DICOM readers are highly experimental")
@pytest.mark.parametrize("by_private_header", [False, True])
def test_mosaic_of_a_scanner(by_private_header: bool, tmp_path: Path) -> None:
    """nibabel's own sample: the header of a Siemens scanner, 48 slices, their normal in its private header."""
    import pydicom
    from nibabel.nicom.dicomwrappers import wrapper_from_file

    sample = Path(nib.__file__).parent / "tests" / "data" / "0.dcm"
    if not sample.is_file():
        pytest.skip("this nibabel comes without its samples")
    header = pydicom.dcmread(sample)
    if by_private_header:
        del header[0x0019, 0x100A]
    header.save_as(tmp_path / "a.dcm")
    volume, theirs = read_volume(tmp_path / "a.dcm"), wrapper_from_file(sample)
    assert volume.array.shape == theirs.image_shape[::-1] == (48, 36, 36)
    affine = (np.diag([-1, -1, 1, 1]) @ theirs.affine)[:, [1, 0, 2, 3]]
    np.testing.assert_allclose(volume.ijk_to_ras, affine, atol=1e-5)
