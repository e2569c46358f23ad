"""A coloured volume as the ray caster needs it: cropped to tissue, of bounded size, cut open on demand."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError, SettingsError
from ..scan.intensity import apply_window, choose_window
from ..volume import ColorVolume, Volume
from .free_air import mark_free_air
from .surface import MARGIN, surface_rgba

_LOG = logging.getLogger("MedColorLib")

# 4 bytes each: 100 MB on the graphics card, and about 10 s for a picture on two cores without one.
VOXEL_BUDGET = 24_000_000
# Every OpenGL 3.2 driver met so far takes 3-D textures of 2048 voxels a side; the margin is added to this.
MAX_SIDE = 2000


@dataclass(frozen=True)
class Cut:
    """A convex region that is taken away to show what lies behind it.

    Attributes:
        planes: pairs (normal, point) in millimetres RAS. A position x is taken away where normal . (x - point) > 0
            for every plane, so that one plane takes a half, two a quarter, three an eighth.

    Raises:
        SettingsError: no plane, or a normal of no length.
    """

    planes: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]

    def __post_init__(self) -> None:
        try:
            planes = np.array(self.planes, dtype=np.float64)
        except (TypeError, ValueError):
            planes = np.empty(0)
        if planes.ndim != 3 or planes.shape[1:] != (2, 3) or not np.isfinite(planes).all():
            raise SettingsError("cut: expected pairs of a normal and a point, three finite numbers each")
        if (np.linalg.norm(planes[:, 0], axis=1) == 0).any():
            raise SettingsError("cut: a plane has a normal of no length")


@dataclass(frozen=True)
class Grid:
    """Voxels ready for the ray caster.

    Attributes:
        rgba: (k, j, i, 4) uint8, see `surface_rgba` and `mark_free_air`.
        ijk_to_ras: (4, 4) float64 of this array, not of the volume it was cropped from.
        diagonal_mm: diagonal of the box of voxels that are not black.
    """

    rgba: np.ndarray
    ijk_to_ras: np.ndarray
    diagonal_mm: float


def grey_color_volume(
    volume: Volume, window: tuple[float, float] | None = None, body: np.ndarray | None = None
) -> ColorVolume:
    """The grey volume as R = G = B, to be shown beside its coloured version by the same functions.

    Args:
        volume: scalars (k, j, i).
        window: (low, high) shown black and white; without it the file's own window, else robust percentiles.
        body: mask (k, j, i) that the percentiles are taken in; None for the whole volume.

    Returns:
        uint8 RGB on the same grid. NaN is black.

    Raises:
        SettingsError: an empty or reversed window.
        InputError: no window given and none can be found (no finite value, or a single one).
    """
    chosen = choose_window(volume.array, body, given=window, proposed=volume.window)
    rgb = np.empty((*volume.array.shape, 3), dtype=np.uint8)
    shown = by_table(lambda values: np.rint(apply_window(values, chosen) * 255.0).astype(np.uint8), volume.array.dtype)
    for plane, values in zip(rgb, volume.array):
        plane[:] = shown(values)[..., None]
    return ColorVolume(rgb, volume.ijk_to_ras, name=f"{volume.name} grey")


def by_table(function: Callable[[np.ndarray], np.ndarray], dtype: np.dtype) -> Callable[[np.ndarray], np.ndarray]:
    """A function of single scalars of a type, looked up where the type has few of them: the same values, sooner."""
    if dtype.kind not in "iu" or dtype.itemsize > 2:
        return function
    native = dtype.newbyteorder("=")
    every = (
        np.arange(256**dtype.itemsize).astype(f"u{dtype.itemsize}").view(native)
    )  # negative ones at the end, as indices
    return function(every).take


def not_black(rgb: np.ndarray) -> np.ndarray:
    """Mask (...) of the voxels of uint8 (..., 3) that are not black; much faster than `any` over the last axis."""
    return (rgb[..., 0] | rgb[..., 1] | rgb[..., 2]) > 0


def tissue_box(rgb: np.ndarray) -> tuple[slice, slice, slice] | None:
    """Smallest box (slices along k, j, i) that holds every voxel that is not black; None when all are."""
    profiles = [np.zeros(n, dtype=bool) for n in rgb.shape[:3]]
    for k, plane in enumerate(rgb):
        mask = not_black(plane)
        profiles[0][k] = mask.any()
        profiles[1] |= mask.any(axis=1)
        profiles[2] |= mask.any(axis=0)
    if not profiles[0].any():
        return None
    ends = [np.flatnonzero(profile)[[0, -1]] for profile in profiles]
    return tuple(slice(int(first), int(last) + 1) for first, last in ends)


def shifted(
    ijk_to_ras: np.ndarray, ijk: tuple[float, float, float], factors: tuple[int, int, int] = (1, 1, 1)
) -> np.ndarray:
    """IJK-to-RAS matrix of an array whose voxel 0 lies at `ijk` of the old one, with `factors` times the spacing."""
    matrix = np.array(ijk_to_ras, dtype=np.float64)
    matrix[:3, 3] += matrix[:3, :3] @ np.asarray(ijk, dtype=np.float64)
    matrix[:3, :3] *= factors
    return matrix


def _reduction_factors(shape: tuple[int, ...], spacing_mm: np.ndarray, budget: int) -> tuple[int, int, int]:
    """Whole factors along (k, j, i): the finest axis is thinned first, so that voxels become cubes."""
    factors = np.ones(3, dtype=np.int64)
    size = np.array(shape, dtype=np.int64)
    while np.prod(-(-size // factors)) > budget or (-(-size // factors) > MAX_SIDE).any():
        reduced = -(-size // factors)
        cost = np.where(reduced > MAX_SIDE, -1.0, np.where(reduced > 1, spacing_mm * factors, np.inf))
        factors[int(np.argmin(cost))] += 1
    return tuple(int(f) for f in factors)


def _reduce(rgb: np.ndarray, factors: tuple[int, int, int]) -> np.ndarray:
    """Means of blocks (k, j, i), rounded; air at the far ends completes the last blocks."""
    fk, fj, fi = factors
    nk, nj, ni = (-(-n // f) for n, f in zip(rgb.shape, factors))
    out = np.empty((nk, nj, ni, 3), dtype=np.uint8)
    for k in range(nk):
        slab = rgb[k * fk : (k + 1) * fk].sum(axis=0, dtype=np.float32)
        padded = np.zeros((nj * fj, ni * fi, 3), dtype=np.float32)
        padded[: slab.shape[0], : slab.shape[1]] = slab
        out[k] = np.rint(padded.reshape(nj, fj, ni, fi, 3).sum(axis=(1, 3)) / (fk * fj * fi)).astype(np.uint8)
    return out


def _cut_share(k: int, shape: tuple[int, int], ijk_to_ras: np.ndarray, cut: Cut) -> np.ndarray:
    """(j, i) share 0..1 of each voxel of slice k that the cut takes away, from its distance to the cut's face."""
    depth = np.full(shape, np.inf, dtype=np.float32)
    j, i = np.ogrid[: shape[0], : shape[1]]
    for normal, point in np.array(cut.planes, dtype=np.float64):
        unit = normal / np.linalg.norm(normal)
        step = unit @ ijk_to_ras[:3, :3]
        offset = unit @ (ijk_to_ras[:3, 3] - point)
        # In voxels across the plane, so that the face is equally wide at any angle and spacing: two voxels, because on
        # a narrower one shading shows each voxel as a stair.
        distance = (step[0] * i + step[1] * j + step[2] * k + offset) / np.abs(step).max()
        depth = np.minimum(depth, distance.astype(np.float32))
    return np.clip(depth / 2 + 0.5, 0.0, 1.0)


