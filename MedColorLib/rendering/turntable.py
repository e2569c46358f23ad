"""A coloured volume that turns once around: as a film, an animated GIF, or a folder of numbered pictures.

Films are written by imageio with the FFmpeg that imageio-ffmpeg brings: H.264, which every browser and every slide program
plays; OpenCV, which is here anyway, can only write codecs that most of them do not. Numbered pictures need neither.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ..errors import MissingPackageError, OutputError, SettingsError
from ..output import atomic_output
from ..volume import ColorVolume
from .grid import VOXEL_BUDGET, Cut, cut_grid, prepare_grid
from .offscreen import Stage, check_size
from .presets import PICTURE_OPACITY, opacity_curve
from .views import body_radius_camera, camera_for, turned

FRAMES, FRAMES_PER_SECOND = 72, 24
_FILMS = (".mp4", ".gif")


def turntable(
    path: str | os.PathLike,
    color: ColorVolume,
    view: str = "anterior",
    size: tuple[int, int] = (800, 800),
    *,
    frames: int = FRAMES,
    opacity: float = PICTURE_OPACITY,
    light: str = "plain",
    cut: Cut | None = None,
    voxel_budget: int = VOXEL_BUDGET,
    progress: Callable[[float, str], None] | None = None,
) -> Path:
    """Write a turn of 360 degrees, from `view` to the patient's right side first; unfinished files never bear the name.

    Args:
        path: name that ends in .mp4 or .gif, or a folder for frame-0000.png and so on (made if it is not there).
        color: RGB volume; black is air.
        view, size, opacity, light, cut, voxel_budget: see `render_view`. Sides of an .mp4 must be even.
        frames: how many pictures make the turn; played at 24 a second.
        progress: called with (fraction 0..1, text); may raise to stop.

    Returns:
        The path written.

    Raises:
        OutputError: another ending, or the folder is missing or cannot be written to.
        SettingsError: a value out of range, an all black volume.
        MissingPackageError: imageio is not installed; numbered pictures go without.
        DeviceError: no OpenGL on this machine.
    """
    target = Path(path)
    kind = target.suffix.lower()
    _check(target, kind, size, frames)
    opacity_curve(opacity)
    pictures = _pictures(color, view, size, frames, opacity, light, cut, voxel_budget, progress)
    if kind:
        with atomic_output(target) as temporary:
            _write(temporary, kind, pictures)
        return target
    unfinished = target.with_name(f".{secrets.token_hex(4)}-unfinished-{target.name}")
    try:
        _write(unfinished, kind, pictures)
        if not target.exists():
            os.replace(unfinished, target)
        else:  # a folder that is there, empty
            for picture in sorted(unfinished.iterdir()):
                os.replace(picture, target / picture.name)
    except OSError as error:
        raise OutputError(f"{target}: cannot be written ({error.strerror or error}); check the folder") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return target


def _check(target: Path, kind: str, size: tuple[int, int], frames: int) -> None:
    check_size(size)
    if frames < 2:
        raise SettingsError(f"turntable: expected at least 2 pictures, got {frames}")
    if kind not in (*_FILMS, ""):
        raise OutputError(f"{target.name}: a turn is written as .mp4, .gif or a folder of pictures; choose such a name")
    if not target.parent.is_dir():
        raise OutputError(f"{target}: the folder does not exist; create it first")
    if not kind and target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise OutputError(f"{target}: something is there; name a new or an empty folder")
    if kind == ".mp4" and (size[0] % 2 or size[1] % 2):
        raise SettingsError(f"turntable: the sides of a film must be even, got {size[0]} x {size[1]}")
    if kind:
        _imageio(kind)


def _imageio(kind: str):
    try:
        import imageio.v2

        if kind == ".mp4":
            import imageio_ffmpeg  # noqa: F401
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            'turntable: films need imageio; run: pip install "medcolor[film]". A folder name in place of '
            f"*{kind} gives numbered pictures without it"
        ) from error
    return imageio.v2


def _pictures(color, view, size, frames, opacity, light, cut, voxel_budget, progress) -> Iterator[np.ndarray]:
    """The pictures (H, W, 3) of the turn, one after the other."""
    grid = prepare_grid(color, voxel_budget)
    if grid is not None and cut is not None:
        grid = cut_grid(grid, cut)
    camera = None if grid is None else camera_for(grid, view, size)
    if camera is None:
        raise SettingsError("turntable: there is nothing to see; the volume is black, or the cut takes all away")
    camera = body_radius_camera(camera, grid, size)
    with Stage(size) as stage:
        stage.show(grid, opacity, light=light)
        for n in range(frames):
            if progress:
                progress(n / frames, f"picture {n + 1} of {frames}")
            yield stage.draw(turned(camera, 360.0 * n / frames))
    if progress:
        progress(1.0, "done")


def _write(path: Path, kind: str, pictures: Iterator[np.ndarray]) -> None:
    if not kind:
        import cv2

        path.mkdir()
        for n, picture in enumerate(pictures):
            coded = cv2.imencode(".png", picture[..., ::-1])[1]
            (path / f"frame-{n:04d}.png").write_bytes(coded.tobytes())
        return
    options = {"fps": FRAMES_PER_SECOND, "codec": "libx264", "quality": 8, "macro_block_size": 2}
    if kind == ".gif":
        options = {"duration": 1000.0 / FRAMES_PER_SECOND, "loop": 0}
    with _imageio(kind).get_writer(path, **options) as writer:
        for picture in pictures:
            writer.append_data(picture)
