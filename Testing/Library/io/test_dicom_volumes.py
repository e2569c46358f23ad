"""DICOM: one volume of one contrast, acquisition and time point; what is left out is named and can be chosen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dicom_samples import ORIGIN_MM, STEP_MM, classic, enhanced, macro, mosaic, planes, save, save_stack
from pydicom.dataset import Dataset
from pydicom.uid import generate_uid

from MedColorLib.errors import InputError
from MedColorLib.io import dicom
from MedColorLib.io.files import list_volumes, read_time_points, read_volume

A = planes()
B = (5000 - A).astype(np.uint16)
OF_TIME = ("TemporalPositionIdentifier", "AcquisitionNumber", "AcquisitionTime", "TriggerTime", "FrameReferenceTime")
HEIGHTS = [STEP_MM * n for n in range(10)]


def both(folder: Path, first: dict, second: dict, heights: list[float] | None = None, number: int = 1) -> None:
    """Two volumes of one series whose slices have the same numbers; file names in no order."""
    save_stack(folder, A, HEIGHTS, prefix="x", **first)
    save_stack(folder, B, heights or HEIGHTS, first=number, prefix="b", **second)


def is_either(folder: Path, words: str, first: np.ndarray = A, second: np.ndarray = B) -> None:
    """The first is read, the second is named in the note and can be chosen."""
    volume = read_volume(folder)
    np.testing.assert_array_equal(volume.array, first)
    np.testing.assert_allclose(volume.spacing_mm, (0.75, 0.5, STEP_MM))
    other = read_volume(folder, volume=2)
    np.testing.assert_array_equal(other.array, second)
    assert words in other.name
    assert f"left out: 2: {other.name} (" in volume.notes[0] and "--volume N" in volume.notes[0]
    assert "as asked for; left out: 1: " in other.notes[0]
    assert [choice.label for choice in list_volumes(folder)[0]] == [volume.name, other.name]


@pytest.mark.parametrize(
    "trait, values, words",
    [
        ("EchoTime", (10, 90), "echo time 90 ms"),
        ("EchoNumbers", (1, 2), "echo 2"),
        ("InversionTime", (100, 900), "inversion time 900 ms"),
        ("DiffusionBValue", (0.0, 1000.0), "b-value 1000"),
        ("TemporalPositionIdentifier", (1, 2), "time point 2"),
        ("AcquisitionNumber", (3, 4), "acquisition 4"),
        ("AcquisitionTime", ("100000", "100500"), "acquisition time 2 of 2"),
        ("TriggerTime", (10, 500), "trigger time 500 ms"),
        ("FlipAngle", (5, 20), "flip angle 20"),
        ("SequenceName", ("ep_b0", "ep_b800"), "sequence ep_b800"),
        ("ContrastBolusAgent", ("A", "GADO"), "contrast agent 2 of 2"),
        ("SeriesDescription", ("early", "late"), "description 2 of 2"),
        ("ConvolutionKernel", ("B30f", "B70f"), "kernel B70f"),
        ("ImageType", (["ORIGINAL", "PRIMARY", "M"], ["ORIGINAL", "PRIMARY", "P"]), "ORIGINAL/PRIMARY/P"),
        ("ImageType", (["ORIGINAL", "PRIMARY", "AXIAL"], ["DERIVED", "SECONDARY"]), "DERIVED/SECONDARY"),
        ("FrameReferenceTime", (1000, 61000), "reference time 61000 ms"),
    ],
)
def test_volumes_at_the_same_places_with_the_same_numbers(
    trait: str, values: tuple, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both(tmp_path, {trait: values[0]}, {trait: values[1]})
    is_either(tmp_path, words)
    if trait in OF_TIME:
        read, real = [], dicom.read_frames
        monkeypatch.setattr(dicom, "read_frames", lambda file: read.append(file) or real(file))
        for source in (tmp_path, tmp_path / "b07.dcm"):
            np.testing.assert_array_equal([point.array for point in read_time_points(source)], [A, B])
        assert len(read) == 2 * len(set(read)), "each header once"
        assert not any("left out" in note for point in read_time_points(tmp_path) for note in point.notes)
    else:
        with pytest.raises(InputError, match="has no other time points"):
            read_time_points(tmp_path)


def test_private_b_values_of_the_makers(tmp_path: Path) -> None:
    for n, (array, b) in enumerate(((A, 0), (B, 800))):
        for k, plane in enumerate(array):
            ds = classic(plane, HEIGHTS[k], k + 1)
            ds.private_block(0x0019, "SIEMENS MR HEADER", create=True).add_new(0x0C, "IS", b)
            save(ds, tmp_path / f"{n}{k}.dcm")
    is_either(tmp_path, "b-value 800")


def test_acquisitions_between_each_other(tmp_path: Path) -> None:
    both(tmp_path, {"AcquisitionNumber": 1}, {"AcquisitionNumber": 2}, [h + 1.5 for h in HEIGHTS], number=11)
    is_either(tmp_path, "acquisition 2")


def test_times_of_acquisitions_between_each_other(tmp_path: Path) -> None:
    times = {"AcquisitionTime": "100000"}, {"AcquisitionTime": "100100"}
    both(tmp_path, *times, [h + 1.5 for h in HEIGHTS], number=11)
    is_either(tmp_path, "acquisition time 2 of 2")


def test_stacks_between_each_other_that_only_numbers_tell_apart(tmp_path: Path) -> None:
    both(tmp_path, {}, {}, [h + 1.5 for h in HEIGHTS], number=11)
    is_either(tmp_path, "stack 2 of 2")
    assert "by their numbers alone" in read_volume(tmp_path).notes[1]


def test_every_other_slice_first_is_one_volume(tmp_path: Path) -> None:
    for n in range(10):
        save(classic(A[n], HEIGHTS[n], 1 + n // 2 + 5 * (n % 2)), tmp_path / f"{n}.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert volume.notes == ()


def test_thick_and_thin_reconstructions(tmp_path: Path) -> None:
    save_stack(tmp_path, A, HEIGHTS, prefix="thin")
    save_stack(tmp_path, B[:5], HEIGHTS[::2], first=11, prefix="thick", SliceThickness=6)
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert "left out: 2: MR series 7, slice thickness 6 mm (5 x 6 x 5)" in volume.notes[0]
    assert read_volume(tmp_path, volume=2).spacing_mm[2] == 6


@pytest.mark.parametrize(
    "fields",
    [
        {"AcquisitionNumber": lambda n: 1 + n % 2},  # every other slice first: one volume in two passes
        {"AcquisitionNumber": lambda n: n + 1},
        {"AcquisitionTime": lambda n: f"10{n:02}00"},
        {"ContentTime": lambda n: f"10{n:02}00", "TriggerTime": lambda n: 100.0 + n},
        {"AcquisitionNumber": lambda n: 1 + n // 5},  # two stations of the table
        {"EchoTime": lambda n: 30 + 0.01 * (n % 3)},  # as it was measured
    ],
)
def test_what_differs_from_slice_to_slice_of_one_volume_does_not_split_it(fields: dict, tmp_path: Path) -> None:
    save_stack(tmp_path, A, HEIGHTS, **fields)
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert volume.notes == ()


def test_phases_of_a_heart_that_only_times_of_slices_tell_apart(tmp_path: Path) -> None:
    trigger = {"TriggerTime": lambda n: 10.0 + n}, {"TriggerTime": lambda n: 510.0 - n}
    both(tmp_path, *trigger, number=11)
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    np.testing.assert_array_equal(read_volume(tmp_path, volume=2).array, B)
    assert "told apart by their times and numbers" in volume.notes[1]


def test_images_that_nothing_tells_apart_are_refused(tmp_path: Path) -> None:
    both(tmp_path, {}, {})
    with pytest.raises(InputError, match="nothing in their headers tells them apart; export the series again"):
        read_volume(tmp_path)


def test_copies_of_the_same_instances_are_taken_once(tmp_path: Path) -> None:
    for n, plane in enumerate(A):
        ds = classic(plane, HEIGHTS[n], n + 1)
        save(ds, tmp_path / "one" / f"{n}.dcm")
        save(ds, tmp_path / "two" / f"{n}.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert volume.notes == ("10 images were there twice (the same instance); one of each was taken",)


def test_equal_images_under_other_names_are_taken_once(tmp_path: Path) -> None:
    save_stack(tmp_path, A, HEIGHTS)
    save(classic(A[4], HEIGHTS[4], 5), tmp_path / "again.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert volume.notes == ("1 images were there twice under other names; one of each was taken",)


def test_planes_and_pixels_are_named(tmp_path: Path) -> None:
    save_stack(tmp_path, A, HEIGHTS)
    for n in range(10):
        axes, place = [0, 1, 0, 0, 0, -1], [3.0 * n, 0, 0]
        ds = classic(B[n], 0, n + 1, ImageOrientationPatient=axes, ImagePositionPatient=place)
        save(ds, tmp_path / f"s{n}.dcm")
    is_either(tmp_path, "plane sagittal", second=B[::-1])


def test_a_series_for_every_slice(tmp_path: Path) -> None:
    for n, plane in enumerate(A):
        save(classic(plane, HEIGHTS[n], n + 1, series=generate_uid()), tmp_path / f"{9 - n}.dcm")
    volume = read_volume(tmp_path)
    np.testing.assert_array_equal(volume.array, A)
    assert volume.notes == (
        "every slice has a series of its own; slices of one grid at different places were put together",
    )


# --- multi-frame ----------------------------------------------------------------------------------------------------


def test_frames_are_ordered_by_their_places(tmp_path: Path) -> None:
    order = [0, 3, 6, 9, 1, 4, 7, 2, 5, 8]
    save(enhanced(A[order], [HEIGHTS[n] for n in order]), tmp_path / "a.dcm")
    volume = read_volume(tmp_path / "a.dcm")
    np.testing.assert_array_equal(volume.array, A)
    np.testing.assert_allclose(volume.ijk_to_ras @ (1, 1, 1, 1), (20.5 - 0.75, -30.25 - 0.5, STEP_MM, 1), atol=1e-12)
    assert volume.notes == ()


def test_frames_with_a_gap(tmp_path: Path) -> None:
    there = [0, 1, 2, 3, 6, 7, 8, 9]
    save(enhanced(A[there], [HEIGHTS[n] for n in there]), tmp_path / "a.dcm")
    volume = read_volume(tmp_path / "a.dcm")
    np.testing.assert_allclose(volume.array, A, atol=1)  # A rises evenly from slice to slice
    assert "1 gaps between slices, where 3 mm is usual: 9 mm after 9 mm; filled" in volume.notes[0]


@pytest.mark.parametrize(
    "macro, values, words",
    [
        ("MREchoSequence", ({"EffectiveEchoTime": 5.0}, {"EffectiveEchoTime": 50.0}), "echo time 50 ms"),
        ("MRDiffusionSequence", ({"DiffusionBValue": 0.0}, {"DiffusionBValue": 700.0}), "b-value 700"),
        ("TemporalPositionSequence", ({"TemporalPositionIndex": 1}, {"TemporalPositionIndex": 2}), "time point 2"),
        (
            "FrameContentSequence",
            ({"DimensionIndexValues": [1, 1]}, {"DimensionIndexValues": [1, 2]}),
            "dimension 2: 2",
        ),
        (
            "MRImageFrameTypeSequence",
            ({"FrameType": ["ORIGINAL", "PRIMARY", "M", "NONE"]}, {"FrameType": ["ORIGINAL", "PRIMARY", "P", "NONE"]}),
            "ORIGINAL/PRIMARY/P/NONE",
        ),
        (
            "CardiacSynchronizationSequence",
            ({"NominalCardiacTriggerDelayTime": 0.0}, {"NominalCardiacTriggerDelayTime": 40.0}),
            "trigger time 40 ms",
        ),
    ],
)
def test_contrasts_of_one_file(macro: str, values: tuple, words: str, tmp_path: Path) -> None:
    """Slice by slice, as most scanners store them."""
    frames = [plane for pair in zip(A, B) for plane in pair]
    groups = [{macro: values[n % 2]} for n in range(20)]
    save(enhanced(frames, [HEIGHTS[n // 2] for n in range(20)], groups), tmp_path / "a.dcm")
    is_either(tmp_path, words)
    np.testing.assert_array_equal(read_volume(tmp_path / "a.dcm", volume=2).array, B)


def test_every_frame_has_its_own_rescale(tmp_path: Path) -> None:
    groups = [
        {"PixelValueTransformationSequence": {"RescaleSlope": 0.25 * (n + 1), "RescaleIntercept": -n}}
        for n in range(10)
    ]
    save(enhanced(A, HEIGHTS, groups), tmp_path / "a.dcm")
    volume = read_volume(tmp_path / "a.dcm")
    expected = [A[n] * 0.25 * (n + 1) - n for n in range(10)]
    assert volume.array.dtype == np.float32
    np.testing.assert_array_equal(volume.array, expected)


def test_a_concatenation_is_one_volume_and_two_files_are_two(tmp_path: Path) -> None:
    for name, part in (("a", slice(0, 5)), ("b", slice(5, 10))):
        ds = enhanced(A[part], HEIGHTS[part])
        ds.ConcatenationUID = "1.2.9"
        save(ds, tmp_path / "concatenation" / f"{name}.dcm")
    np.testing.assert_array_equal(read_volume(tmp_path / "concatenation").array, A)
    for number, array in enumerate((A, B), 1):
        ds = enhanced(array, HEIGHTS)
        ds.InstanceNumber = number
        save(ds, tmp_path / "two" / f"{3 - number}.dcm")
    is_either(tmp_path / "two", "no. 2 of 2")


def without_groups(frames: np.ndarray, **fields) -> Dataset:
    """A multi-frame file as nuclear medicine and X-ray write them: one position, and vectors."""
    ds = enhanced(frames, [0] * len(frames))
    del ds.PerFrameFunctionalGroupsSequence, ds.SharedFunctionalGroupsSequence
    ds.PixelSpacing, ds.SpacingBetweenSlices = [0.5, 0.75], STEP_MM
    for name, value in fields.items():
        setattr(ds, name, value)
    return ds


@pytest.mark.parametrize(
    "fields",
    [
        {"FrameIncrementPointer": 0x00181063, "FrameTime": 40},
        {"FrameIncrementPointer": 0x00540090, "AngularViewVector": [*range(1, 11)], "Modality": "NM"},
        {"Modality": "US"},
    ],
)
def test_films_and_projections_are_no_stacks(fields: dict, tmp_path: Path) -> None:
    save(without_groups(A, **fields), tmp_path / "a.dcm")
    volume = read_volume(tmp_path / "a.dcm")
    np.testing.assert_array_equal(volume.array, A[:1])
    assert "the first of 10 volumes; left out: 2: " in volume.notes[0] and " and 1 more" in volume.notes[0]


@pytest.mark.parametrize("upwards", [True, False])
def test_slices_and_energy_windows_of_nuclear_medicine(upwards: bool, tmp_path: Path) -> None:
    slices = [*range(1, 11)] if upwards else [*range(10, 0, -1)]
    detector = macro(ImageOrientationPatient=[1, 0, 0, 0, 1, 0], ImagePositionPatient=[*ORIGIN_MM, 7])
    pointers = {"FrameIncrementPointer": [0x00540010, 0x00540080], "DetectorInformationSequence": detector}
    vectors = {"EnergyWindowVector": [1] * 10 + [2] * 10, "SliceVector": slices * 2, "Modality": "NM"}
    save(without_groups(np.concatenate([A, B]), **pointers, **vectors), tmp_path / "a.dcm")
    is_either(tmp_path, "energy window 2", *((A, B) if upwards else (A[::-1], B[::-1])))
    volume = read_volume(tmp_path / "a.dcm")
    np.testing.assert_allclose(volume.ijk_to_ras[:3, 3], (20.5, -30.25, 7))
    assert "equidistant, as its header says" in volume.notes[1]


# --- mosaics --------------------------------------------------------------------------------------------------------


def test_mosaic(tmp_path: Path) -> None:
    save(mosaic(A[:6], (*ORIGIN_MM, 0)), tmp_path / "a.dcm")
    volume = read_volume(tmp_path / "a.dcm")
    np.testing.assert_array_equal(volume.array, A[:6])
    np.testing.assert_allclose(volume.ijk_to_ras @ (1, 1, 1, 1), (20.5 - 0.75, -30.25 - 0.5, STEP_MM, 1), atol=1e-12)
    assert volume.notes == ("a Siemens mosaic: 6 slices were cut out of one picture",)


def test_mosaics_are_time_points(tmp_path: Path) -> None:
    for number, array in enumerate((A, B), 1):
        ds = mosaic(array, (*ORIGIN_MM, 0), number, AcquisitionNumber=number)
        save(ds, tmp_path / f"{5 - number}.dcm")
    is_either(tmp_path, "acquisition 2")


def test_mosaic_of_unknown_slices_is_refused(tmp_path: Path) -> None:
    save(mosaic(A, (*ORIGIN_MM, 0), count_known=False), tmp_path / "a.dcm")
    with pytest.raises(InputError, match=r"a Siemens mosaic.*convert it with dcm2niix"):
        read_volume(tmp_path / "a.dcm")


def test_names_and_notes_hold_no_words_of_the_header(tmp_path: Path) -> None:
    both(tmp_path, {"EchoTime": 1, "PatientID": "ID-77"}, {"EchoTime": 2, "PatientID": "ID-77"})
    volume = read_volume(tmp_path)
    choices, notes = list_volumes(tmp_path)
    said = " ".join([volume.name, *volume.notes, *notes, *(choice.text() for choice in choices)])
    assert "echo time" in said and not any(word in said for word in ("DOE", "JANE", "ID-77", "HEAD"))
