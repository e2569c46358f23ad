"""Label volumes: segmentations on the grid of a scan, read and checked by the same rules whatever they are for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..volume import Volume

HIGHEST_LABEL = 65535
_SAME_PLACE = 0.01  # voxels by which the corners of two grids may differ: file formats round geometry to float32
_REMEDY = "resample the labels onto the volume's grid (nearest neighbour)"


def read_labels(path: Path) -> Volume:
    """A label volume in any format that an input may have; a segmentation with layers is refused by name.

    Raises:
        InputError: with the remedy in the message.
    """
    from .files import read_volume

    if path.suffix.lower() in (".nrrd", ".nhdr") and path.is_file() and _has_layers(path):
        raise InputError(
            f"{path.name}: a segmentation of several layers, its segments overlap; export it as one label map (in Slicer: "
            "Segmentations, Export to new labelmap) on the volume's grid"
        )
    return read_volume(path)


def require_scan_grid(labels: Volume, volume: Volume, what: str) -> None:
    """Refuse labels that do not lie on the scan's voxels.

    Args:
        what: whose labels they are, for the message.

    Raises:
        InputError: other numbers of voxels, or another place.
    """
    if labels.array.shape != volume.array.shape:
        sizes = [" x ".join(map(str, v.array.shape)) for v in (labels, volume)]
        raise InputError(
            f"{what}: {labels.name} has {sizes[0]} voxels (k, j, i), {volume.name} has {sizes[1]}; {_REMEDY}"
        )
    corners = np.array([[i, j, k, 1.0] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    corners[:, :3] *= np.array(volume.array.shape[::-1]) - 1
    apart = np.linalg.norm(((labels.ijk_to_ras - volume.ijk_to_ras) @ corners.T)[:3], axis=0).max()
    if apart > _SAME_PLACE * volume.spacing_mm.min():
        raise InputError(
            f"{what}: the voxels of {labels.name} lie up to {apart:.3g} mm from those of {volume.name}; {_REMEDY}"
        )


def present_labels(labels: Volume, what: str) -> list[int]:
    """The labels that a volume holds, ascending.

    Raises:
        InputError: values that are not whole numbers from 0 to 65535.
    """
    seen = np.zeros(HIGHEST_LABEL + 1, bool)
    for plane in labels.array:
        whole = plane.dtype.kind in "iub" or bool(np.isfinite(plane).all() and (plane == np.rint(plane)).all())
        if not whole or plane.min() < 0 or plane.max() > HIGHEST_LABEL:
            raise InputError(
                f"{what}: {labels.name} holds values that are no labels; expected whole numbers from 0 to "
                f"{HIGHEST_LABEL}, as in a segmentation's label map"
            )
        seen[plane.astype(np.intp)] = True
    return np.flatnonzero(seen).tolist()


def _has_layers(path: Path) -> bool:
    from .nrrd import nrrd_header

    try:
        return nrrd_header(path).get("dimension") == 4
    except (InputError, OSError):  # reading says what is wrong
        return False
