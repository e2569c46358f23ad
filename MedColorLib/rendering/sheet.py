"""The contact sheet: views and sections, grey beside colour, in one PNG."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import OutputError, SettingsError
from ..output import atomic_output
from ..scan.intensity import apply_window, choose_window
from ..volume import ColorVolume, Volume
from .grid import (
    VOXEL_BUDGET,
    by_table,
    cut_grid,
    grey_color_volume,
    not_black,
    prepare_grid,
    require_same_grid,
    shifted,
    tissue_box,
)
from .layout import PANEL_RGB, Sheet
from .lights import check_light
from .offscreen import Camera, Stage
from .presets import PICTURE_OPACITY, opacity_curve
from .sections import MAX_SECTION_SIDE, SectionFrame, section_frame, sections
from .views import camera_for, corner_cut

FOOTNOTE = "Illustration: colours are not a measurement"
MIN_SHEET_SIZE = (480, 360)
MAX_SHEET_SIZE = (4096, 4096)

# Label, view, and the corner that is taken away (R, A, S) through the point where the three sections meet.
_VIEWS = (
    ("Surface", "oblique", None),
    ("Cut open", "oblique", (-1, 1, 1)),
    ("Left half taken away", "left-oblique", (-1, 0, 0)),
)
# Name, and the letters at the left and right edge.
_SECTIONS = (("transverse", ("R", "L")), ("coronal", ("R", "L")), ("sagittal", ("A", "P")))

_SUPERSAMPLING = 1.5  # smooth edges for 2.25 times the work
_VISIBLE = 32  # of 255: darker is noise and air, no reason for a larger frame
_VIEW_FILL = 0.86  # leaves room for the label


def contact_sheet(
    grey: Volume | ColorVolume | None,
    color: ColorVolume,
    size: tuple[int, int] = (1600, 1200),
    *,
    window: tuple[float, float] | None = None,
    opacity: float = PICTURE_OPACITY,
    centre: tuple[float, float, float] | None = None,
    voxel_budget: int = VOXEL_BUDGET,
    titles: tuple[str, str] = ("Scan", "Coloured"),
    light: str = "plain",
    progress: Callable[[float, str], None] | None = None,
) -> np.ndarray:
    """Three views and three sections; each of the grey volume beside its coloured version.

    Args:
        grey: the volume that was coloured, shown whole, with what was left out of the body. None leaves the grey half
            out.
        color: RGB volume.
        size: (width, height) in pixels.
        window: (low, high) for grey scalars; without it the file's own, else robust percentiles inside the body.
        opacity: 0 to 1 for the views.
        centre: where the sections meet and the body is cut open, in fractions 0..1 of its extent along R, A, S;
            without it the centroid of all that is not black.
        voxel_budget: see `render_view`.
        titles: above the left and the right half.
        light: "plain" or "realistic", see `lights`.
        progress: called with (fraction 0..1, text); may raise to stop.

    Returns:
        (H, W, 3) uint8 RGB. Empty panels when `color` is all black.

    Raises:
        InputError: `grey` is not on the grid of `color`, or has no window.
        SettingsError: a size, opacity, window or centre out of range.
        DeviceError: no OpenGL on this machine.
    """
    _check_sheet_size(size)
    opacity_curve(opacity)
    check_light(light)
    frame = section_frame(color, centre)
    if grey is None:
        sheet = Sheet(size, (3, 2), ("",), FOOTNOTE)
        view_cells, section_cells = (0, 1, 2), (3, 4, 5)
    else:
        sheet = Sheet(size, (2, 3), titles, FOOTNOTE)
        view_cells, section_cells = (0, 2, 4), (1, 3, 5)
        require_same_grid(grey, color)
    if frame is None:
        return sheet.picture
    volumes = _shown(grey, color, window)
    frame = _widened(frame, volumes[0])
    planes = _trimmed([sections(volume, frame=frame) for volume in volumes])
    views = _draw_views(volumes, np.asarray(frame.centre), sheet.panel_size, opacity, voxel_budget, light, progress)
    for panel in range(len(volumes)):
        for cell, picture, (label, _, _) in zip(view_cells, views[panel], _VIEWS):
            sheet.place(cell, panel, picture, label)
        for cell, (name, edges) in zip(section_cells, _SECTIONS):
            sheet.place(cell, panel, planes[panel][name], name.capitalize(), edges)
    return sheet.picture


def render_to_png(
    path: str | os.PathLike,
    color: ColorVolume,
    grey: Volume | ColorVolume | None = None,
    size: tuple[int, int] = (1600, 1200),
    *,
    window: tuple[float, float] | None = None,
    opacity: float = PICTURE_OPACITY,
    centre: tuple[float, float, float] | None = None,
    voxel_budget: int = VOXEL_BUDGET,
    titles: tuple[str, str] = ("Scan", "Coloured"),
    light: str = "plain",
    progress: Callable[[float, str], None] | None = None,
) -> Path:
    """Draw the `contact_sheet` (see there) and write it to `path`; an unfinished file never bears that name.

    Returns:
        The path written.

    Raises:
        OutputError: the name does not end in .png, or the folder is missing or cannot be written to.
        InputError, SettingsError, DeviceError: see `contact_sheet`.
    """
    target = png_target(path)
    options = {"window": window, "opacity": opacity, "centre": centre, "voxel_budget": voxel_budget, "titles": titles}
    options |= {"light": light, "progress": progress}
    sheet = contact_sheet(grey, color, size, **options)
    write_png(target, sheet)
    return target


def png_target(path: str | os.PathLike) -> Path:
    """The path, if a picture can be written there; to be asked before the work.

    Raises:
        OutputError: the name does not end in .png, the folder is missing, or a folder has the name.
    """
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise OutputError(f"{target.name}: pictures are written as PNG; choose a name that ends in .png")
    if not target.parent.is_dir():
        raise OutputError(f"{target}: the folder does not exist; create it first")
    if target.is_dir():
        raise OutputError(f"{target}: this is a folder; choose the name of a file")
    return target


def write_png(target: Path, picture: np.ndarray) -> None:
    """Write (H, W, 3) uint8 RGB under a temporary name beside `target`, then rename it.

    Raises:
        OutputError: the folder cannot be written to, or the disk is full.
    """
    import cv2

    _, data = cv2.imencode(".png", picture[..., ::-1])
    with atomic_output(target) as temporary:
        temporary.write_bytes(data.tobytes())


def _check_sheet_size(size: tuple[int, int]) -> None:
    if len(size) != 2 or any(not low <= n <= high for n, low, high in zip(size, MIN_SHEET_SIZE, MAX_SHEET_SIZE)):
        raise SettingsError(
            f"sheet size: expected from {MIN_SHEET_SIZE[0]} x {MIN_SHEET_SIZE[1]} to "
            f"{MAX_SHEET_SIZE[0]} x {MAX_SHEET_SIZE[1]} pixels, got {' x '.join(map(str, size))}"
        )


def _shown(
    grey: Volume | ColorVolume | None, color: ColorVolume, window: tuple[float, float] | None
) -> list[ColorVolume]:
    """The volumes to draw, cropped to what can be seen of either: the grey one as RGB, whole, and `color`.

    The scan is never cut by the colours' outline: what was left out of the body has to be seen beside them.
    """
    box = tissue_box(color.rgb)
    if grey is None:
        return [ColorVolume(color.rgb[box], _matrix(color, box))]
    if isinstance(grey, Volume):
        body = np.stack([not_black(plane) for plane in color.rgb[box]])  # where its window is taken from, nothing else
        chosen = choose_window(grey.array[box], body, given=window, proposed=grey.window)
        visible = by_table(lambda values: apply_window(values, chosen) > _VISIBLE / 255, grey.array.dtype)
        box = _joined(box, _visible_box(visible(plane) for plane in grey.array))
        scalars = Volume(grey.array[box], _matrix(color, box), name=grey.name)
        left = grey_color_volume(scalars, (chosen.low, chosen.high))
    else:
        box = _joined(box, _visible_box(plane.max(axis=-1) > _VISIBLE for plane in grey.rgb))
        left = ColorVolume(grey.rgb[box], _matrix(color, box))
    return [left, ColorVolume(color.rgb[box], _matrix(color, box))]


def _widened(frame: SectionFrame, volume: ColorVolume) -> SectionFrame:
    """The frame, around all of a volume, its planes where they were."""
    corners = np.array([[i, j, k, 1.0] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    corners[:, :3] = corners[:, :3] * np.array(volume.rgb.shape[2::-1]) - 0.5
    points = (corners @ volume.ijk_to_ras.T)[:, :3]
    low, high = np.minimum(frame.low, points.min(axis=0)), np.maximum(frame.high, points.max(axis=0))
    pixel_mm = max(frame.pixel_mm, float((high - low).max()) / MAX_SECTION_SIDE)
    return replace(frame, low=low, high=high, pixel_mm=pixel_mm)


def _matrix(color: ColorVolume, box: tuple[slice, slice, slice]) -> np.ndarray:
    return shifted(color.ijk_to_ras, tuple(s.start for s in box[::-1]))


def _visible_box(masks: Iterable[np.ndarray]) -> tuple[slice, slice, slice] | None:
    """Smallest box (slices along k, j, i) that holds all of the masks of planes (j, i); None where they are empty."""
    profiles = [(mask.any(axis=1), mask.any(axis=0)) for mask in masks]
    rows, cols = (np.any([profile[axis] for profile in profiles], axis=0) for axis in (0, 1))
    planes = [profile[0].any() for profile in profiles]
    ends = [np.flatnonzero(profile) for profile in (planes, rows, cols)]
    return tuple(slice(int(end[0]), int(end[-1]) + 1) for end in ends) if rows.any() else None


def _joined(box: tuple[slice, slice, slice], other: tuple[slice, slice, slice] | None) -> tuple[slice, slice, slice]:
    if other is None:
        return box
    return tuple(slice(min(a.start, b.start), max(a.stop, b.stop)) for a, b in zip(box, other))


def _trimmed(planes: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    """All sections cut to what can be seen in any of them; both of a kind keep one frame."""
    boxes = {}
    for name in planes[0]:
        mask = np.any([some[name].max(axis=-1) > _VISIBLE for some in planes], axis=0)
        mask |= not_black(planes[-1][name])
        ends = [np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0)]
        if all(end.size for end in ends):
            boxes[name] = tuple(slice(end[0], end[-1] + 1) for end in ends)
    return [{name: picture[boxes.get(name, ...)] for name, picture in some.items()} for some in planes]


def _draw_views(
    volumes: list[ColorVolume],
    cut_point: np.ndarray,
    panel_size: tuple[int, int],
    opacity: float,
    voxel_budget: int,
    light: str,
    progress: Callable[[float, str], None] | None,
) -> list[list[np.ndarray]]:
    """For each volume its three views, all with the cameras that suit the first one: a scan shows all that the colours do."""
    import cv2

    size = tuple(round(_SUPERSAMPLING * n) for n in panel_size)
    pictures = [[np.zeros((*panel_size[::-1], 3), dtype=np.uint8)] * len(_VIEWS) for _ in volumes]
    cameras: list[Camera | None] = []
    with Stage(size, PANEL_RGB) as stage:
        for v in range(len(volumes)):
            whole = prepare_grid(volumes[v], voxel_budget)
            for n, (label, view, towards) in enumerate(_VIEWS):
                if progress:
                    done = (len(volumes) - 1 - v) * len(_VIEWS) + n
                    progress(done / (len(volumes) * len(_VIEWS)), label.lower())
                if whole is None:
                    continue
                grid = whole if towards is None else cut_grid(whole, corner_cut(cut_point, towards))
                if len(cameras) == n:
                    cameras.append(camera_for(grid, view, size, _VIEW_FILL))
                if cameras[n] is None:
                    continue
                stage.show(grid, opacity, light=light)
                pictures[v][n] = cv2.resize(stage.draw(cameras[n]), panel_size, interpolation=cv2.INTER_AREA)
    return pictures
