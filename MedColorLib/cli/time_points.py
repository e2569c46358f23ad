"""`medcolor colorize --time-points`: all time points of a series, a file for each; all of them are written, or none."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import SettingsError
from ..output import atomic_output

if TYPE_CHECKING:
    from ..matching.tissue_guard import Guard
    from ..parameters import Settings
    from ..progress import Progress
    from ..volume import ColorVolume, Volume


def check_arguments(arguments) -> None:
    """Raises SettingsError where an option does not go with time points."""
    if arguments.resume:
        raise SettingsError("--resume keeps the matches of one volume; leave it out with --time-points")


def numbered(path: str | Path, number: int, count: int) -> Path:
    """The file of one time point: its number, from 1 on, before the endings, as long as that of the last."""
    path = Path(path)
    ending = ".nii.gz" if path.name.lower().endswith(".nii.gz") else path.suffix
    stem = path.name[: len(path.name) - len(ending)]
    return path.with_name(f"{stem}_{number:0{len(str(count))}}{path.name[len(stem) :]}")


def plan_lines(volumes: Sequence[Volume], references: Sequence, settings: Settings, guard: Guard | None) -> list[str]:
    """The plan of the first time point, a line for each of the others, and what was seen with more than one of them."""
    from ..pipeline import plan_time_points
    from ..run.estimate import estimate

    first, *others = plan_time_points(volumes, references, settings, guard)
    lines = [first.text(), *(f"Time point {plan.steps['time point']}" for plan in others)]
    new = dict.fromkeys(text for plan in others for text in plan.warnings if text not in first.warnings)
    lines += [f"Warning: {text}" for text in new]
    expected = estimate(volumes[0], references, settings, guard)
    return [
        *lines,
        f"Time on this machine for each time point that is matched by itself: {expected.text()}",
        f"Colour error to expect: {expected.error_text()}",
    ]


def colorize_series(
    volumes: Sequence[Volume],
    references: Sequence,
    settings: Settings,
    guard: Guard | None,
    outputs: Sequence[Sequence[Path | None]],
    file_sha256: str,
    progress: Progress,
) -> list[dict]:
    """Colour and write all time points.

    Args:
        outputs: of each time point the files of the colours, the confidence and the report; None: not wanted.
        file_sha256: of the input, for the reports.

    Returns:
        The reports.

    Raises:
        As `pipeline.colorize_time_points`, and OutputError; nothing was written then.
    """
    from ..pipeline import colorize_time_points

    reports = []
    with ExitStack() as stack:  # the files get their names when the last of them is whole
        colored = colorize_time_points(volumes, references, settings, progress=progress, guard=guard)
        for result, paths in zip(colored, outputs):
            result.report["input"]["file_sha256"] = file_sha256
            unfinished = [path and stack.enter_context(atomic_output(path)) for path in paths]
            _write(result, *unfinished)
            reports.append(result.report)
    return reports


def _write(result: ColorVolume, colors: Path, confidence: Path | None, report: Path | None) -> None:
    from ..io.files import write_color_volume, write_confidence
    from ..report import write_report

    write_color_volume(result, colors)
    if confidence:
        write_confidence(result, confidence)
    if report:
        write_report(result.report, report)
