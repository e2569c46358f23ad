"""A colour volume as reference: its transverse slices, every n-th, become references in the order of the body."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..io.quiet import itk_name
from ..io.voxel_data import title
from ..scan.slices import slice_order
from .photograph import Frame, Reference

COLOR_SUFFIXES = (".nrrd", ".nhdr", ".nii", ".nii.gz", ".mha", ".mhd")
MOST_SECTIONS = 64  # each of them costs features and a contrast curve
MAX_BYTES = 8 << 30
_LEAST_TISSUE = 0.01  # of the largest section's: less than that is not worth a reference
_LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def read_sections(path: str | Path) -> list[Reference]:
    """References of a colour volume in a file: NRRD, NIfTI or MetaImage, RGB or RGBA of 8 bits.

    Raises:
        InputError: missing, unreadable, not such a volume, too large, black, or under a path that is not UTF-8.
    """
    path = Path(path)
    values, ijk_to_ras = _read_vector_volume(path)
    inside = values[..., 3] > 0 if values.shape[-1] == 4 else None
    return sections(values[..., :3], ijk_to_ras, title(path), inside)


def sections(rgb: np.ndarray, ijk_to_ras: np.ndarray, name: str, inside: np.ndarray | None = None) -> list[Reference]:
    """At most 64 transverse sections of a colour volume, evenly spread, from the feet up.

    Args:
        rgb: (k, j, i, 3) uint8; black is not tissue, unless tissue surrounds it in its slice (air in the body).
        inside: (k, j, i) bool, False where a voxel is not tissue whatever its colour (alpha 0); None: everywhere.

    Raises:
        InputError: no slice with tissue.
    """
    from scipy import ndimage

    view = slice_order(ijk_to_ras).view(rgb)
    allowed = None if inside is None else slice_order(ijk_to_ras).view(inside)
    masks = [plane.any(axis=2) if allowed is None else plane.any(axis=2) & allowed[k] for k, plane in enumerate(view)]
    areas = np.array([np.count_nonzero(mask) for mask in masks])
    filled = np.flatnonzero(areas > _LEAST_TISSUE * areas.max())
    if not filled.size:
        raise InputError(f"reference {name}: the colour volume is black everywhere; use one that shows tissue")
    step = -(-len(filled) // MOST_SECTIONS)
    chosen = filled[(len(filled) - 1) % step // 2 :: step]
    group = f"colour volume {name}, every {_ordinal(step)}of {len(filled)} slices"
    found = []
    for k in chosen:
        mask = ndimage.binary_fill_holes(masks[k])
        frame, removed = Frame.around(mask), 1 - float(mask.mean())
        found.append(Reference(frame.cut(view[k]), frame.cut(mask), f"{name} slice {k}", removed, group, frame=frame))
    return found


def _ordinal(step: int) -> str:
    return "" if step == 1 else {2: "second ", 3: "third "}.get(step, f"{step}th ")


def _read_vector_volume(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(k, j, i, 3 or 4) uint8 and IJK-to-RAS of a file."""
    import SimpleITK as sitk

    if not path.is_file():
        raise InputError(f"reference: no file {path}")
    with itk_name(path) as name:
        image = _read_by_itk(name, path)
    direction = np.array(image.GetDirection()).reshape(3, 3) * np.array(image.GetSpacing())
    lps = np.eye(4)
    lps[:3, :3], lps[:3, 3] = direction, image.GetOrigin()
    return sitk.GetArrayFromImage(image), _LPS_TO_RAS @ lps


def _read_by_itk(name: str, path: Path):
    """The image, checked before its voxels are read; `path` is for messages."""
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(name)
    try:
        reader.ReadImageInformation()
        count, size = reader.GetNumberOfComponents(), reader.GetSize()
        kind = sitk.GetPixelIDValueAsString(reader.GetPixelID())
        if len(size) != 3 or count not in (3, 4) or "8-bit unsigned" not in kind:
            raise InputError(
                f"reference {path.name}: not a colour volume; expected three-dimensional RGB or RGBA of 8 bits, got "
                f"{kind} of {' x '.join(map(str, size))} with {count} component{'s' * (count > 1)}"
            )
        if np.prod([float(n) for n in size]) * count > MAX_BYTES:
            raise InputError(f"reference {path.name}: more than {MAX_BYTES >> 30} GiB; crop or resample the volume")
        return reader.Execute()
    except RuntimeError as error:
        reason = " ".join(str(error).split())[-160:]
        raise InputError(f"reference {path.name}: cannot be read as a volume (... {reason})") from error
