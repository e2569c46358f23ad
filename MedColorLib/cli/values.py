"""What the values of options may be; argparse tells the rest of the line."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def named_value(text: str) -> tuple[str, int | float | str]:
    """NAME=VALUE, the value as a number where it is one."""
    name, separator, value = text.partition("=")
    if not (separator and name.strip() and value.strip()):
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, such as lam=16, got {text!r}")
    for kind in (int, float):
        try:
            return name.strip(), kind(value)
        except ValueError:
            continue
    return name.strip(), value.strip()


def file_name(text: str) -> str:
    """A name that is not empty: an empty one would mean the current folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the name is empty")
    return text


def path_name(text: str) -> Path:
    """`file_name` as a path."""
    return Path(file_name(text))


def at_least(least: int) -> Callable[[str], int]:
    """A whole number from `least` on."""

    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"expected a whole number, got {text!r}") from error
        if value < least:
            raise argparse.ArgumentTypeError(f"expected a whole number of at least {least}, got {value}")
        return value

    return number


def slice_range(text: str) -> tuple[int, int]:
    """A:B."""
    start, separator, stop = text.partition(":")
    if not separator or not start.isdigit() or not stop.isdigit():
        raise argparse.ArgumentTypeError(f"expected A:B with whole numbers, got {text!r}")
    return int(start), int(stop)


def exposure(text: str) -> str | float:
    """auto, off, or a gain."""
    try:
        return text if text in ("auto", "off") else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected auto, off or a gain such as 1.5, got {text!r}") from None
