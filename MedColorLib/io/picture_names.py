"""The order of slices by the numbers in their names: signs and decimals, several series, numbers that are missing.

What a name means is decided for all names of a folder together: a dash is a minus, and a point a decimal point, where that
makes names alike which would otherwise differ.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .voxel_data import natural_key

_SIGN, _POINT = r"(?:(?<![0-9])[-+])?", r"(?:[.,]\d+)?"
_NUMBERS = {
    (sign, decimal): re.compile("(" + _SIGN * sign + r"\d+" + _POINT * decimal + ")")
    for sign in (False, True)
    for decimal in (False, True)
}
_LETTER = re.compile(r"(?<=\d)([a-z])$")  # 1001a, 1001b: slices between two numbers
_GAP = 1.5  # a step of more than this many usual steps lacks a number
_SHOWN = 5


@dataclass(frozen=True)
class NamedSeries:
    """Files of one series, in order, and what was decided about the order."""

    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """First and last name."""
        first, last = self.files[0].name, self.files[-1].name
        return first if first == last else f"{first} to {last}"


@dataclass(frozen=True)
class _Name:
    file: Path
    pattern: tuple[str, ...]  # what stands between the numbers, and the ending
    numbers: tuple[float, ...]
    letter: str


def named_series(files: Sequence[Path]) -> list[NamedSeries]:
    """The series of a folder, the one of most files first."""
    readings = {key: [_read(file, key) for file in files] for key in _NUMBERS}
    signs, decimals = min(readings, key=lambda key: (len({name.pattern for name in readings[key]}), key))
    if not decimals and _are_decimals(readings[signs, False], readings[signs, True]):
        decimals = True
    names = readings[signs, decimals]
    notes = _notes(names, signs, decimals, readings)
    groups: dict[tuple, list[_Name]] = {}
    for name in names:
        groups.setdefault(name.pattern, []).append(name)
    if 2 * len(groups) > len(names):
        groups = {(): names}
    series = [one for group in groups.values() for one in _divided(group, notes)]
    return sorted(series, key=lambda one: (-len(one.files), natural_key(one.files[0])))


def _read(file: Path, key: tuple[bool, bool]) -> _Name:
    stem, ending = file.stem.lower(), file.suffix.lower().replace(".tiff", ".tif")
    letter = _LETTER.search(stem)
    if letter:
        stem = stem[:-1]
    parts = _NUMBERS[key].split(stem)
    numbers = tuple(float(part.replace(",", ".")) for part in parts[1::2])
    return _Name(file, (*parts[::2], ending), numbers, letter.group(1) if letter else "")


def _are_decimals(whole: list[_Name], decimal: list[_Name]) -> bool:
    """Where every name has a point between numbers: 1.25 and 1.5, but not 1.1 to 1.10 (which are eleven apart)."""
    if not any(len(a.numbers) > len(b.numbers) for a, b in zip(whole, decimal)):
        return False
    alike = len({(name.pattern, name.numbers) for name in decimal}) < len({(n.pattern, n.numbers) for n in whole})
    return not alike


def _notes(names: list[_Name], signs: bool, decimals: bool, readings: dict) -> list[str]:
    notes = []
    if signs:
        notes.append("a dash before a number in the names is taken as a minus")
    elif any(number < 0 for name in readings[True, decimals] for number in name.numbers) and _unpadded(names):
        notes.append("the dash before the numbers in the names is taken as a dash, not as a minus")
    pointed = [name for name in names if re.search(r"\d[.,]\d", name.file.stem)]
    if pointed:
        taken = "as decimals" if decimals else "one by one, not as decimals"
        notes.append(f"numbers with a point in the names are taken {taken}")
    return notes


def _unpadded(names: list[_Name]) -> bool:
    """Whether no number after a dash is written with leading zeros, as positions are."""
    return not any(re.search(r"-0\d", name.file.stem) for name in names)


def _divided(names: list[_Name], notes: list[str]) -> list[NamedSeries]:
    """One series, or several where all combinations of two numbers are there (channels or time points of each slice)."""
    if len({name.pattern for name in names}) > 1 or not names[0].numbers:
        ordered = sorted(names, key=lambda name: natural_key(name.file))
        said = (
            [] if len(names) == 1 else ["the names do not differ in one number; they are taken in alphabetical order"]
        )
        return [_series(ordered, [*notes, *said])]
    table = np.array([name.numbers for name in names])
    varying = [column for column in range(table.shape[1]) if len(np.unique(table[:, column])) > 1]
    counts = [len(np.unique(table[:, column])) for column in varying]
    if len(varying) > 1 and max(counts) < len(names) == int(np.prod(counts, dtype=float)):
        along = varying[len(counts) - 1 - int(np.argmax(counts[::-1]))]  # the last of the longest
        others = [column for column in varying if column != along]
        groups: dict[tuple, list[_Name]] = {}
        for name in names:
            groups.setdefault(tuple(name.numbers[column] for column in others), []).append(name)
        return [_series(_sorted(groups[key]), [*notes, *_missing(groups[key], along)]) for key in sorted(groups)]
    if len(varying) < 2:
        return [_series(_sorted(names), [*notes, *(_missing(names, varying[0]) if varying else [])])]
    alone = [column for column, count in zip(varying, counts) if count == len(names)]
    if not alone:
        several = "several numbers of the names differ, and none of them alone tells the order; the first counts most"
        return [_series(_sorted(names), [*notes, several])]
    orders = {tuple(np.argsort(table[:, column])) for column in alone}
    doubt = ["two numbers of the names tell different orders; the first of them is taken"] if len(orders) > 1 else []
    return [_series(_sorted(names, alone[0]), [*notes, *doubt, *_missing(names, alone[0])])]


def _sorted(names: list[_Name], column: int | None = None) -> list[_Name]:
    """In the order of one number, or of all."""
    first = slice(None) if column is None else slice(column, column + 1)
    return sorted(names, key=lambda name: (name.numbers[first], name.letter, natural_key(name.file)))


def _series(names: list[_Name], notes: list[str]) -> NamedSeries:
    return NamedSeries(tuple(name.file for name in names), tuple(notes))


def _missing(names: list[_Name], column: int) -> list[str]:
    """The note on numbers that are not there, or there twice."""
    numbers = np.array(sorted(name.numbers[column] for name in names))
    steps = np.diff(numbers)
    notes = []
    if len({(name.numbers[column], name.letter) for name in names}) < len(names):
        notes.append("some numbers are there twice in the names")
    steps = steps[steps > 0]
    if len(steps) and steps.max() > _GAP * np.median(steps):
        unique = np.unique(numbers)
        usual = float(np.median(steps))
        after = [f"{unique[n]:g} to {unique[n + 1]:g}" for n in np.flatnonzero(np.diff(unique) > _GAP * usual)]
        more = ", ..." * (len(after) > _SHOWN)
        notes.append(
            f"numbers are missing in the names ({', '.join(after[:_SHOWN])}{more}, where {usual:g} apart is usual); slices "
            "beyond are drawn too close, give them or an empty picture in their place"
        )
    return notes
