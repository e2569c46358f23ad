"""Places of DICOM frames to a regular grid: taken as it is where the frames lie on one, resampled where they do not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .dicom_header import Frame
from .dicom_volumes import has_place, height_of
from .voxel_data import LPS_TO_RAS

_GAP = 1.5  # a step of more than this many median steps lacks a slice
_UNEVEN = 0.01  # of a step: a deviation from even places that is worth a note
_RESAMPLE = 0.05  # of a step: a deviation that is not left as it is
_SIDEWAYS_PX = 0.25  # a shift across the normal that is not left as it is
_MAX_FILLED = 1.0  # slices made up in gaps, as a share of those that are there


@dataclass(frozen=True)
class Grid:
    """Where the slices of a volume lie.

    Attributes:
        ijk_to_ras: (4, 4).
        shape: (k, j, i) of the volume.
        heights_mm: of the frames along the normal, or None: every frame is a slice as it is.
        wanted_mm: (k,) heights of the slices, where the frames have to be resampled.
        shift_px: (n, 2) how far along j and i each frame is moved for that.
        notes: what was decided.
    """

    ijk_to_ras: np.ndarray
    shape: tuple[int, int, int]
    heights_mm: np.ndarray | None = None
    wanted_mm: np.ndarray | None = None
    shift_px: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def grid_of(frames: Sequence[Frame]) -> Grid:
    """The grid of frames that are in order.

    Raises:
        InputError: more slices are missing than there are.
    """
    first, notes = frames[0], []
    shape = (len(frames), first.size[1], first.size[0])
    if first.spacing_mm is None:
        notes.append("no pixel spacing in the header: 1 mm is assumed")
    spacing = first.spacing_mm or (1.0, 1.0)
    if first.equidistant:
        notes.append(
            "a multi-frame file without positions of its frames: they are taken to be equidistant, as its header says"
        )
    if not has_place(first):
        return Grid(_assumed(first, spacing, len(frames), notes), shape, notes=tuple(notes))
    axes = np.reshape(first.axes, (2, 3))
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    normal = np.cross(*axes)
    normal /= np.linalg.norm(normal)
    heights = np.array([height_of(frame) for frame in frames])
    positions = np.array([frame.position_mm for frame in frames])
    if len(frames) == 1:
        step = first.thickness_mm or 1.0
        return Grid(_matrix(axes, spacing, normal * step, positions[0]), shape, notes=tuple(notes))
    aside = positions - positions[0] - np.outer(heights - heights[0], normal)  # from the line along the normal
    shift_px = np.stack([aside @ axes[1] / spacing[1], aside @ axes[0] / spacing[0]], axis=1)
    step, uneven = _step(heights, notes)
    moved = _sideways(shift_px, aside, heights, notes)
    if not (uneven or moved):
        between = (positions[-1] - positions[0]) / (len(frames) - 1)
        return Grid(_matrix(axes, spacing, between, positions[0]), shape, notes=tuple(notes))
    if not moved:
        shift_px = np.zeros_like(shift_px)
    count = (
        round((heights[-1] - heights[0]) / step) if not uneven else int((heights[-1] - heights[0]) / step + _RESAMPLE)
    )
    if count + 1 - len(frames) > _MAX_FILLED * len(frames):
        raise InputError(
            f"the slices lie in blocks far from each other: {len(frames)} slices where {count + 1} would be even; put the "
            "files of one block into a folder of their own"
        )
    wanted = heights[0] + step * np.arange(count + 1)
    low, high = np.floor(shift_px.min(axis=0)), np.ceil(shift_px.max(axis=0))
    origin = positions[0] + low[0] * spacing[1] * axes[1] + low[1] * spacing[0] * axes[0]
    size = np.array(shape[1:]) + (high - low).astype(int)
    matrix = _matrix(axes, spacing, normal * step, origin)
    return Grid(matrix, (len(wanted), int(size[0]), int(size[1])), heights, wanted, shift_px - low, tuple(notes))


def _assumed(first: Frame, spacing: tuple[float, float], count: int, notes: list[str]) -> np.ndarray:
    """The geometry of frames without positions."""
    step = first.thickness_mm or 1.0
    if count > 1:
        known = "as the header says" if first.thickness_mm else "which is assumed"
        notes.append(f"slices without a position: ordered by their number, {step:g} mm apart, {known}")
    elif not first.position_mm:
        notes.append("an image without a position: it is laid at 0, 0, 0")
    axes = np.reshape(first.axes, (2, 3)) if first.axes else np.eye(3)[:2]
    return _matrix(axes, spacing, np.cross(*axes) * step, np.array(first.position_mm or (0.0, 0.0, 0.0)))


def _matrix(axes: np.ndarray, spacing: tuple[float, float], step: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(4, 4) IJK to RAS; all arguments in LPS millimetres."""
    matrix = np.eye(4)
    matrix[:3, :2] = axes.T * spacing
    matrix[:3, 2], matrix[:3, 3] = step, origin
    return LPS_TO_RAS @ matrix + 0.0  # + 0.0 turns -0.0 into 0.0


