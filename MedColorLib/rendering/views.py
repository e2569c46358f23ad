"""Cameras: where a view looks from, how much it shows, and the picture of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ..errors import SettingsError
from ..volume import ColorVolume
from .grid import VOXEL_BUDGET, Cut, Grid, cut_grid, not_black, prepare_grid
from .lights import check_light
from .offscreen import Camera, Stage, check_size
from .presets import ALPHA_AIR, PICTURE_OPACITY, opacity_curve

# Name: (from the body to the viewer, up), both in RAS: x to the patient's right, y to the front, z to the head.
VIEWS = {
    "anterior": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "posterior": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "left": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "right": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "superior": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    "inferior": ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "oblique": ((-0.55, 0.75, 0.38), (0.0, 0.0, 1.0)),
    "left-oblique": ((-0.78, 0.6, 0.2), (0.0, 0.0, 1.0)),
}
FILL = 0.94  # of the picture's width or height


def turned(camera: Camera, degrees: float) -> Camera:
    """The camera moved around the body, about the axis that points up in the picture; 90: it looks from the right."""
    angle = np.radians(degrees)
    right = np.cross(camera.up, camera.towards)
    towards = np.cos(angle) * camera.towards + np.sin(angle) * right
    return replace(camera, towards=towards)


def body_radius_camera(camera: Camera, grid: Grid, size: tuple[int, int], fill: float = FILL) -> Camera:
    """The camera at such a distance that the body stays in the picture of `size` all around its upright axis."""
    outline = outline_of((plane[..., 3] > ALPHA_AIR for plane in grid.rgba), grid.ijk_to_ras)
    ends = outline.extent(np.eye(3))
    centre = (ends[0] + ends[1]) / 2
    around = np.eye(3) - np.outer(camera.up, camera.up)
    points = outline.centres[:: max(1, len(outline.centres) // 20000)] - centre
    radius = float(np.linalg.norm(points @ around, axis=1).max()) + float(np.abs(outline.corners).max())
    height = float(np.abs(points @ camera.up).max()) + float(np.abs(outline.corners).max())
    half = max(height, radius * size[1] / size[0]) / fill
    return replace(camera, focal=centre, half_height_mm=half, distance_mm=max(camera.distance_mm, 3 * radius))


def _directions(view: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors towards the viewer, to the right and up in the picture."""
    if view not in VIEWS:
        raise SettingsError(f"view: expected one of {', '.join(VIEWS)}, got {view!r}")
    towards, up = (np.array(vector) for vector in VIEWS[view])
    towards /= np.linalg.norm(towards)
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return towards, right, np.cross(towards, right)


