"""Nodes to library volumes and back: geometry, copies, all or nothing, bad input."""

from __future__ import annotations

import json
import os
import stat

import numpy as np
import pytest
import slicer
import vtk
from host_fixtures import color_node, grey_node, node_ids
from panel_fixtures import warp

from MedColorLib.errors import InputError
from MedColorLib.volume import ColorVolume

OBLIQUE = np.array([[0.0, -0.8, 0.6, 10.0], [0.5, 0.0, 0.0, -20.0], [0.0, 0.6, 0.8, 30.0], [0, 0, 0, 1]])
OBLIQUE[:3, :3] = OBLIQUE[:3, :3] * (2.0, 1.0, 3.0)


@pytest.fixture
def nodes(scene):
    from MedColorSlicer import scene as nodes

    return nodes


@pytest.fixture
def references(scene):
    from MedColorSlicer import references

    return references


def linear_transform(matrix, parent=None):
    node = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLinearTransformNode")
    node.SetMatrixTransformToParent(slicer.util.vtkMatrixFromArray(matrix))
    if parent:
        node.SetAndObserveTransformNodeID(parent.GetID())
    return node


def published(nodes, grey, rgb=None, output=None, **options):
    rgb = np.zeros((*slicer.util.arrayFromVolume(grey).shape, 3), np.uint8) if rgb is None else rgb
    return nodes.publish(ColorVolume(rgb, np.eye(4), {"plan": 'a:b;c "d" é'}), grey, output, **options)


def test_geometry_includes_nested_linear_transforms(nodes):
    shift, turn = np.eye(4), np.diag([-1.0, 1.0, 2.0, 1.0])
    shift[:3, 3] = 1, 2, 3
    grey = grey_node(matrix=OBLIQUE)
    grey.SetAndObserveTransformNodeID(linear_transform(shift, linear_transform(turn)).GetID())
    volume = nodes.volume_from_node(grey)
    np.testing.assert_allclose(volume.ijk_to_ras, turn @ shift @ OBLIQUE, atol=1e-9)
    np.testing.assert_array_equal(volume.array, slicer.util.arrayFromVolume(grey))


def test_nonlinear_transform_is_no_part_of_the_geometry(nodes):
    grey = grey_node(matrix=OBLIQUE)
    bend = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLTransformNode")
    spline = vtk.vtkThinPlateSplineTransform()
    points = vtk.vtkPoints()
    for point in ((0, 0, 0), (10, 0, 0), (0, 10, 0), (0, 0, 10), (5, 5, 9)):
        points.InsertNextPoint(point)
    moved = vtk.vtkPoints()
    moved.DeepCopy(points)
    moved.SetPoint(4, 9, 5, 9)
    spline.SetSourceLandmarks(points)
    spline.SetTargetLandmarks(moved)
    spline.SetBasisToR()
    bend.SetAndObserveTransformToParent(spline)
    grey.SetAndObserveTransformNodeID(bend.GetID())
    np.testing.assert_allclose(nodes.volume_from_node(grey).ijk_to_ras, OBLIQUE, atol=1e-9)
    assert published(nodes, grey).GetTransformNodeID() == bend.GetID()


def test_library_gets_a_copy(nodes):
    grey = grey_node()
    volume = nodes.volume_from_node(grey)
    before = volume.array.copy()
    slicer.util.arrayFromVolume(grey)[:] = 0
    slicer.mrmlScene.RemoveNode(grey)
    np.testing.assert_array_equal(volume.array, before)


def test_how_a_volume_is_shown_does_not_matter(nodes):
    grey = grey_node()
    grey.CreateDefaultDisplayNodes()
    grey.GetDisplayNode().SetAutoWindowLevel(False)
    grey.GetDisplayNode().SetWindowLevel(3, 7)
    assert nodes.volume_from_node(grey).window is None


