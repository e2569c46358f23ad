"""The demo: the whole way on a sample made by formula, with nothing downloaded."""

from __future__ import annotations

from pathlib import Path

from ..errors import OutputError

PHOTOGRAPHS = tuple(f"photograph_{number}.png" for number in range(1, 6))
FILES = (*PHOTOGRAPHS, "colored.nrrd", "report.json", "picture.png")
WHAT_TO_SEE = (
    "open picture.png: the scan in grey, and beside it in colour: folded grey matter over paler white matter, dark red "
    f"muscle, cream fat. {', '.join(PHOTOGRAPHS)} are the sections that the colours come from; all is made by formula. "
    "colored.nrrd is the volume, for 3D Slicer; report.json says what was done"
)


def run_demo(folder: str | Path, progress=None) -> list[Path]:
    """Colour the phantom's MR after five sections of it, write volume, report and pictures into `folder`.

    Returns:
        The files written.

    Raises:
        OutputError: the folder cannot be made or written.
        DeviceError: no OpenGL for the picture; the volume and report are there all the same.
    """
    from ..io.files import write_color_volume
    from ..parameters import Settings
    from ..phantom import series
    from ..pipeline import colorize
    from ..rendering import render_to_png
    from ..rendering.sheet import write_png
    from ..report import write_report

    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"demo folder {folder}: cannot be made ({error.strerror})") from error
    progress = progress or (lambda _fraction, _text: None)
    progress(0.0, "making a head by formula")
    volume, references = series()
    photographs = [folder / name for name in PHOTOGRAPHS]
    for path, picture in zip(photographs, references):
        write_png(path, picture)
    colored, report, picture = (folder / name for name in FILES[len(PHOTOGRAPHS) :])
    result = colorize(
        volume,
        [str(path) for path in photographs],
        Settings(features="embedded"),
        progress=lambda f, text: progress(0.05 + 0.65 * f, text),
    )
    write_color_volume(result, colored)
    write_report(result.report, report)
    render_to_png(picture, result, volume, progress=lambda f, text: progress(0.7 + 0.3 * f, text))
    return [*photographs, colored, report, picture]
