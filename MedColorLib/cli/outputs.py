"""The files that a command will write: found out before a long computation, and said where they replace others."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from ..cohort.terminal import tell
from ..errors import SettingsError
from ..output import check_output_path, leftovers


def check_outputs(arguments, files: Sequence[Path] | None = None) -> list[Path]:
    """Refuse what cannot be written or would replace what is read; returns the files that will be replaced.

    Args:
        files: result, confidence and report, where they are not called as in the arguments.
    """
    check_named(arguments)
    taken = {_identity(path): role for path, role in _inputs(arguments)}
    files = files or (arguments.output, arguments.confidence, arguments.report)
    outputs = tuple(zip(files, ("the result", "the confidence", "the report")))
    for path, role in outputs:
        if not path:
            continue
        check_output_path(path, *([(".json",)] if role == "the report" else []))
        former = taken.setdefault(_identity(path), role)
        if former != role:
            raise SettingsError(f"colorize: {path} is {former}; {role} would replace it, name another file")
    tell_leftovers(path for path, _ in outputs if path)
    return existing(path for path, _ in outputs if path)


def check_named(arguments) -> None:
    """Raises SettingsError where a result is wanted and has no name."""
    if not (arguments.output or arguments.plan):
        raise SettingsError("colorize: name the result with -o OUT.nrrd (or use --plan)")


def _inputs(arguments) -> list[tuple[str, str]]:
    """Files that are read, and what they are; a library's name is none, and does no harm."""
    pictures = [path for path in arguments.reference_labels or () if path != "-"]
    masks = [path for path in arguments.reference_masks or () if path != "auto"]
    return [
        (arguments.input, "the input"),
        *((path, "a reference") for path in arguments.reference),
        *((path, "the label volume") for path in [arguments.labels] if path),
        *((path, "a label picture") for path in pictures),
        *((path, "a reference's mask") for path in masks),
        *((path, "the body") for path in [arguments.body] if path not in ("auto", "all")),
    ]


def _identity(path: str | Path) -> tuple:
    """The same for all names of one file: links are followed, and hard links are one."""
    try:
        state = os.stat(path)
    except OSError:
        return (os.path.realpath(path),)
    return (state.st_dev, state.st_ino) if state.st_ino else (os.path.realpath(path),)


def existing(paths: Iterable[str | Path]) -> list[Path]:
    """Those of the paths where a file is now."""
    return [Path(path) for path in paths if Path(path).is_file()]


def tell_replaced(paths: Iterable[Path]) -> None:
    """Say which earlier files are gone."""
    for path in paths:
        tell(f"{path}: the earlier file of this name was replaced")


def tell_leftovers(paths: Iterable[str | Path]) -> None:
    """Say which unfinished files lie beside these."""
    for path in paths:
        for left in leftovers(path):
            tell(
                f"{left}: left by a run that was killed, or being written now; delete it if nothing else writes {path}"
            )