def test_result_has_type_geometry_transform_and_place_of_the_input(nodes, scene):
    hierarchy = slicer.vtkMRMLSubjectHierarchyNode.GetSubjectHierarchyNode(scene)
    grey = grey_node("head", matrix=OBLIQUE)
    folder = hierarchy.CreateFolderItem(hierarchy.GetSceneItemID(), "study")
    hierarchy.CreateItem(folder, grey)
    transform = linear_transform(np.diag([2.0, 1, 1, 1]))
    grey.SetAndObserveTransformNodeID(transform.GetID())
    rgb = np.random.default_rng(0).integers(0, 256, (6, 8, 10, 3), dtype=np.uint8)
    result = published(nodes, grey, rgb, settings={"preset": "draft"})
    assert result.GetClassName() == "vtkMRMLVectorVolumeNode"
    assert result.GetVoxelVectorType() == result.VoxelVectorTypeColorRGB
    assert result.GetName() == "head coloured"
    np.testing.assert_array_equal(slicer.util.arrayFromVolume(result), rgb)
    assert slicer.util.arrayFromVolume(result).dtype == np.uint8
    matrix = vtk.vtkMatrix4x4()
    result.GetIJKToRASMatrix(matrix)
    np.testing.assert_allclose(slicer.util.arrayFromVTKMatrix(matrix), OBLIQUE, atol=1e-9)
    assert result.GetTransformNodeID() == transform.GetID()
    assert hierarchy.GetItemParent(hierarchy.GetItemByDataNode(result)) == folder
    assert result.GetNodeReference(nodes.INPUT_ROLE) is grey
    assert json.loads(result.GetAttribute(nodes.SETTINGS_ATTRIBUTE)) == {"preset": "draft"}
    assert json.loads(result.GetAttribute(nodes.REPORT_ATTRIBUTE)) == {"plan": 'a:b;c "d" é'}
    assert result.GetVolumeDisplayNode() is not None
    assert published(nodes, grey).GetName() == "head coloured_1"


def test_failed_publication_leaves_nothing(nodes, scene):
    grey = grey_node()
    before = node_ids(scene)
    with pytest.raises(TypeError):
        nodes.publish(ColorVolume(np.zeros((6, 8, 10, 3), np.uint8), np.eye(4), {"no JSON": object()}), grey)
    assert node_ids(scene) == before


def test_failure_half_way_leaves_nothing(nodes, scene, monkeypatch):
    def fail(*_):
        raise KeyboardInterrupt

    grey = grey_node()
    before = node_ids(scene)
    monkeypatch.setattr(nodes, "_place_beside", fail)
    with pytest.raises(KeyboardInterrupt):
        published(nodes, grey)
    assert node_ids(scene) == before


def with_confidence(grey, per_cent=40):
    shape = slicer.util.arrayFromVolume(grey).shape
    confidence = np.full(shape, per_cent, np.uint8) if per_cent is not None else None
    return ColorVolume(np.zeros((*shape, 3), np.uint8), np.eye(4), {}, confidence=confidence)


def test_confidence_lies_beside_the_result_and_goes_with_it(nodes, scene):
    hierarchy = slicer.vtkMRMLSubjectHierarchyNode.GetSubjectHierarchyNode(scene)
    folder = hierarchy.CreateFolderItem(hierarchy.GetSceneItemID(), "folder")
    grey = grey_node(matrix=OBLIQUE)
    transform = linear_transform(np.diag([1.0, 2.0, 1.0, 1.0]))
    grey.SetAndObserveTransformNodeID(transform.GetID())
    hierarchy.SetItemParent(hierarchy.CreateItem(folder, grey), folder)
    result = nodes.publish(with_confidence(grey), grey)
    volume = result.GetNodeReference(nodes.CONFIDENCE_ROLE)
    assert volume.GetClassName() == "vtkMRMLScalarVolumeNode"
    assert volume.GetName() == f"{result.GetName()} confidence"
    voxels = slicer.util.arrayFromVolume(volume)
    assert voxels.dtype == np.uint8 and voxels.shape == slicer.util.arrayFromVolume(grey).shape and (voxels == 40).all()
    np.testing.assert_allclose(nodes.ijk_to_world(volume), nodes.ijk_to_world(grey))
    assert volume.GetTransformNodeID() == transform.GetID()
    assert hierarchy.GetItemParent(hierarchy.GetItemByDataNode(volume)) == folder
    display = volume.GetVolumeDisplayNode()
    assert (display.GetWindow(), display.GetLevel(), display.GetAutoWindowLevel()) == (100.0, 50.0, 0)
    display.SetWindowLevel(10.0, 5.0)
    before = scene.GetNumberOfNodes()
    nodes.publish(with_confidence(grey, 90), grey, result)
    assert result.GetNodeReference(nodes.CONFIDENCE_ROLE) is volume
    assert (slicer.util.arrayFromVolume(volume) == 90).all()
    assert display.GetWindow() == 10.0
    assert scene.GetNumberOfNodes() == before
    nodes.publish(with_confidence(grey, None), grey, result)
    assert result.GetNodeReference(nodes.CONFIDENCE_ROLE) is None
    assert not scene.IsNodePresent(volume)


