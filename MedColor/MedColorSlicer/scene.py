"""MRML nodes <-> arrays and geometry. Copies, never borrows: a node may change or vanish while the library works."""

from __future__ import annotations

import dataclasses
import json

import slicer
import vtk
from slicer.i18n import tr as _

SETTINGS_ATTRIBUTE = "MedColor.Settings"
REPORT_ATTRIBUTE = "MedColor.Report"
INPUT_ROLE = "MedColorInput"
CONFIDENCE_ROLE = "MedColorConfidence"  # on the result: the volume of confidence that belongs to it
_CONFIDENCE_ATTRIBUTE = "MedColor.Confidence"  # on that volume: it is nothing to be coloured


def input_problem(node) -> str:
    """Why a node cannot be coloured, as a sentence that says what to do; empty if it can."""
    if node is None:
        return _("Select a volume to colour.")
    name = node.GetName()
    if node.GetScene() is None:
        return _("The volume has been removed from the scene; select another one.")
    if node.IsA("vtkMRMLLabelMapVolumeNode") or node.IsA("vtkMRMLSegmentationNode"):
        return _("{name} is a label map; select the grey volume it was drawn on.").format(name=name)
    return _kind_problem(node) or _voxel_problem(node)


def _kind_problem(node) -> str:
    name = node.GetName()
    if node.IsA("vtkMRMLSequenceNode"):
        return _(
            "{name} is a sequence of volumes; select the volume that its sequence browser shows, or call processSequence() of "
            "the logic for all time points."
        ).format(name=name)
    if not node.IsA("vtkMRMLVolumeNode"):
        return _("{name} is no volume; select a scalar (grey) volume.").format(name=name)
    if node.IsA("vtkMRMLTensorVolumeNode") or not node.IsA("vtkMRMLScalarVolumeNode"):
        return _("{name} has several values per voxel; select a scalar (grey) volume.").format(name=name)
    return ""


def is_confidence(node) -> bool:
    """Whether a volume is one of MedColor's own volumes of confidence."""
    return bool(node.GetAttribute(_CONFIDENCE_ATTRIBUTE))


def may_be_filled_from(output_node, input_node) -> bool:
    """Whether a volume can take the colours of another one without losing those of a third."""
    source = output_node.GetNodeReference(INPUT_ROLE)
    return source is input_node or (source is None and not output_node.GetAttribute(REPORT_ATTRIBUTE))


def result_of(input_node):
    """The latest volume of the scene that was made from this one and is saved with the scene; None without."""
    found = [
        node
        for node in slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")
        if node.GetNodeReference(INPUT_ROLE) is input_node and node.GetSaveWithScene()
        and node.GetAttribute(REPORT_ATTRIBUTE)
    ]  # fmt: skip
    return found[-1] if found else None


def behind(*nodes) -> list:
    """These nodes and what their look depends on: transforms and 3-D displays; None is left out."""
    found = []
    for start in nodes:
        node = start
        while node is not None:
            found.append(node)
            node = node.GetParentTransformNode() if node.IsA("vtkMRMLTransformableNode") else None
    return found


def voxel_state(node) -> tuple:
    """What changes whenever the voxels of a volume do."""
    image = node.GetImageData()
    return (image.GetAddressAsString(""), image.GetMTime()) if image else ()


def _voxel_problem(node) -> str:
    image = node.GetImageData()
    if image is None or image.GetPointData().GetScalars() is None or not all(image.GetDimensions()):
        return _("{name} has no voxels; load its image data or select another volume.").format(name=node.GetName())
    count = image.GetNumberOfScalarComponents()
    if count != 1:
        return _("{name} has {count} values per voxel; select a scalar (grey) volume.").format(
            name=node.GetName(), count=count
        )
    if not _has_extent(ijk_to_world(node)):
        return _(
            "{name} has no extent along one of its axes; correct its spacing (module Volumes) or its transform, or load it again."
        ).format(name=node.GetName())
    return ""


def _has_extent(matrix) -> bool:
    """Whether an IJK-to-RAS matrix (4, 4) can be inverted."""
    import numpy as np

    return bool(np.isfinite(matrix).all() and abs(np.linalg.det(matrix[:3, :3])) > 1e-30)


def volume_from_node(node):
    """MedColorLib.Volume of a scalar volume node: a copy of its voxels, placed in the world.

    A linear parent transform is part of the geometry. A non-linear one is not: it has no matrix, and colouring does not
    depend on it; the result goes under the same transform all the same.

    Raises:
        MedColorLib.errors.InputError: the node cannot be coloured.
    """
    from MedColorLib.errors import InputError
    from MedColorLib.volume import Volume

    problem = input_problem(node)
    if problem:
        raise InputError(problem)
    # no window is taken from the display node: the result must not depend on how the volume was last looked at
    return Volume(slicer.util.arrayFromVolume(node).copy(), ijk_to_world(node), name=node.GetName())


