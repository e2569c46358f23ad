"""The command line's options for the tissue guard."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import SettingsError
from .values import file_name

if TYPE_CHECKING:
    from ..matching.tissue_guard import Guard


def add_guard(add: Callable) -> None:
    """The options of the tissue guard; a batch has none, since every volume needs labels of its own."""
    add(
        "--labels",
        type=file_name,
        metavar="SEG",
        help="label volume on the input's grid; colour does not cross from label to label",
    )
    add(
        "--reference-labels",
        action="append",
        type=file_name,
        metavar="PNG",
        help="the same labels drawn on the reference (grey or palette PNG); one for each -r, in order, '-' for none",
    )
    add(
        "--label-group",
        action="append",
        type=_labels,
        metavar="N,N,...",
        help="these labels belong together, such as 1,2,5-9; may be repeated",
    )


def guard_of(arguments) -> Guard | None:
    """The guard that the options ask for.

    Raises:
        InputError, SettingsError: with the remedy in the message.
    """
    if not arguments.labels:
        if arguments.reference_labels or arguments.label_group:
            raise SettingsError("--reference-labels and --label-group belong to a label volume; name it with --labels")
        return None
    from ..io.label_volume import read_labels
    from ..matching.tissue_guard import Guard

    groups: dict[int, int] = {}
    for labels in arguments.label_group or ():
        for label in labels:
            if label in groups and groups[label] != labels[0]:
                raise SettingsError(f"--label-group: label {label} is in two groups; name it once")
            groups[label] = labels[0]
    pictures = arguments.reference_labels
    return Guard(read_labels(Path(arguments.labels)), pictures and [None if p == "-" else p for p in pictures], groups)


def _labels(text: str) -> list[int]:
    found: list[int] = []
    for part in text.split(","):
        first, separator, last = part.strip().partition("-")
        if not first.isdecimal() or (separator and not last.isdecimal()) or int(last or first) > 65535:
            raise argparse.ArgumentTypeError(f"expected labels from 0 to 65535 such as 1,2,5-9, got {text!r}")
        found += range(int(first), int(last or first) + 1)
    if not found:
        raise argparse.ArgumentTypeError(f"the range runs backwards: {text!r}")
    return found