def prepare_grid(color: ColorVolume, voxel_budget: int = VOXEL_BUDGET) -> Grid | None:
    """Crop to tissue, thin out above the budget, add alpha, dress the surface for interpolation.

    Args:
        color: RGB volume; black is air.
        voxel_budget: largest number of voxels handed over; beyond it blocks of voxels are averaged, which is logged.

    Returns:
        The grid, or None when every voxel is black.

    Raises:
        SettingsError: a budget below 1.
    """
    if voxel_budget < 1:
        raise SettingsError(f"voxel budget: expected at least 1, got {voxel_budget}")
    box = tissue_box(color.rgb)
    if box is None:
        return None
    rgb = color.rgb[box]
    diagonal_mm = float(np.linalg.norm(color.spacing_mm[::-1] * rgb.shape[:3]))
    factors = _reduction_factors(rgb.shape[:3], color.spacing_mm[::-1], voxel_budget)
    if factors != (1, 1, 1):
        _LOG.info(
            "rendering: %d x %d x %d voxels thinned out by %d x %d x %d (k, j, i) to stay within %d voxels",
            *rgb.shape[:3],
            *factors,
            voxel_budget,
        )
        rgb = _reduce(rgb, factors)
    first_ijk = [s.start + (f - 1) / 2 - MARGIN * f for s, f in zip(box, factors)][::-1]
    rgba = surface_rgba(rgb)
    mark_free_air(rgba)
    return Grid(rgba, shifted(color.ijk_to_ras, first_ijk, factors[::-1]), diagonal_mm)


def cut_grid(grid: Grid, cut: Cut) -> Grid:
    """The grid with alpha 0 where `cut` takes it away; its colours go on behind the new face, so it has no dark rim.

    Made in alpha and not with VTK's clipping planes: these can only leave a convex rest, and a face without a gradient
    in alpha, which shading draws dark.
    """
    rgba = grid.rgba.copy()
    for k, plane in enumerate(rgba):
        kept = 1.0 - _cut_share(k, plane.shape[:2], grid.ijk_to_ras, cut)
        plane[..., 3] = np.rint(plane[..., 3] * kept).astype(np.uint8)
    mark_free_air(rgba)
    return replace(grid, rgba=rgba)


def require_same_grid(grey: Volume | ColorVolume, color: ColorVolume) -> None:
    """Refuse two volumes that cannot be compared voxel by voxel.

    Raises:
        InputError: not volumes, other numbers of voxels, or another place in space.
    """
    if not isinstance(grey, (Volume, ColorVolume)):
        raise InputError(f"rendering: expected a Volume or a ColorVolume beside the colours, got {type(grey).__name__}")
    shape = grey.array.shape if isinstance(grey, Volume) else grey.rgb.shape[:3]
    if shape != color.rgb.shape[:3]:
        raise InputError(
            f"rendering: the grey volume has {' x '.join(map(str, shape))} voxels (k, j, i), the coloured one "
            f"{' x '.join(map(str, color.rgb.shape[:3]))}; give the volume that was coloured"
        )
    if not np.allclose(grey.ijk_to_ras, color.ijk_to_ras, rtol=0, atol=1e-3):
        raise InputError(
            "rendering: the grey and the coloured volume lie at different places; give the volume that was coloured"
        )