def test_failed_confidence_leaves_nothing(nodes, scene, monkeypatch):
    grey = grey_node()
    before = node_ids(scene)
    fill = nodes._fill

    def fail_for_scalars(node, *arguments):
        fill(node, *arguments)
        if node.GetClassName() == "vtkMRMLScalarVolumeNode":
            raise MemoryError

    monkeypatch.setattr(nodes, "_fill", fail_for_scalars)
    with pytest.raises(MemoryError):
        nodes.publish(with_confidence(grey), grey)
    assert node_ids(scene) == before


def test_a_colour_picture_that_slicer_loads_is_a_reference(nodes, references, scene, host, tmp_path):
    """As Sample Data loads the cryosection: an archetype volume, one file. (The wheel reads no PNG.)"""
    import SimpleITK

    picture = np.random.default_rng(3).integers(0, 256, (9, 7, 3), np.uint8)
    path = str(tmp_path / "section7.mha")
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(picture, isVector=True), path)
    logic = slicer.vtkSlicerVolumesLogic()
    logic.SetMRMLScene(scene)
    logic.SetMRMLApplicationLogic(host.application_logic)
    single_file = 4
    node = logic.AddArchetypeVolume(path, "MedColorCryosection", single_file)
    assert node.GetClassName() == "vtkMRMLVectorVolumeNode"
    assert references.reference_problem(node, None) == ""
    np.testing.assert_array_equal(references.picture_from_node(node), picture)


def test_saved_and_reopened(nodes, scene, tmp_path):
    grey = grey_node("head", matrix=OBLIQUE)
    transform = linear_transform(np.diag([2.0, 1, 1, 1]))
    grey.SetAndObserveTransformNodeID(transform.GetID())
    rgb = np.random.default_rng(1).integers(0, 256, (6, 8, 10, 3), dtype=np.uint8)
    published(nodes, grey, rgb, settings={"window": [1.5, 2.5]})
    assert scene.WriteToMRB(str(tmp_path / "x.mrb"))
    scene.Clear(0)
    assert scene.ReadFromMRB(str(tmp_path / "x.mrb"))
    (result,) = slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")
    np.testing.assert_array_equal(slicer.util.arrayFromVolume(result), rgb)
    assert result.GetVoxelVectorType() == result.VoxelVectorTypeColorRGB
    assert json.loads(result.GetAttribute(nodes.SETTINGS_ATTRIBUTE)) == {"window": [1.5, 2.5]}
    assert json.loads(result.GetAttribute(nodes.REPORT_ATTRIBUTE)) == {"plan": 'a:b;c "d" é'}
    assert result.GetNodeReference(nodes.INPUT_ROLE).GetName() == "head"
    np.testing.assert_allclose(nodes.ijk_to_world(result), np.diag([2.0, 1, 1, 1]) @ OBLIQUE, atol=1e-5)


