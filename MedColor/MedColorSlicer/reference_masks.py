"""What is tissue in a reference, as a node of the scene says it: a label map, a segmentation or a picture."""

from __future__ import annotations

import slicer
from slicer.i18n import tr as _

from . import labels


def mask_problem(mask, reference) -> str:
    """Why a node cannot say what is tissue in a reference node; empty if it can, or for None."""
    if mask is None:
        return ""
    if mask is reference:
        return _("The mask of the reference is the reference itself; select a label map or none.")
    if mask.IsA("vtkMRMLSegmentationNode"):
        return labels.labels_problem(mask)
    image = mask.GetImageData() if mask.IsA("vtkMRMLVolumeNode") else None
    if image is None or image.GetPointData().GetScalars() is None or not all(image.GetDimensions()):
        return _("The mask {name} has no voxels; select another one or none.").format(name=mask.GetName())
    known = reference.GetImageData() if reference is not None else None
    if known is not None and known.GetDimensions()[:2] != image.GetDimensions()[:2]:
        return _(
            "The mask {name} has {columns} x {rows} pixels, the reference {own_columns} x {own_rows}; draw it on the reference."
        ).format(
            name=mask.GetName(),
            columns=image.GetDimensions()[0],
            rows=image.GetDimensions()[1],
            own_columns=known.GetDimensions()[0],
            own_rows=known.GetDimensions()[1],
        )
    return ""


def with_mask(picture, mask, reference):
    """(H, W, 4) uint8: a picture, and 255 where a node says that there is tissue.

    Labels count where they are not 0, pictures where they are brighter than half of their brightest.

    Raises:
        MedColorLib.errors.InputError: the node cannot be used, or marks nothing.
    """
    import numpy as np

    from MedColorLib.errors import InputError

    problem = mask_problem(mask, reference)
    if problem:
        raise InputError(problem)
    drawn = mask.IsA("vtkMRMLSegmentationNode")
    voxels = labels.volume_of(mask, reference).array if drawn else slicer.util.arrayFromVolume(mask)
    plane = voxels[voxels.shape[0] // 2]
    if drawn or mask.IsA("vtkMRMLLabelMapVolumeNode"):
        tissue = plane != 0
    else:
        grey = plane if plane.ndim == 2 else plane[..., :3].max(axis=2)
        tissue = grey > grey.max() / 2
    if tissue.shape != picture.shape[:2] or not tissue.any():
        raise InputError(
            _("The mask {name} marks no tissue on the reference; draw it there or select none.").format(
                name=mask.GetName()
            )
        )
    return np.dstack([picture, np.where(tissue, 255, 0).astype(np.uint8)])
