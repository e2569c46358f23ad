"""Several volumes in one file or folder: which is read, how the others are named, and how to choose one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ..errors import InputError

_NAMED = 8  # volumes that a note names one by one


MAX_VOLUMES = 100_000  # in one file; a header that says more is damaged


@dataclass(frozen=True)
class Choice:
    """A volume that could be read.

    Attributes:
        label: what it is, without a patient's data.
        size: voxels along i, j, k.
        spacing_mm: along i, j, k; empty: not known.
        series: the same for what differs in time alone: the time points of one series.
    """

    label: str
    size: tuple[int, ...]
    spacing_mm: tuple[float, ...] = ()
    series: str = ""

    def text(self) -> str:
        """Size and label."""
        return f"{self.label} ({' x '.join(map(str, self.size))})"


def checked_count(count: int) -> int:
    """The number of volumes of a file, if it is one that can be meant.

    Raises:
        InputError: it is not.
    """
    if not 1 <= count <= MAX_VOLUMES:
        raise InputError(f"{count} volumes in one file; save one scalar volume of it in a file of its own")
    return count


def pick(choices: Sequence[Choice], number: int | None) -> int:
    """Index of the volume with that number, counted from 1 on; of the first where none is given.

    Raises:
        InputError: there is no such volume.
    """
    if number is None:
        return 0
    if isinstance(number, bool) or not isinstance(number, int) or not 1 <= number <= len(choices):
        there = "there is one volume" if len(choices) == 1 else f"there are volumes 1 to {len(choices)}"
        raise InputError(f"volume {number} is not there: {there}; `medcolor info` lists them")
    return number - 1


def time_points(choices: Sequence[Choice], number: int | None) -> list[int]:
    """Numbers of the volumes of that one's series, in the order of time; counted and chosen as in `pick`.

    Raises:
        InputError: there is no such volume, or it is the only one of its series.
    """
    chosen = choices[pick(choices, number)]
    found = [n for n, c in enumerate(choices, 1) if (c.series, c.size) == (chosen.series, chosen.size)]
    if len(found) < 2:
        raise InputError(f"{chosen.text()} has no other time points; `medcolor info` lists what there is")
    return found


def chosen_note(choices: Sequence[Choice], index: int, number: int | None) -> list[str]:
    """The note that names what was left out; none where there was no choice. The largest comes first."""
    if len(choices) < 2:
        return []
    others = [f"{n + 1}: {choice.text()}" for n, choice in enumerate(choices) if n != index]
    more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
    largest = "the first" if choices[0].size == choices[1].size else "the largest"
    reason = "as asked for" if number is not None else f"{largest} of {len(choices)} volumes"
    return [
        f"{choices[index].text()} was read, {reason}; left out: {'; '.join(others[:_NAMED])}{more} (choose with --volume N, "
        "`medcolor info` lists all)"
    ]