def ijk_to_world(node):
    """(4, 4) float64: the node's IJK-to-RAS matrix, followed by its linear parent transforms."""
    matrix = vtk.vtkMatrix4x4()
    node.GetIJKToRASMatrix(matrix)
    transform = node.GetParentTransformNode()
    if transform and transform.IsTransformToWorldLinear():
        to_world = vtk.vtkMatrix4x4()
        transform.GetMatrixTransformToWorld(to_world)
        vtk.vtkMatrix4x4.Multiply4x4(to_world, matrix, matrix)
    return slicer.util.arrayFromVTKMatrix(matrix)


def region_from_roi(roi_node, input_node):
    """((k0, k1), (j0, j1), (i0, i1)), half-open voxel ranges of the box around a markups ROI; None without one.

    ROI and volume may be turned and lie under transforms of their own, non-linear ones too: the ROI is taken where the views
    show it.

    Raises:
        MedColorLib.errors.InputError: the region has no size, or lies outside the volume.
    """
    if roi_node is None:
        return None
    import numpy as np

    from MedColorLib.errors import InputError

    if min(roi_node.GetSize()) <= 0:
        raise InputError(_("{name} has no size; drag its handles or select none.").format(name=roi_node.GetName()))
    ijk = _ijk_of_roi(roi_node, input_node)
    size = np.array(input_node.GetImageData().GetDimensions())
    low = np.clip(np.floor(ijk.min(axis=1) + 0.5), 0, size).astype(int)
    high = np.clip(np.ceil(ijk.max(axis=1) + 0.5), 0, size).astype(int)
    if (high <= low).any():
        raise InputError(_("{name} lies outside the volume; move it or select none.").format(name=roi_node.GetName()))
    return tuple((int(low[axis]), int(high[axis])) for axis in (2, 1, 0))


def region_state(roi_node) -> tuple:
    """What changes whenever a region does: by itself or with a transform it lies under."""
    if roi_node is None:
        return ()
    transform = roi_node.GetParentTransformNode()
    return (roi_node.GetID(), roi_node.GetMTime(), transform.GetTransformToWorldMTime() if transform else 0)


def _ijk_of_roi(roi_node, input_node):
    """(3, n) i, j, k of points of a ROI: its corners, and points between them where a transform may bend its sides."""
    import itertools

    import numpy as np

    between = vtk.vtkGeneralTransform()
    parents = roi_node.GetParentTransformNode(), input_node.GetParentTransformNode()
    slicer.vtkMRMLTransformNode.GetTransformBetweenNodes(*parents, between)
    straight = all(parent is None or parent.IsTransformToWorldLinear() for parent in parents)
    along = np.linspace(-0.5, 0.5, 2 if straight else 17)
    lattice = np.array([[*point, 1.0] for point in itertools.product(along, repeat=3)])
    lattice[:, :3] *= roi_node.GetSize()
    own = lattice @ slicer.util.arrayFromVTKMatrix(roi_node.GetObjectToNodeMatrix()).T
    moved = np.array([[*between.TransformPoint(point), 1.0] for point in own[:, :3]])
    matrix = vtk.vtkMatrix4x4()
    input_node.GetRASToIJKMatrix(matrix)
    ijk = (slicer.util.arrayFromVTKMatrix(matrix) @ moved.T)[:3]
    return ijk.round(6)  # rounding errors of transforms add no voxels


def with_region(settings, region, input_node):
    """Settings that colour only a region ((k0, k1), (j0, j1), (i0, i1)); as they are without one.

    Raises:
        MedColorLib.errors.InputError: the region meets none of the slices asked for.
    """
    if region is None:
        return settings
    from MedColorLib.errors import InputError

    start, stop = slices_of_region(region, input_node, settings.plane)
    if settings.slices and max(start, settings.slices[0]) >= min(stop, settings.slices[1]):
        raise InputError(_("The region of interest meets none of the chosen slices; move it or choose all slices."))
    return dataclasses.replace(settings, region=region)


def slices_of_region(region, node, plane: str = "transverse") -> tuple[int, int]:
    """Half-open range of the slices of a stack that a region ((k0, k1), (j0, j1), (i0, i1)) of the array meets."""
    order, count = stack_of(node, plane)
    start, stop = region[order.axes[0]]
    return (count - stop, count - start) if order.flips[0] else (start, stop)


def stack_of(node, plane: str = "transverse"):
    """(MedColorLib.scan.slices.SliceOrder, number of slices): the stack that slice numbers refer to."""
    from MedColorLib.scan.slices import slice_order

    order = slice_order(ijk_to_world(node), plane)
    return order, node.GetImageData().GetDimensions()[2 - order.axes[0]]


def slice_index_at(node, ras) -> int:
    """Number of the slice of a volume nearest to a world position (RAS, mm), clipped to the volume."""
    import numpy as np

    order, count = stack_of(node)
    ijk = np.linalg.inv(ijk_to_world(node)) @ np.array([*ras, 1.0])
    index = round(float(ijk[2 - order.axes[0]]))
    return int(np.clip(count - 1 - index if order.flips[0] else index, 0, count - 1))