@dataclass(frozen=True)
class Outline:
    """The extreme points of all voxels that are not black.

    Attributes:
        centres: (n, 3) millimetres RAS, the first and last such voxel of each row. They hold the extremes in every
            direction, whatever the directions of the voxel axes: a body fills the picture however it is stored.
        corners: (8, 3) millimetres, from a voxel's centre to its corners.
    """

    centres: np.ndarray
    corners: np.ndarray

    def extent(self, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest millimetre along each row of `axes` (n, 3)."""
        centres, corners = self.centres @ axes.T, self.corners @ axes.T
        return centres.min(axis=0) + corners.min(axis=0), centres.max(axis=0) + corners.max(axis=0)


def outline_of(planes: Iterable[np.ndarray], ijk_to_ras: np.ndarray) -> Outline | None:
    """Outline of the voxels that are set in `planes`, one mask (j, i) for each k; None when none is."""
    found = []
    for k, mask in enumerate(planes):
        rows = np.flatnonzero(mask.any(axis=1))
        first = mask[rows].argmax(axis=1)
        last = mask.shape[1] - 1 - mask[rows, ::-1].argmax(axis=1)
        found += [np.stack([i, rows, np.full(rows.shape, k)], axis=1) for i in (first, last)]
    ijk = np.concatenate(found)
    if ijk.size == 0:
        return None
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1)
    return Outline(ijk @ ijk_to_ras[:3, :3].T + ijk_to_ras[:3, 3], (ijk_to_ras[:3, :3] @ corners).T)


def body_outline(color: ColorVolume) -> Outline | None:
    """Outline of the voxels that are not black; None when all are."""
    return outline_of((not_black(plane) for plane in color.rgb), color.ijk_to_ras)


def camera_for(grid: Grid, view: str, size: tuple[int, int], fill: float = FILL) -> Camera | None:
    """The camera in whose picture of `size` (width, height) the body fills a share `fill` of the width or height.

    None when no voxel can be seen, as after a cut that takes all away.
    """
    towards, right, up = _directions(view)
    outline = outline_of((plane[..., 3] > ALPHA_AIR for plane in grid.rgba), grid.ijk_to_ras)
    if outline is None:
        return None
    axes = np.stack([right, up, towards])
    low, high = outline.extent(axes)
    half = (high - low) / 2
    half_height_mm = float(max(half[1], half[0] * size[1] / size[0])) / fill
    distance_mm = 4.0 * float(np.linalg.norm(half))
    return Camera(axes.T @ ((low + high) / 2), towards, up, half_height_mm, distance_mm)


def corner_cut(point: tuple[float, float, float], towards: tuple[int, int, int] = (-1, 1, 1)) -> Cut:
    """A cut that opens one corner of the body along planes of the patient.

    Args:
        point: millimetres RAS that the planes go through, such as `section_frame(color).centre`.
        towards: which side is taken away along R, A, S: 1 the right, front, upper; -1 the left, back, lower; 0 leaves
            that axis uncut. One number that is not 0 takes a half, two a quarter, three an eighth.

    Raises:
        SettingsError: no axis is cut, or a number other than -1, 0, 1.
    """
    if len(towards) != 3 or not any(towards) or any(side not in (-1, 0, 1) for side in towards):
        raise SettingsError(f"corner cut: expected three of -1, 0, 1, not all 0, got {towards}")
    place = tuple(float(v) for v in point)
    normals = [tuple(side * row for row in axis) for side, axis in zip(towards, np.eye(3).tolist()) if side]
    return Cut(tuple((normal, place) for normal in normals))


def render_view(
    color: ColorVolume,
    view: str = "anterior",
    size: tuple[int, int] = (800, 800),
    *,
    opacity: float = PICTURE_OPACITY,
    shade: bool = True,
    light: str = "plain",
    cut: Cut | None = None,
    voxel_budget: int = VOXEL_BUDGET,
) -> np.ndarray:
    """Draw the volume with GPU ray casting, luminance as alpha, without a display.

    Args:
        color: RGB volume; black is air. Its directions may be rotated, left-handed or sheared.
        view: name in `VIEWS`. Anterior looks from the front, the patient's right on the left of the picture.
        size: (width, height) in pixels.
        opacity: 0 (nothing) to 1 (solid).
        shade: lamp at the camera (`presets.AMBIENT` and so on); without it colours come out as they are.
        light: "plain", a lamp at the viewer, or "realistic", see `lights`.
        cut: region taken away, see `corner_cut`.
        voxel_budget: above it the volume is thinned out, which is logged.

    Returns:
        (H, W, 3) uint8 RGB on black. All black for a volume that is.

    Raises:
        SettingsError: unknown view, size or opacity out of range.
        DeviceError: no OpenGL on this machine, or the driver failed.
    """
    check_size(size)
    _directions(view)
    opacity_curve(opacity)
    check_light(light)
    grid = prepare_grid(color, voxel_budget)
    if grid is not None and cut is not None:
        grid = cut_grid(grid, cut)
    camera = None if grid is None else camera_for(grid, view, size)
    if camera is None:
        return np.zeros((int(size[1]), int(size[0]), 3), dtype=np.uint8)
    with Stage(size) as stage:
        stage.show(grid, opacity, shade, light)
        return stage.draw(camera)