def _step(heights: np.ndarray, notes: list[str]) -> tuple[float, bool]:
    """(millimetres from slice to slice, whether the slices have to be resampled to be that far apart)."""
    steps = np.diff(heights)
    even = float(heights[-1] - heights[0]) / len(steps)
    off = float(np.abs(heights - heights[0] - even * np.arange(len(heights))).max())
    if off <= _RESAMPLE * even:  # end to end, so that the rounding of single positions does not add up
        if np.ptp(steps) > _UNEVEN * even and off > _UNEVEN * even:
            notes.append(
                f"slices {steps.min():.4g} to {steps.max():.4g} mm apart; laid evenly, at most {off:.3g} mm off"
            )
        return even, False
    median = float(np.median(steps))
    usual = steps[steps <= _GAP * median]
    step = float(usual.mean()) if np.ptp(usual) <= _RESAMPLE * median else median
    gaps = np.flatnonzero(steps > _GAP * median)
    if len(gaps):
        shown = ", ".join(f"{steps[n]:.4g} mm after {heights[n]:.4g} mm" for n in gaps[:5]) + ", ..." * (len(gaps) > 5)
        notes.append(
            f"{len(gaps)} gaps between slices, where {median:.4g} mm is usual: {shown}; filled by interpolation, what is "
            "seen there was not scanned"
        )
    if np.ptp(usual) > _RESAMPLE * median:
        notes.append(f"slices {usual.min():.4g} to {usual.max():.4g} mm apart; resampled to {step:.4g} mm (linear)")
    return step, True


def _sideways(shift_px: np.ndarray, aside: np.ndarray, heights: np.ndarray, notes: list[str]) -> bool:
    """Whether frames lie so far beside the normal that they have to be moved: gantry tilt, or single frames."""
    if np.abs(shift_px).max() <= _SIDEWAYS_PX:
        return False
    rise = heights - heights[0]
    line = aside[-1] / rise[-1]
    off_line = float(np.linalg.norm(aside - np.outer(rise, line), axis=1).max())
    tilt = math.degrees(math.atan(float(np.linalg.norm(line))))
    if tilt > 0.1:
        notes.append(f"gantry tilt of {tilt:.1f} degrees; resampled to an upright grid (linear)")
    if off_line > 0.01:
        notes.append(f"slices are shifted sideways by up to {off_line:.3g} mm; moved back to their places (linear)")
    return True


def resampled(grid: Grid, planes: Callable[[int], np.ndarray], dtype: np.dtype) -> Iterator[np.ndarray]:
    """The (j, i) slices of a grid, one by one; every frame is decoded once. What no frame covers gets its least value.

    Args:
        planes: gives the pixels of frame n; asked for in order.
    """
    heights = grid.heights_mm
    assert heights is not None and grid.wanted_mm is not None and grid.shift_px is not None
    ready: dict[int, np.ndarray] = {}
    for z in grid.wanted_mm:
        upper = int(np.clip(np.searchsorted(heights, z), 1, len(heights) - 1))
        share = float(np.clip((z - heights[upper - 1]) / (heights[upper] - heights[upper - 1]), 0, 1))
        share = round(share, 6)
        plane = 0.0
        for number, weight in ((upper - 1, 1 - share), (upper, share)):
            if weight == 0:
                continue
            for old in [n for n in ready if n < number - 1]:
                del ready[old]
            if number not in ready:
                ready[number] = _moved(planes(number), grid.shift_px[number], grid.shape[1:])
            plane = plane + weight * ready[number]
        yield np.rint(plane).astype(dtype) if dtype.kind in "iu" else np.asarray(plane, dtype)


def _moved(plane: np.ndarray, shift_px: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(j, i) float64: the plane on a larger canvas, moved down and right by a part of pixels, linearly."""
    canvas = np.full(shape, float(plane.min()))
    whole = np.floor(shift_px + 1e-6).astype(int)
    part = np.clip(shift_px - whole, 0, 1)
    part[part < 1e-6] = 0
    rows, columns = plane.shape
    canvas[whole[0] : whole[0] + rows, whole[1] : whole[1] + columns] = plane
    for axis in (0, 1):
        if part[axis]:
            before = np.concatenate([canvas.take([0], axis), canvas.take(range(shape[axis] - 1), axis)], axis)
            canvas = (1 - part[axis]) * canvas + part[axis] * before
    return canvas
