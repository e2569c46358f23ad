"""Tissue labels of the scene, label maps and segmentations, become the guard that the library takes."""

from __future__ import annotations

import logging

import slicer
import vtk
from slicer.i18n import tr as _

from . import scene, tissues

BY_TISSUE = "tissue"


def labels_problem(node) -> str:
    """Why a node cannot serve as tissue labels, as a sentence that says what to do; empty if it can, or for None."""
    if node is None:
        return ""
    name = node.GetName()
    if node.IsA("vtkMRMLSegmentationNode"):
        empty = not node.GetSegmentation() or node.GetSegmentation().GetNumberOfSegments() == 0
        return _("{name} has no segments; select other tissue labels or none.").format(name=name) if empty else ""
    if not node.IsA("vtkMRMLLabelMapVolumeNode"):
        return _("{name} holds no tissue labels; select a label map or a segmentation.").format(name=name)
    image = node.GetImageData()
    if image is None or image.GetPointData().GetScalars() is None or not all(image.GetDimensions()):
        return _("{name} has no voxels; select other tissue labels or none.").format(name=name)
    return ""


def state_of(node) -> tuple:
    """What changes whenever the labels of a node do; for a plan that need not be asked for again."""
    if node is None:
        return ()
    drawn = node.IsA("vtkMRMLSegmentationNode")
    inner = node.GetSegmentation() if drawn else node.GetImageData()
    return (node.GetID(), inner.GetMTime() if inner else 0, *(_segment_times(inner) if drawn and inner else ()))


def _segment_times(segmentation) -> list[int]:
    """Of every segment and its voxels: the segmentation itself is not modified when they are painted."""
    segments = [segmentation.GetNthSegment(n) for n in range(segmentation.GetNumberOfSegments())]
    voxels = [segment.GetRepresentation(segmentation.GetSourceRepresentationName()) for segment in segments]
    return [one.GetMTime() for one in (*segments, *voxels) if one is not None]


def guard_from(node, input_node, reference_labels=None, groups=None):
    """MedColorLib.Guard of a label map or segmentation node: a copy; None without a node.

    Args:
        reference_labels: for each reference a PNG, an (H, W) integer array, a label map node (its middle slice) or None.
        groups: label -> group. Labels of a segmentation are 1, 2, ... in the order of its segments. BY_TISSUE: by their
            terminology or name (`tissues`); without groups, too, where there are more than 15 segments.

    Raises:
        MedColorLib.errors.MedColorError: the node cannot be used, or pictures and groups are given without it.
    """
    from MedColorLib.errors import InputError, SettingsError

    if node is None:
        if reference_labels is not None or groups:
            raise SettingsError(_("Labels of references and groups belong to tissue labels; give labels, too."))
        return None
    problem = labels_problem(node)
    if problem:
        raise InputError(problem)
    import MedColorLib

    if isinstance(groups, str):
        if groups != BY_TISSUE or not node.IsA("vtkMRMLSegmentationNode"):
            raise SettingsError(
                _('Groups are {{label: group}}, or "{word}" for a segmentation, whose segments have names.').format(
                    word=BY_TISSUE
                )
            )
        groups = _numbered(tissues.groups_of(node))
    elif groups is None and grouped_by_name(node):
        groups = _numbered(tissues.groups_of(node))
    volume = volume_of(node, input_node)
    pictures = None
    if reference_labels is not None:
        given = reference_labels if isinstance(reference_labels, (list, tuple)) else [reference_labels]
        pictures = [_middle(labels) if hasattr(labels, "IsA") else labels for labels in given]
    return MedColorLib.Guard(volume, pictures, groups)


def volume_of(node, input_node):
    """MedColorLib.Volume of a label map, or of a segmentation on the grid of another volume: a copy."""
    return _exported(node, input_node) if node.IsA("vtkMRMLSegmentationNode") else _volume(node, node.GetName())


def body_from(body, input_node):
    """What `Settings.body` takes of "auto", "all", a path, an array, or a label map or segmentation node.

    Raises:
        MedColorLib.errors.InputError: the node cannot be used.
    """
    from MedColorLib.errors import InputError

    if not hasattr(body, "IsA"):
        return body
    problem = labels_problem(body)
    if problem:
        raise InputError(problem)
    return volume_of(body, input_node)


def grouped_by_name(node) -> bool:
    """Whether segments are put together by what they are called: where the library would not keep so many apart."""
    from MedColorLib.matching.tissue_guard import MOST_GROUPS

    if node is None or not node.IsA("vtkMRMLSegmentationNode") or node.GetSegmentation() is None:
        return False
    return node.GetSegmentation().GetNumberOfSegments() > MOST_GROUPS - 1  # and the background


def _numbered(groups: dict[int, str]) -> dict[int, int]:
    names = sorted(set(groups.values()))
    logging.getLogger("MedColorLib").info("tissue labels: %d segments in the groups %s", len(groups), ", ".join(names))
    return {label: names.index(name) + 1 for label, name in groups.items()}


def _volume(node, name: str):
    from MedColorLib.volume import Volume

    return Volume(slicer.util.arrayFromVolume(node).copy(), scene.ijk_to_world(node), name=name)


def _middle(node):
    problem = labels_problem(node)
    if problem or not node.IsA("vtkMRMLLabelMapVolumeNode"):
        from MedColorLib.errors import InputError

        raise InputError(problem or _("The labels of a reference must be a label map."))
    voxels = slicer.util.arrayFromVolume(node)
    return voxels[voxels.shape[0] // 2].copy()


def _exported(segmentation, input_node):
    """All segments, shown or hidden, as labels 1, 2, ... on the input's grid; the scene is left as it was."""
    from MedColorLib.errors import InputError

    module = getattr(slicer.modules, "segmentations", None)
    if module is None:
        raise InputError(
            _("Slicer's module Segmentations is not loaded; export {name} as a label map and select that.").format(
                name=segmentation.GetName()
            )
        )
    nodes = segmentation.GetScene()
    before = _ids(nodes)
    segments = vtk.vtkStringArray()
    segmentation.GetSegmentation().GetSegmentIDs(segments)
    try:
        map_node = nodes.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", f"{segmentation.GetName()} labels")
        if not module.logic().ExportSegmentsToLabelmapNode(segmentation, segments, map_node, input_node):
            raise InputError(
                _("{name} cannot be exported as a label map; the error log has the reason.").format(
                    name=segmentation.GetName()
                )
            )
        return _volume(map_node, segmentation.GetName())
    finally:
        for node_id in _ids(nodes) - before:  # the label map, its display, its table of colours
            node = nodes.GetNodeByID(node_id)
            if node is not None:
                nodes.RemoveNode(node)


def _ids(nodes) -> set[str]:
    return {nodes.GetNthNode(n).GetID() for n in range(nodes.GetNumberOfNodes())}