BAD_INPUTS = {
    "none": (lambda: None, "Select a volume"),
    "no image data": (lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "v"), "no voxels"),
    "colour": (lambda: color_node(np.zeros((2, 3, 4, 3), np.uint8)), "several values"),
    "five components": (lambda: color_node(np.zeros((2, 3, 4, 5), np.uint8)), "several values"),
    "tensor": (lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLDiffusionTensorVolumeNode", "v"), "several values"),
    "label map": (
        lambda: slicer.util.addVolumeFromArray(np.ones((2, 3, 4), np.uint8), nodeClassName="vtkMRMLLabelMapVolumeNode"),
        "label map",
    ),
    "model": (lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLModelNode", "v"), "is no volume"),
    "sequence": (lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceNode", "v"), "is a sequence of volumes"),
    "segmentation": (lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "v"), "label map"),
}


@pytest.mark.parametrize("case", BAD_INPUTS)
def test_bad_input_says_what_to_do(nodes, case):
    make, words = BAD_INPUTS[case]
    node = make()
    problem = nodes.input_problem(node)
    assert words in problem
    assert problem.endswith(".")
    with pytest.raises(InputError, match=words):
        nodes.volume_from_node(node)


def test_removed_input(nodes):
    grey = grey_node()
    slicer.mrmlScene.RemoveNode(grey)
    assert "removed" in nodes.input_problem(grey)


def test_scalar_node_with_several_components(nodes):
    grey = grey_node()
    image = vtk.vtkImageData()
    image.SetDimensions(2, 2, 2)
    image.AllocateScalars(vtk.VTK_SHORT, 2)
    grey.SetAndObserveImageData(image)
    assert "2 values per voxel" in nodes.input_problem(grey)


def test_pictures_of_a_folder_in_order(references, tmp_path):
    for name in ("b.PNG", "a.jpg", "c.tiff", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [os.path.basename(path) for path in references.pictures_in(str(tmp_path))] == ["a.jpg", "b.PNG", "c.tiff"]
    assert references.pictures_in(str(tmp_path / "a.jpg")) == [str(tmp_path / "a.jpg")]
    assert references.references_from(tmp_path) == ([str(tmp_path)], None)


def test_folders_that_hold_no_reference(references, tmp_path):
    with pytest.raises(InputError, match="no pictures"):
        references.pictures_in(str(tmp_path))
    with pytest.raises(InputError, match="no file or folder"):
        references.pictures_in(str(tmp_path / "absent"))
    with pytest.raises(InputError, match="no reference"):
        references.references_from([])


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser can read every folder")
def test_folder_without_permission(references, tmp_path):
    tmp_path.chmod(0)
    try:
        with pytest.raises(InputError, match="permissions"):
            references.pictures_in(str(tmp_path))
    finally:
        tmp_path.chmod(stat.S_IRWXU)


def test_colour_nodes_as_reference(references):
    stack = np.random.default_rng(2).integers(0, 256, (3, 5, 7, 4), dtype=np.uint8)
    picture = references.picture_from_node(color_node(stack))
    np.testing.assert_array_equal(picture, stack[1, :, :, :3])


BAD_REFERENCES = {
    "none": (lambda grey: None, "Select a colour volume"),
    "the input": (lambda grey: grey, "input itself"),
    "grey": (lambda grey: grey_node("other"), "no 8-bit colour"),
    "16-bit": (lambda grey: color_node(np.zeros((1, 3, 4, 3), np.uint16)), "no 8-bit colour"),
    "empty": (lambda grey: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", "v"), "no voxels"),
}


@pytest.mark.parametrize("case", BAD_REFERENCES)
def test_bad_reference_says_what_to_do(references, case):
    make, words = BAD_REFERENCES[case]
    grey = grey_node()
    with pytest.raises(InputError, match=words):
        references.references_from([make(grey)], grey)


def roi_node(center, size):
    roi = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLMarkupsROINode", "R")
    roi.SetXYZ(*center)
    roi.SetRadiusXYZ(*(np.array(size) / 2))
    return roi


def test_region_is_the_box_of_voxels_inside_the_roi(nodes):
    grey = grey_node(shape=(20, 30, 40), matrix=np.diag([-1.0, 1.0, 2.0, 1.0]))
    grey.SetAndObserveTransformNodeID(linear_transform(np.diag([1.0, 1, 0.5, 1])).GetID())
    roi = roi_node((-12, 10, 8), (6, 8, 10))
    region = nodes.region_from_roi(roi, grey)
    bounds = [0.0] * 6
    roi.GetRASBounds(bounds)
    k, j, i = np.mgrid[:20, :30, :40]
    world = np.einsum("ab,bkji->akji", nodes.ijk_to_world(grey), np.stack([i, j, k, np.ones_like(i)]))[:3]
    inside = np.all([(world[a] >= bounds[2 * a]) & (world[a] <= bounds[2 * a + 1]) for a in range(3)], axis=0)
    for (start, stop), axes in zip(region, ((1, 2), (0, 2), (0, 1))):
        hit = np.flatnonzero(inside.any(axis=axes))
        assert start <= hit[0]
        assert hit[-1] < stop
        assert (stop - start) - hit.size <= 2
    assert nodes.region_from_roi(None, grey) is None


def turned_by(*degrees, shift=(0, 0, 0)):
    """A transform node: turned about R, A and S, then moved."""
    transform = vtk.vtkTransform()
    transform.Translate(*shift)
    for turn, angle in zip((transform.RotateX, transform.RotateY, transform.RotateZ), degrees):
        turn(angle)
    return linear_transform(slicer.util.arrayFromVTKMatrix(transform.GetMatrix()))


SAME_TURN = (25, -40, 10)


@pytest.mark.parametrize("of_volume", [None, SAME_TURN, (5, 0, 80)])
@pytest.mark.parametrize("of_roi", [None, SAME_TURN])
@pytest.mark.parametrize("own_turn", [0, 30])
def test_region_of_turned_rois_and_volumes(nodes, of_volume, of_roi, own_turn):
    """By MRML's own matrix of the ROI, and many points inside it."""
    grey = grey_node(shape=(20, 30, 40), matrix=np.diag([-1.0, 1.0, 2.0, 1.0]))
    roi = roi_node((-20, 15, 20), (6, 8, 10))
    plain = nodes.region_from_roi(roi, grey)
    if own_turn:
        turn = vtk.vtkTransform()
        turn.Translate(-20, 15, 20)
        turn.RotateZ(own_turn)
        roi.SetAndObserveObjectToNodeMatrix(turn.GetMatrix())
    for node, angles in ((grey, of_volume), (roi, of_roi)):
        if angles:
            node.SetAndObserveTransformNodeID(turned_by(*angles).GetID())
    if of_volume != of_roi:  # back onto the volume
        middle = nodes.ijk_to_world(grey) @ [20, 15, 10, 1]
        roi.SetCenterWorld(*middle[:3])
    to_world = slicer.util.arrayFromVTKMatrix(roi.GetObjectToWorldMatrix())
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20000, 3)) * roi.GetSize()
    world = to_world @ np.c_[points, np.ones(len(points))].T
    ijk = (np.linalg.inv(nodes.ijk_to_world(grey)) @ world)[:3]
    region = nodes.region_from_roi(roi, grey)
    for (start, stop), values, count in zip(region, ijk[::-1], (20, 30, 40)):
        assert start <= max(np.floor(values.min() + 0.5), 0)
        assert stop >= min(np.ceil(values.max() + 0.5), count)
        assert stop - start <= np.ptp(values) + 2.5, "and no more than that"
    if of_volume == of_roi and not own_turn:
        assert region == plain


def test_region_of_a_bent_volume_is_where_the_views_show_it(nodes):
    grey, roi = grey_node(shape=(20, 30, 40)), roi_node((20, 15, 10), (6, 8, 10))
    (k0, k1), (j0, j1), (i0, i1) = nodes.region_from_roi(roi, grey)
    node = warp(slicer.mrmlScene, 3.0)  # world to volume: 3 mm along every axis
    grey.SetAndObserveTransformNodeID(node.GetID())
    assert nodes.region_from_roi(roi, grey) == ((k0 + 3, k1 + 3), (j0 + 3, j1 + 3), (i0 + 3, i1 + 3))
    roi.SetAndObserveTransformNodeID(node.GetID())
    assert nodes.region_from_roi(roi, grey) == ((k0, k1), (j0, j1), (i0, i1))


def test_region_without_size(nodes):
    with pytest.raises(InputError, match="R has no size"):
        nodes.region_from_roi(roi_node((4, 4, 3), (5, 0, 5)), grey_node())


def test_region_outside_the_volume(nodes):
    with pytest.raises(InputError, match="outside the volume"):
        nodes.region_from_roi(roi_node((500, 0, 0), (5, 5, 5)), grey_node())


SAGITTAL = np.array([[0.0, 0, 2, 0], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("matrix", [np.eye(4), np.diag([-1.0, -1, -3, 1]), SAGITTAL, OBLIQUE])
def test_slice_numbers_are_those_of_the_library(nodes, matrix):
    from MedColorLib.scan.slices import slice_order

    grey = grey_node(shape=(5, 7, 9), matrix=matrix)
    voxels = slicer.util.arrayFromVolume(grey)
    stack = slice_order(nodes.ijk_to_world(grey)).view(voxels)
    assert nodes.stack_of(grey)[1] == stack.shape[0]
    for number in range(stack.shape[0]):
        slab, offset = nodes.slab_at(grey, number)
        assert set(voxels[slab].ravel()) == set(stack[number].ravel())
        center = [(n - 1) / 2 for n in grey.GetImageData().GetDimensions()]
        axis = int(np.argmax([n > 1 and voxels[slab].shape[2 - a] == 1 for a, n in enumerate((9, 7, 5))]))
        center[axis] = offset[axis]
        ras = nodes.ijk_to_world(grey) @ np.array([*center, 1.0])
        assert nodes.slice_index_at(grey, ras[:3]) == number
    assert nodes.slice_index_at(grey, (1e6, 1e6, 1e6)) in (0, stack.shape[0] - 1)


def test_part_is_placed_where_its_voxels_were(nodes):
    grey = grey_node(shape=(5, 7, 9), matrix=OBLIQUE)
    slab, offset = nodes.slab_at(grey, 2)
    part = published(nodes, grey, np.zeros((*slicer.util.arrayFromVolume(grey)[slab].shape, 3), np.uint8))
    nodes.place_part(part, grey, offset)
    first = nodes.ijk_to_world(part) @ np.array([0, 0, 0, 1.0])
    np.testing.assert_allclose(first, OBLIQUE @ np.array([*offset, 1.0]), atol=1e-9)
