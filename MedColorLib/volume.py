"""Stage *volume*: what every other stage takes and gives. No file formats here (`io/`), no scene (`MedColor/`)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .errors import InputError


def _checked_geometry(ijk_to_ras: np.ndarray) -> np.ndarray:
    matrix = np.array(ijk_to_ras, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise InputError(f"geometry: expected a 4 x 4 IJK-to-RAS matrix, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InputError("geometry: numbers that are not finite; repair origin, spacing and directions in the header")
    if abs(np.linalg.det(matrix[:3, :3] / np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-300))) < 1e-6:
        raise InputError(
            "geometry: an axis has no length, or directions are not independent; repair spacing and directions in the header"
        )
    matrix.setflags(write=False)
    return matrix


@dataclass(frozen=True)
class Volume:
    """A scalar volume and its place in space.

    Attributes:
        array: (k, j, i) scalars of any integer or float type; i is the fastest axis of the file (Slicer's numpy order).
        ijk_to_ras: (4, 4) float64; maps (i, j, k, 1) to millimetres, right-anterior-superior. Directions may be
            rotated, left-handed or sheared; columns hold direction times spacing.
        window: (low, high) in the array's units as the file proposes it (DICOM window), or None.
        name: a label without folder or patient data, for reports.
        notes: what the reader had to decide (series picked, gaps, slices left out), one sentence each.

    Raises:
        InputError: not three-dimensional, empty, not numeric, or geometry that is singular.
    """

    array: np.ndarray
    ijk_to_ras: np.ndarray = field(default_factory=lambda: np.eye(4))
    window: tuple[float, float] | None = None
    name: str = "volume"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        array = np.asarray(self.array)
        if array.ndim != 3:
            hint = "; a colour image cannot be an input, only a reference" if array.ndim == 4 else ""
            raise InputError(f"{self.name}: expected a scalar volume (k, j, i), got shape {array.shape}{hint}")
        if array.size == 0:
            raise InputError(f"{self.name}: the volume has no voxels (shape {array.shape})")
        if array.dtype.kind not in "iufb":
            raise InputError(f"{self.name}: expected integer or float voxels, got {array.dtype}")
        object.__setattr__(self, "array", array)
        object.__setattr__(self, "ijk_to_ras", _checked_geometry(self.ijk_to_ras))

    @property
    def spacing_mm(self) -> np.ndarray:
        """(3,) distances between voxel centres along i, j, k in millimetres."""
        return np.linalg.norm(self.ijk_to_ras[:3, :3], axis=0)

    def __repr__(self) -> str:
        """Size, type and place, no voxels: <Volume 'head' 48 x 128 x 112 (k, j, i) int16, 2 x 2 x 3 mm (i, j, k)>."""
        return f"<Volume {self.name!r} {_in_words(self.array, self.spacing_mm)}>"


@dataclass(frozen=True)
class ColorVolume:
    """The result: an RGB volume on exactly the grid of its input.

    Attributes:
        rgb: (k, j, i, 3) uint8, sRGB. Outside the body (0, 0, 0), but for the three voxels of its rim (`coloring.rim`).
        ijk_to_ras: (4, 4) float64, identical to the input's.
        report: plain data (JSON-ready): inputs by hash, settings, plan, seconds, versions, counts.
        name: label for files and nodes.
        confidence: (k, j, i) uint8, how far the colour of each voxel can be trusted in per cent, 0 outside the body; None
            where it was not asked for.
    """

    rgb: np.ndarray
    ijk_to_ras: np.ndarray
    report: dict = field(default_factory=dict)
    name: str = "volume coloured"
    confidence: np.ndarray | None = None

    def __post_init__(self) -> None:
        rgb = np.asarray(self.rgb)
        if rgb.ndim != 4 or rgb.shape[-1] != 3 or rgb.dtype != np.uint8:
            raise InputError(f"{self.name}: expected uint8 (k, j, i, 3), got {rgb.dtype} {rgb.shape}")
        object.__setattr__(self, "rgb", rgb)
        object.__setattr__(self, "ijk_to_ras", _checked_geometry(self.ijk_to_ras))

    @property
    def spacing_mm(self) -> np.ndarray:
        """(3,) distances between voxel centres along i, j, k in millimetres."""
        return np.linalg.norm(self.ijk_to_ras[:3, :3], axis=0)

    def __repr__(self) -> str:
        """Size and place, neither voxels nor report."""
        confidence = "" if self.confidence is None else ", with confidence"
        return f"<ColorVolume {self.name!r} {_in_words(self.rgb[..., 0], self.spacing_mm)} RGB{confidence}>"


def _in_words(array: np.ndarray, spacing_mm: np.ndarray) -> str:
    size, spacing = " x ".join(map(str, array.shape)), " x ".join(f"{step:.4g}" for step in spacing_mm)
    return f"{size} (k, j, i) {array.dtype.name}, {spacing} mm (i, j, k)"
