"""Frames to volumes: each of one series, grid, contrast, acquisition and time point.

Frames are first put together by series, size, orientation and pixel size. Such a set is split where a trait of the header
tells apart images that lie at one place, or stacks that lie in each other. Nothing is split by what differs from slice to
slice of one volume (times of slices, numbers of acquisitions).
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..errors import InputError
from .dicom_header import Frame
from .dicom_pixels import values
from .dicom_strays import EVEN, is_even, strays
from .dicom_traits import CONTRASTS, HIDDEN, TIME_POINTS, TIMES, TRAITS

_SAME_DIRECTION = 1e-3  # distance of the direction cosines; headers round them to about 1e-6
_SAME_SPACING = 1e-3  # relative
_SAME_PLACE = 0.01  # of the smaller pixel edge
_MIN_STACK = 4  # series of one image each that are put together where their numbers differ


@dataclass(frozen=True)
class Stack:
    """Frames of one volume, in the order of their places.

    Attributes:
        said: trait -> its value in words, of the traits that tell this volume from its neighbours.
        rank: orders the volumes of a set.
        notes: what was decided about its frames.
        untold: nothing in the headers tells its frames from others at their places.
    """

    frames: tuple[Frame, ...]
    said: dict[str, str] = field(default_factory=dict)
    rank: tuple = ()
    notes: tuple[str, ...] = ()
    untold: bool = False

    @property
    def label(self) -> str:
        """Modality, series number and the traits that matter."""
        return ", ".join([self.frames[0].label, *(_phrase(name, value) for name, value in self.said.items())])

    @property
    def series(self) -> str:
        """The same for the time points of one series, and for nothing else."""
        same = [f"{name} {value}" for name, value in self.said.items() if name not in TIME_POINTS]
        return ", ".join([str(self.frames[0].series), *same])

    @property
    def size(self) -> tuple[int, int, int]:
        """Columns, rows, slices."""
        return (*self.frames[0].size, len(self.frames))


def find_stacks(frames: Sequence[Frame]) -> list[Stack]:
    """All volumes, the largest first; of equal ones the first echo, time point and so on first."""
    unique, copies = _without_copies(frames)
    series = {name: n for n, name in enumerate(dict.fromkeys(frame.series for frame in unique))}
    stacks = []
    for members, notes in sorted(_sets(unique), key=lambda s: (series[s[0][0].series], min(f.instance for f in s[0]))):
        ordered = sorted(members, key=lambda frame: (place_of(frame), frame.instance, frame.number))
        said = {"image type": "LOCALIZER"} if _is_localizer(ordered[0]) else {}
        stacks += [replace(stack, notes=(*notes, *stack.notes)) for stack in _split(Stack(tuple(ordered), said))]
    stacks = _named_apart(stacks)
    if copies:
        said = f"{copies} images were there twice (the same instance); one of each was taken"
        stacks = [replace(stack, notes=(*stack.notes, said)) for stack in stacks]
    return sorted(stacks, key=lambda stack: (-len(stack.frames), -math.prod(stack.size)))


def _named_apart(stacks: list[Stack]) -> list[Stack]:
    """Volumes that would be called the same (files of many frames of one series) get the trait that tells them apart."""
    alike: dict[str, list[Stack]] = {}
    for stack in stacks:
        alike.setdefault(stack.label + str(stack.size), []).append(stack)
    named = []
    for stack in stacks:
        others = alike[stack.label + str(stack.size)]
        named.append(replace(stack, said={**stack.said, **_apart(stack, others)}) if len(others) > 1 else stack)
    return named


def _apart(stack: Stack, others: list[Stack]) -> dict[str, str]:
    """What tells a volume from others of its name: the plane, a trait, the pixels, or its number among them."""
    firsts = [other.frames[0] for other in others]
    first = stack.frames[0]
    if len({_plane(frame) for frame in firsts}) == len(firsts):
        return {"plane": _plane(first)}
    for name in TRAITS:
        if name not in HIDDEN and len({frame.traits.get(name) for frame in firsts}) == len(firsts):
            return {name: _words(first.traits.get(name))}
    if len({frame.spacing_mm for frame in firsts}) == len(firsts):
        return {"pixels of (mm)": " x ".join(f"{edge:.4g}" for edge in first.spacing_mm or (1.0, 1.0))}
    return {"no.": f"{others.index(stack) + 1} of {len(others)}"}


def _plane(frame: Frame) -> str:
    """Transverse, coronal or sagittal, after the axis that the normal is nearest to."""
    if not frame.axes:
        return "unknown"
    normal = np.abs(np.cross(frame.axes[:3], frame.axes[3:]))
    return ("sagittal", "coronal", "transverse")[int(np.argmax(normal))]


def height_of(frame: Frame) -> float:
    """Millimetres along the normal."""
    normal = np.cross(frame.axes[:3], frame.axes[3:])
    return float(np.dot(frame.position_mm, normal / np.linalg.norm(normal)))


def has_place(frame: Frame) -> bool:
    """Whether the header says where the frame lies."""
    return bool(frame.position_mm and frame.axes)


def place_of(frame: Frame) -> float:
    """What orders the frames of a volume: millimetres along the normal, or a number where there is no position."""
    return height_of(frame) if has_place(frame) else frame.place


def _without_copies(frames: Sequence[Frame]) -> tuple[list[Frame], int]:
    kept: dict[tuple, Frame] = {}
    for frame in frames:
        kept.setdefault((frame.image, frame.number), frame)
    return list(kept.values()), len(frames) - len(kept)


def _sets(frames: Sequence[Frame]) -> list[tuple[list[Frame], tuple[str, ...]]]:
    """Sets of frames of one series and grid, with notes."""
    sets: dict[tuple, list[list[Frame]]] = {}
    for frame in frames:
        kind = (frame.pixels is None, frame.tiles > 1, has_place(frame), _is_localizer(frame))
        key = (frame.series, frame.size, frame.whole, kind)
        for members in sets.setdefault(key, []):
            if _same_grid(members[0], frame):
                members.append(frame)
                break
        else:
            sets[key].append([frame])
    found = [members for group in sets.values() for members in group]
    series = Counter(members[0].series for members in found)
    single = [members[0] for members in found if len(members) == 1 and series[members[0].series] == 1]
    joined = _joined([frame for frame in single if has_place(frame) and frame.pixels and not frame.whole])
    taken = {id(frame) for members in joined for frame in members}
    note = "every slice has a series of its own; slices of one grid at different places were put together"
    return [(m, ()) for m in found if id(m[0]) not in taken] + [(m, (note,)) for m in joined]


def _joined(frames: list[Frame]) -> list[list[Frame]]:
    """Series of one image each that make a stack: of one number, or evenly spaced."""
    sets: list[list[Frame]] = []
    for frame in frames:
        for members in sets:
            first = members[0]
            same = (first.size, first.modality, first.series_number) == (
                frame.size,
                frame.modality,
                frame.series_number,
            )
            if same and _same_grid(first, frame):
                members.append(frame)
                break
        else:
            sets.append([frame])
    whole = [members for members in sets if len(members) > 1]
    rest = [members[0] for members in sets if len(members) == 1]
    loose: dict[tuple, list[Frame]] = {}
    for frame in rest:
        loose.setdefault((frame.size, frame.modality, tuple(np.round(frame.axes, 3)), frame.spacing_mm), []).append(
            frame
        )
    return whole + [m for m in loose.values() if len(m) >= _MIN_STACK and is_even(sorted(map(height_of, m)))]


def _is_localizer(frame: Frame) -> bool:
    """A picture for planning, which scanners store in the series that they plan with it."""
    return "LOCALIZER" in str(frame.traits.get("image type")).upper()


def _same_grid(a: Frame, b: Frame) -> bool:
    if (a.spacing_mm is None) != (b.spacing_mm is None) or bool(a.axes) != bool(b.axes):
        return False
    turned = bool(a.axes) and math.dist(a.axes, b.axes) >= _SAME_DIRECTION
    if a.spacing_mm is None or b.spacing_mm is None:
        return not turned
    closest = min(*a.spacing_mm, *b.spacing_mm)
    return not turned and math.dist(a.spacing_mm, b.spacing_mm) <= _SAME_SPACING * closest


# --- splitting ------------------------------------------------------------------------------------------------------


def _split(stack: Stack) -> list[Stack]:
    """The volumes of a set whose frames are in order."""
    places = _places(stack.frames)
    if len(places) < len(stack.frames) and (single := _without_equals(places)):
        note = f"{len(stack.frames) - len(single)} images were there twice under other names; one of each was taken"
        return _split(replace(stack, frames=tuple(single), notes=(*stack.notes, note)))
    crowded = len(places) < len(stack.frames)
    names = [*TRAITS, *sorted({name for frame in stack.frames for name in frame.traits} - {*TRAITS})]
    for name in names:
        if name in stack.said or len(parts := _parts(stack.frames, name)) < 2:
            continue
        if _tells_apart(name, parts, places, crowded):
            values = sorted(parts, key=_order)
            divided = (_part(stack, name, number, values, parts) for number in range(len(values)))
            return [small for part in divided for small in _split(part)]
    if crowded:
        return _by_rank(stack, places)
    return [part for one in _without_strays(stack) for part in _by_runs(one)]


def _without_strays(stack: Stack) -> list[Stack]:
    """The volume, and single images that are none of its slices."""
    found, said = strays([place_of(frame) for frame in stack.frames]) if has_place(stack.frames[0]) else ([], "")
    if not found:
        return [stack]
    rest = tuple(frame for number, frame in enumerate(stack.frames) if number not in found)
    alone = [replace(stack, frames=(stack.frames[number],), rank=(*stack.rank, 1)) for number in found]
    return [replace(stack, frames=rest, rank=(*stack.rank, 0), notes=(*stack.notes, said)), *alone]


def _by_runs(stack: Stack) -> list[Stack]:
    """Stacks that lie in each other and are told apart by nothing but their numbers, which run through one and the next.

    Such runs are one volume (every other slice was taken first) unless the slices would overlap.
    """
    frames = sorted(stack.frames, key=lambda frame: frame.instance)
    heights = [place_of(frame) for frame in frames]
    thickness = frames[0].traits.get("slice thickness (mm)")
    runs: list[list[Frame]] = []
    for number, frame in enumerate(frames):
        turned = (
            number > 1 and (heights[number] - heights[number - 1]) * (heights[number - 1] - heights[number - 2]) < 0
        )
        if not runs or (turned and len(runs[-1]) > 1):
            runs.append([])
        runs[-1].append(frame)
    steps = np.diff(sorted(heights))
    if (
        not 2 <= len(runs) <= len(frames) // 2
        or not isinstance(thickness, float)
        or np.median(steps) > 0.75 * thickness
    ):
        return [stack]
    parts = [sorted(map(place_of, run)) for run in runs]
    if not all(map(is_even, parts)) or not all(a[0] < b[-1] and b[0] < a[-1] for a, b in zip(parts, parts[1:])):
        return [stack]
    note = "stacks that lie in each other are told apart by their numbers alone"
    return [
        Stack(
            tuple(sorted(run, key=place_of)),
            {**stack.said, "stack": f"{number + 1} of {len(runs)}"},
            (*stack.rank, number),
            (*stack.notes, note),
        )
        for number, run in enumerate(runs)
    ]


def _without_equals(places: list[list[Frame]]) -> list[Frame]:
    """The frames without those that are like another at their place in number, traits and pixels; empty: there are none."""
    kept: list[Frame] = []
    for place in places:
        seen: dict[tuple, list[bytes]] = {}
        for frame in place:
            key = (frame.instance, frame.number, str(frame.traits), frame.rescale)
            if sum((one.instance, one.number) == key[:2] for one in place) > 1:
                pixels = _pixels(frame)
                if pixels in seen.setdefault(key, []):
                    continue
                seen[key].append(pixels)
            kept.append(frame)
    return [] if len(kept) == sum(map(len, places)) else kept


def _pixels(frame: Frame) -> bytes:
    """What tells the pixels of a frame from others; by its name where they cannot be read."""
    if frame.pixels is None:
        return str(frame.path).encode("utf-8", "surrogateescape")
    try:
        return hashlib.sha256(values(frame, np.dtype(np.float64)).tobytes()).digest()
    except InputError:
        return str(frame.path).encode("utf-8", "surrogateescape")


def _part(stack: Stack, name: str, number: int, values: list, parts: dict[Any, list[Frame]]) -> Stack:
    value = f"{number + 1} of {len(values)}" if name in HIDDEN or values[number] is None else _words(values[number])
    return Stack(tuple(parts[values[number]]), {**stack.said, name: value}, (*stack.rank, number), stack.notes)


def _places(frames: Sequence[Frame]) -> list[list[Frame]]:
    """Frames, in order, put together where they lie at one place."""
    first = frames[0]
    tolerance = max(_SAME_PLACE * min(first.spacing_mm or (1.0,)), EVEN * first.thickness_mm)
    places: list[list[Frame]] = []
    for frame in frames:
        if places and place_of(frame) - place_of(places[-1][0]) <= tolerance:
            places[-1].append(frame)
        else:
            places.append([frame])
    return places


def _parts(frames: Sequence[Frame], name: str) -> dict[Any, list[Frame]]:
    parts: dict[Any, list[Frame]] = {}
    for frame in frames:
        parts.setdefault(frame.traits.get(name), []).append(frame)
    return parts


def _tells_apart(name: str, parts: dict[Any, list[Frame]], places: list[list[Frame]], crowded: bool) -> bool:
    """Whether a trait divides the set into volumes."""
    covered = max(len(_places(part)) for part in parts.values())
    if crowded and any(len({frame.traits.get(name) for frame in place}) > 1 for place in places):
        return 2 * covered >= len(places)  # else it differs from slice to slice
    if min(map(len, parts.values())) < 2:
        return False
    if name in CONTRASTS:
        return True
    return not crowded and _interleaved(name, [[*map(place_of, part)] for part in parts.values()], parts)


def _interleaved(name: str, heights: list[list[float]], parts: dict[Any, list[Frame]]) -> bool:
    """Whether even stacks lie in each other, and are not the halves of one that was taken every other slice first."""
    heights = [sorted(part) for part in heights]
    ranges = sorted((part[0], part[-1]) for part in heights)
    overlap = any(low < ranges[n][1] for n, (low, _) in enumerate(ranges[1:]))
    if not overlap or not all(map(is_even, heights)):
        return False
    if name not in TIMES:
        return True
    frames = sorted((frame for part in parts.values() for frame in part), key=place_of)
    numbers = np.diff([frame.instance for frame in frames])
    if not (np.all(numbers > 0) or np.all(numbers < 0)):
        return True  # numbered stack by stack
    step = max(float(np.median(np.diff(part))) for part in heights)
    thickness = frames[0].traits.get("slice thickness (mm)")
    return isinstance(thickness, float) and step <= 1.1 * thickness


def _by_rank(stack: Stack, places: list[list[Frame]]) -> list[Stack]:
    """The first frame at every place, the second, and so on, in the order of their times and numbers."""
    keys: list[Callable[[Frame], Any]] = [
        lambda frame: _order(frame.traits.get("time point")),
        lambda frame: _order(frame.traits.get("trigger time (ms)")),
        lambda frame: _order(frame.traits.get("acquisition time")),
        lambda frame: _order(frame.traits.get("content time")),
        lambda frame: (frame.instance, frame.number),
    ]
    volumes: list[list[Frame]] = [[] for _ in range(max(map(len, places)))]
    told = True
    for place in places:
        ranked = sorted(place, key=lambda frame: tuple(key(frame) for key in keys))
        told &= len({tuple(key(frame) for key in keys) for frame in place}) == len(place)
        for number, frame in enumerate(ranked):
            volumes[number].append(frame)
    note = "images at one place are told apart by their times and numbers alone"
    return [
        Stack(
            tuple(frames),
            {**stack.said, "image": f"{number + 1} of {len(volumes)} at its place"},
            (*stack.rank, number),
            (*stack.notes, note),
            untold=not told,
        )
        for number, frames in enumerate(volumes)
    ]


def _order(value) -> tuple:
    """Sort key for values of any kind: magnitude before phase, originals before what was derived, nothing last."""
    if value is None:
        return (3,)
    if isinstance(value, tuple):
        tokens = {str(part).upper() for part in value}
        return (
            2,
            "DERIVED" in tokens,
            bool({"P", "R", "I", "PHASE", "PHASE MAP", "REAL", "IMAGINARY"} & tokens),
            str(value),
        )
    return (0, value) if isinstance(value, (float, int)) else (1, str(value))


def _phrase(name: str, value: str) -> str:
    """'echo time (ms)', '10' -> 'echo time 10 ms'."""
    words, _, unit = name.partition(" (")
    return f"{words} {value} {unit.rstrip(')')}".rstrip()


def _words(value) -> str:
    if isinstance(value, tuple):
        return "/".join(map(_words, value))
    return f"{value:g}" if isinstance(value, (int, float)) else str(value)
