"""Tissue labels: label maps and segmentations become the library's guard; the scene is left as it was."""

from __future__ import annotations

import types

import numpy as np
import pytest
import slicer
import vtk
from host_fixtures import grey_node, label_node, node_ids

from MedColorLib.errors import InputError, SettingsError

REFERENCE = np.full((4, 5, 3), (180, 90, 40), np.uint8)


@pytest.fixture
def logic(scene):
    from MedColorSlicer.logic import MedColorLogic

    return MedColorLogic()


@pytest.fixture
def segmentations(scene, monkeypatch):
    """Slicer's own module logic, as `slicer.modules` offers it."""
    module_logic = slicer.vtkSlicerSegmentationsModuleLogic()
    module_logic.SetMRMLScene(scene)
    module = types.SimpleNamespace(logic=lambda: module_logic)
    monkeypatch.setattr(slicer.modules, "segmentations", module, raising=False)
    return module_logic


def segmentation_of(label_map, module_logic):
    """A segmentation with a segment for each label of a label map, which is removed."""
    node = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "organs")
    node.CreateDefaultDisplayNodes()
    assert module_logic.ImportLabelmapToSegmentationNode(label_map, node)
    slicer.mrmlScene.RemoveNode(label_map.GetDisplayNode())
    slicer.mrmlScene.RemoveNode(label_map)
    return node


def test_label_map_becomes_the_guard(logic, library):
    labels = label_node()
    logic.process(grey_node(), [REFERENCE], labels=labels, labelGroups={2: 1})
    (guard,) = library.guards
    np.testing.assert_array_equal(guard.labels.array, slicer.util.arrayFromVolume(labels))
    assert guard.members == {1: (1, 2)} and guard.labels.name == "tissues" and guard.reference_labels is None
    slicer.util.arrayFromVolume(labels)[:] = 9
    assert guard.labels.array.max() == 2  # a copy


def test_no_labels_no_guard(logic, library):
    logic.process(grey_node(), [REFERENCE])
    assert library.guards == [None]


def test_labels_of_references(logic, library):
    drawn = np.ones((4, 5), np.uint8)
    node = label_node(drawn[None] * 2, "drawn")
    logic.process(grey_node(), [REFERENCE] * 4, labels=label_node(), referenceLabels=["a.png", drawn, node, None])
    path, array, from_node, nothing = library.guards[0].reference_labels
    assert (path, nothing) == ("a.png", None) and array is drawn
    np.testing.assert_array_equal(from_node, drawn * 2)


def test_labels_are_placed_by_their_transform(logic, library):
    shift = vtk.vtkMatrix4x4()
    shift.SetElement(0, 3, 7.0)
    transform = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLinearTransformNode")
    transform.SetMatrixTransformToParent(shift)
    grey, labels = grey_node(), label_node()
    for node in (grey, labels):
        node.SetAndObserveTransformNodeID(transform.GetID())
    logic.process(grey, [REFERENCE], labels=labels)
    volume, *_ = library.calls[0]
    np.testing.assert_array_equal(library.guards[0].labels.ijk_to_ras, volume.ijk_to_ras)
    assert volume.ijk_to_ras[0, 3] == 7.0


def test_preview_and_plan_have_the_guard_too(logic, library, monkeypatch):
    import MedColorLib

    plans = []
    monkeypatch.setattr(MedColorLib, "make_plan", lambda *_arguments, guard: plans.append(guard))
    grey, labels = grey_node(), label_node()
    logic.preview(grey, [REFERENCE], 2, labels=labels)
    logic.plan(grey, [REFERENCE], labels=labels)
    assert library.guards[0].present == plans[0].present == (1, 2)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (grey_node, "holds no tissue labels"),
        (lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", "empty"), "has no voxels"),
        (lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "empty"), "has no segments"),
    ],
)
def test_what_cannot_be_labels(logic, library, make, words):
    with pytest.raises(InputError, match=words):
        logic.process(grey_node(), [REFERENCE], labels=make())
    assert not library.calls


@pytest.mark.parametrize("options", [{"referenceLabels": ["a.png"]}, {"labelGroups": {1: 2}}])
def test_what_belongs_to_labels_alone(logic, library, options):
    with pytest.raises(SettingsError, match="give labels, too"):
        logic.process(grey_node(), [REFERENCE], **options)