def slab_at(node, number: int):
    """Where a slice lies in the array: (index expression for (k, j, i), offset (i, j, k) of its first voxel)."""
    order, count = stack_of(node)
    axis, index = order.axes[0], count - 1 - number if order.flips[0] else number
    slab = tuple(slice(index, index + 1) if n == axis else slice(None) for n in range(3))
    return slab, tuple(index if 2 - n == axis else 0 for n in range(3))


def publish(color_volume, input_node, output_node=None, settings: dict | None = None, name: str | None = None):
    """Put a result into the scene, all or nothing.

    Args:
        color_volume: MedColorLib.ColorVolume on the grid of the input.
        output_node: vtkMRMLVectorVolumeNode to fill again; None makes a new one, named after the input.
        settings: plain data, kept as a node attribute beside the report.

    Returns:
        The result node: same IJK-to-RAS matrix, parent transform and subject-hierarchy folder as the input. A volume of
        confidence, if there is one, is a scalar volume beside it, to which the result refers by CONFIDENCE_ROLE.
    """
    scene = input_node.GetScene()
    attributes = {
        SETTINGS_ATTRIBUTE: json.dumps(settings or {}, sort_keys=True),
        REPORT_ATTRIBUTE: json.dumps(color_volume.report, sort_keys=True),
    }
    node = output_node
    if node is None:
        name = scene.GenerateUniqueName(name or f"{input_node.GetName()} coloured")
        node = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", name)
    try:
        _fill(node, color_volume.rgb, input_node)
        for key, text in attributes.items():
            node.SetAttribute(key, text)
        node.SetNodeReferenceID(INPUT_ROLE, input_node.GetID())
        if output_node is None:
            _place_beside(node, input_node)
        _publish_confidence(color_volume.confidence, node, input_node)
    except BaseException:
        if output_node is None:
            remove(node)
        raise
    return node


def _publish_confidence(confidence, node, input_node) -> None:
    """Fill or make the volume of confidence of a result; one of earlier colours is removed where there is none now."""
    known = node.GetNodeReference(CONFIDENCE_ROLE)
    if confidence is None:
        if known is not None:
            node.RemoveNodeReferenceIDs(CONFIDENCE_ROLE)
            remove(known)
        return
    scene = node.GetScene()
    volume = known or scene.AddNewNodeByClass(
        "vtkMRMLScalarVolumeNode", scene.GenerateUniqueName(f"{node.GetName()} confidence")
    )
    try:
        _fill(volume, confidence, input_node)
        if known is None:
            display = volume.GetVolumeDisplayNode()
            display.SetAutoWindowLevel(0)
            display.SetWindowLevel(100.0, 50.0)  # per cent
            volume.SetAttribute(_CONFIDENCE_ATTRIBUTE, "1")
            _place_beside(volume, input_node)
        node.SetNodeReferenceID(CONFIDENCE_ROLE, volume.GetID())
    except BaseException:
        if known is None:
            remove(volume)
        raise


def remove(node) -> None:
    """Remove a volume node together with its display nodes, which the scene would keep."""
    scene = node.GetScene()
    for index in reversed(range(node.GetNumberOfDisplayNodes())):
        display = node.GetNthDisplayNode(index)
        if display is not None:
            scene.RemoveNode(display)
    scene.RemoveNode(node)


def _fill(node, voxels, input_node) -> None:
    matrix = vtk.vtkMatrix4x4()
    input_node.GetIJKToRASMatrix(matrix)
    with slicer.util.NodeModify(node):
        slicer.util.updateVolumeFromArray(node, voxels)
        node.SetIJKToRASMatrix(matrix)
        if node.IsA("vtkMRMLVectorVolumeNode"):
            node.SetVoxelVectorType(node.VoxelVectorTypeColorRGB)
        node.SetAndObserveTransformNodeID(input_node.GetTransformNodeID())
    if node.GetVolumeDisplayNode() is None:
        node.CreateDefaultDisplayNodes()


def _place_beside(node, input_node) -> None:
    hierarchy = slicer.vtkMRMLSubjectHierarchyNode.GetSubjectHierarchyNode(input_node.GetScene())
    if hierarchy is None:
        return
    item = hierarchy.GetItemByDataNode(input_node)
    if not item:
        return
    parent = hierarchy.GetItemParent(item)
    own = hierarchy.GetItemByDataNode(node)
    if own:
        hierarchy.SetItemParent(own, parent)
    else:  # Slicer makes items for new nodes by itself; without its plugins nobody does
        hierarchy.CreateItem(parent, node)


def fill_part(node, voxels, input_node, offset_ijk) -> None:
    """Fill a colour volume node with a part of the input in colour (k, j, i, 3), not to be saved with the scene."""
    _fill(node, voxels, input_node)
    place_part(node, input_node, offset_ijk)
    for own in (node, node.GetVolumeDisplayNode()):
        own.SetSaveWithScene(False)


def place_part(node, input_node, offset_ijk) -> None:
    """Place a node that holds a part of the input's voxels, the first of them at `offset_ijk`."""
    matrix = vtk.vtkMatrix4x4()
    input_node.GetIJKToRASMatrix(matrix)
    node.SetOrigin(matrix.MultiplyPoint([*map(float, offset_ijk), 1.0])[:3])
