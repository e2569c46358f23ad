"""A colour volume as reference: its transverse slices, every n-th, become references in the order of the body."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..io.colors import read_colors
from ..io.voxel_data import title
from ..scan.slices import slice_order
from ..volume import ColorVolume
from .photograph import Frame, Reference

MOST_SECTIONS = 64  # each of them costs features and a contrast curve
MAX_BYTES = 8 << 30
_LEAST_TISSUE = 0.01  # of the largest section's: less than that is not worth a reference


def read_sections(path: str | Path) -> list[Reference]:
    """References of a colour volume in a file: NRRD, NIfTI or MetaImage, RGB or RGBA of 8 bits.

    Raises:
        InputError: missing, unreadable, not such a volume, too large or black.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"reference: no file {path}")
    try:
        with np.errstate(all="ignore"):  # numbers of damaged headers overflow; `ColorVolume` refuses what comes of it
            values, ijk_to_ras = read_colors(path, MAX_BYTES)
            ColorVolume(values[..., :3], ijk_to_ras)
    except InputError as error:
        raise InputError(f"reference {path.name}: {' '.join(str(error).split())}") from error
    except OSError as error:
        raise InputError(f"reference {path.name}: cannot be read ({error.strerror or error})") from error
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