def test_segmentation_is_exported_on_the_grid_of_the_input(logic, library, segmentations):
    """Drawn on a grid of half the spacing and another extent; hidden segments count as well."""
    fine = np.zeros((14, 18, 22), np.uint8)
    fine[2:8, 4:12, 2:18], fine[8:12, 4:12, 2:18] = 1, 2
    drawn = label_node(fine, "drawn")
    drawn.SetSpacing(0.5, 0.5, 0.5)
    segmentation = segmentation_of(drawn, segmentations)
    second = segmentation.GetSegmentation().GetNthSegmentID(1)
    segmentation.GetDisplayNode().SetSegmentVisibility(second, False)
    grey = grey_node()
    before = node_ids(slicer.mrmlScene)
    logic.planner(grey, [REFERENCE], labels=segmentation)
    assert node_ids(slicer.mrmlScene) == before
    logic.process(grey, [REFERENCE], labels=segmentation)
    guard = library.guards[0]
    assert guard.present == (0, 1, 2) and guard.labels.name == "organs"
    assert guard.labels.array.shape == (6, 8, 10)
    np.testing.assert_array_equal(guard.labels.ijk_to_ras, np.eye(4))
    assert guard.labels.array[2, 3, 4] == 1 and guard.labels.array[5, 3, 4] == 2 and guard.labels.array[0, 0, 0] == 0


def test_a_failed_export_leaves_nothing(logic, library, segmentations, monkeypatch):
    segmentation = segmentation_of(label_node(), segmentations)
    grey = grey_node()
    before = node_ids(slicer.mrmlScene)
    broken = types.SimpleNamespace(ExportSegmentsToLabelmapNode=lambda *_arguments: False)
    monkeypatch.setattr(slicer.modules, "segmentations", types.SimpleNamespace(logic=lambda: broken))
    with pytest.raises(InputError, match="organs cannot be exported"):
        logic.process(grey, [REFERENCE], labels=segmentation)
    assert node_ids(slicer.mrmlScene) == before and not library.calls


def test_without_the_segmentations_module(logic, library, segmentations, monkeypatch):
    segmentation = segmentation_of(label_node(), segmentations)
    monkeypatch.delattr(slicer.modules, "segmentations")
    with pytest.raises(InputError, match="Segmentations is not loaded; export organs as a label map"):
        logic.process(grey_node(), [REFERENCE], labels=segmentation)


def test_a_real_run_keeps_tissues_apart(logic):
    """The library itself: the report in the scene names the groups."""
    from MedColorLib.phantom import sample

    volume, picture = sample()
    every = np.s_[20:24, ::2, ::2]
    array = np.ascontiguousarray(volume.array[every])
    matrix = volume.ijk_to_ras @ np.diag([2.0, 2.0, 1.0, 1.0])
    grey = slicer.util.addVolumeFromArray(array, matrix, "head")
    labels = label_node((array > 200).astype(np.uint8), "bone")
    labels.SetIJKToRASMatrix(slicer.util.vtkMatrixFromArray(matrix))
    node = logic.process(grey, [picture], labels=labels, preset="draft", features="embedded", device="cpu")
    assert '"guard": {' in node.GetAttribute("MedColor.Report")
    assert "2 label groups of bone" in node.GetAttribute("MedColor.Report")
    labels.SetOrigin(0, 0, 0)
    with pytest.raises(InputError, match="resample the labels"):
        logic.process(grey, [picture], labels=labels, preset="draft", features="embedded", device="cpu")


@pytest.mark.parametrize(
    ("name", "entry", "group"),
    [
        ("femur_left", "", "bone"),
        ("pulmonary_vein", "", "vessels"),
        ("lung_upper_lobe_left", "", "airways and lungs"),
        ("gluteus_maximus_right", "", "muscle"),
        ("subcutaneous_fat", "", "fat"),
        (
            "Segment_1",
            "Segmentation category and type~SCT^85756007^Tissue~SCT^272673000^Bone~^^~Anatomic~^^~^^",
            "bone",
        ),
        ("Segment_2", "list~SCT^85756007^Tissue~SCT^51114001^Artery~^^~list~^^~^^", "vessels"),
        ("femur", "list~SCT^85756007^Tissue~SCT^85756007^Tissue~^^~list~^^~^^", "bone"),
        ("Segment_3", "", "others"),
        ("", "~~~", "others"),
    ],
)
def test_tissues_by_terminology_or_name(scene, name, entry, group):
    from MedColorSlicer import tissues

    assert tissues.tissue_of(name, entry) == group


def test_many_segments_are_grouped_by_what_they_are_called(logic, library, segmentations):
    """As TotalSegmentator makes them: more than the library keeps apart."""
    voxels = np.zeros((6, 8, 10), np.uint8)
    voxels.ravel()[:40] = 1 + np.arange(40) % 20
    segmentation = segmentation_of(label_node(voxels), segmentations)
    segments = segmentation.GetSegmentation()
    assert segments.GetNumberOfSegments() == 20
    for n in range(20):
        segments.GetNthSegment(n).SetName(("rib_left_", "artery_", "muscle_", "thing_")[n % 4] + str(n))
    segments.GetNthSegment(3).SetTag("TerminologyEntry", "list~SCT^1^Tissue~SCT^2^Bone~^^~list~^^~^^")
    logic.process(grey_node(), [REFERENCE], labels=segmentation)
    (guard,) = library.guards
    assert len(guard.present) == 5, "with what lies outside all segments"
