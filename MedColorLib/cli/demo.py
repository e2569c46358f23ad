"""The demo: the whole way on a sample made by formula, with nothing downloaded."""

from __future__ import annotations

from pathlib import Path

from ..errors import OutputError

FILES = ("reference.png", "colored.nrrd", "report.json", "picture.png")
WHAT_TO_SEE = (
    "open picture.png: the scan in grey, and beside it in the colours of the photograph reference.png (both made by formula). "
    "colored.nrrd is the volume, for 3D Slicer; report.json says what was done"
)


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
    progress = progress or (lambda _fraction, _text: None)
    result = colorize(
        volume, [reference], Settings(features="embedded"), progress=lambda f, text: progress(0.7 * f, text)
    )
    write_color_volume(result, paths[1])
    write_report(result.report, paths[2])
    render_to_png(paths[3], result, volume, progress=lambda f, text: progress(0.7 + 0.3 * f, text))
    return paths
