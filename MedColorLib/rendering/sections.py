"""Transverse, coronal and sagittal sections in radiological display, at the right physical aspect ratio."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError, SettingsError
from ..volume import ColorVolume, Volume
from .grid import grey_color_volume, not_black, shifted, tissue_box
from .views import body_outline

# Name: (to the right, down) in the picture, RAS. Radiological as in Slicer: the patient's left on the right, front on
# top; in the sagittal section the face looks to the left.
PLANES = {
    "transverse": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    "coronal": ((-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "sagittal": ((0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
}
MAX_SECTION_SIDE = 2048


@dataclass(frozen=True)
class SectionFrame:
    """What the three sections show; the same for a grey volume and its coloured version.

    Attributes:
        centre: (3,) point in millimetres RAS that all three planes contain.
        low, high: (3,) box in millimetres RAS that is shown.
        pixel_mm: side of the square pixels.
    """

    centre: np.ndarray
    low: np.ndarray
    high: np.ndarray
    pixel_mm: float


def section_frame(color: ColorVolume, centre: tuple[float, float, float] | None = None) -> SectionFrame | None:
    """Frame around all voxels that are not black, planes through their centroid; None when all are black.

    Args:
        color: RGB volume.
        centre: another point for the planes, in fractions 0..1 of the body's extent along R, A, S.

    Raises:
        SettingsError: a fraction outside 0..1.
    """
    outline = body_outline(color)
    if outline is None:
        return None
    low, high = outline.extent(np.eye(3))
    if centre is None:
        point = _centroid_ras(color)
    else:
        if len(centre) != 3 or not all(0.0 <= f <= 1.0 for f in centre):
            raise SettingsError(f"sections: expected a centre of three fractions from 0 to 1, got {centre}")
        point = low + np.asarray(centre, dtype=np.float64) * (high - low)
    pixel_mm = max(float(color.spacing_mm.min()), float((high - low).max()) / MAX_SECTION_SIDE)
    return SectionFrame(point, low, high, pixel_mm)


def _centroid_ras(color: ColorVolume) -> np.ndarray:
    total = np.zeros(4)
    for k, plane in enumerate(color.rgb):
        mask = not_black(plane)
        columns, rows = mask.sum(axis=0), mask.sum(axis=1)
        total += (columns @ np.arange(columns.size), rows @ np.arange(rows.size), k * rows.sum(), rows.sum())
    return color.ijk_to_ras[:3, :3] @ (total[:3] / total[3]) + color.ijk_to_ras[:3, 3]


def sections(
    volume: Volume | ColorVolume, window: tuple[float, float] | None = None, frame: SectionFrame | None = None
) -> dict[str, np.ndarray]:
    """The three sections of a grey or coloured volume.

    Args:
        volume: colours are shown as they are, scalars through `window` (see `grey_color_volume`).
        window: (low, high) for scalars.
        frame: where to cut; without it through the centroid of all that is not black.

    Returns:
        {"transverse", "coronal", "sagittal"}: (H, W, 3) uint8, square pixels of one size in all three. Outside the
        volume black. A volume that is all black gives pictures of one black pixel.
    """
    color = grey_color_volume(volume, window) if isinstance(volume, Volume) else volume
    if not isinstance(color, ColorVolume):
        raise InputError(f"sections: expected a Volume or a ColorVolume, got {type(volume).__name__}")
    frame = frame or section_frame(color)
    box = tissue_box(color.rgb)
    if frame is None or box is None:
        return {name: np.zeros((1, 1, 3), dtype=np.uint8) for name in PLANES}
    matrix = shifted(color.ijk_to_ras, tuple(s.start for s in box[::-1]))
    return {name: _section(color.rgb[box], matrix, frame, *PLANES[name]) for name in PLANES}


def _section(
    rgb: np.ndarray, ijk_to_ras: np.ndarray, frame: SectionFrame, right: tuple[float, ...], down: tuple[float, ...]
) -> np.ndarray:
    """Linear interpolation of `rgb` on the plane spanned by `right` and `down` through the frame's centre."""
    from scipy.ndimage import map_coordinates

    axes = np.array([right, down])
    ends = np.stack([axes @ frame.low, axes @ frame.high])
    first, extent = ends.min(axis=0), np.abs(ends[1] - ends[0])
    width, height = np.maximum(np.rint(extent / frame.pixel_mm).astype(int), 1)
    x = first[0] + (np.arange(width) + 0.5) * extent[0] / width
    y = first[1] + (np.arange(height) + 0.5) * extent[1] / height
    normal = np.cross(*axes)
    points = (x[None, :, None] * axes[0] + y[:, None, None] * axes[1]) + (normal @ frame.centre) * normal
    inverse = np.linalg.inv(ijk_to_ras)
    kji = np.moveaxis(points @ inverse[:3, :3].T + inverse[:3, 3], -1, 0)[::-1]
    planes = [map_coordinates(rgb[..., c], kji, output=np.float32, order=1, mode="grid-constant") for c in range(3)]
    return np.rint(np.stack(planes, axis=-1)).astype(np.uint8)
