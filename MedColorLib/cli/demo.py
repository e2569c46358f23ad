"""The demo: the whole way on a sample made by formula, with nothing downloaded."""

from __future__ import annotations

from pathlib import Path

from ..errors import OutputError

FILES = ("reference.png", "colored.nrrd", "report.json", "picture.png")


def run_demo(folder: str | Path, progress=None) -> list[Path]:
    """Colour the phantom with the embedded features, write volume, report and pictures into `folder`.

    Returns:
        The files written.

    Raises:
        OutputError: the folder cannot be made or written.
        DeviceError: no OpenGL for the picture; the volume and report are there all the same.
    """
    from ..io.files import write_color_volume
    from ..parameters import Settings
    from ..phantom import sample
    from ..pipeline import colorize
    from ..rendering import render_to_png
    from ..rendering.sheet import write_png
    from ..report import write_report

    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"demo folder {folder}: cannot be made ({error.strerror})") from error
    volume, reference = sample()
    paths = [folder / name for name in FILES]
    write_png(paths[0], reference)
    scaled = (lambda fraction, text: progress(0.7 * fraction, text)) if progress else None
    result = colorize(volume, [reference], Settings(features="embedded"), progress=scaled)
    write_color_volume(result, paths[1])
    write_report(result.report, paths[2])
    if progress:
        progress(0.75, "rendering")
    render_to_png(paths[3], result, volume)
    return paths
