"""Time points of one series: where two show nearly the same, the matches of one serve both.

Matches say which part of the photograph lies where. They are as coarse as the positions that are matched, 4 x 4 pixels of the
raster: while each position shows the same tissue, matching again finds the same, less surely. Colour is then made anew from
the time point's own grey and those matches. How alike two time points are is measured where it matters: on the raster,
position by position, in the block that changes most, for a beating heart is small in a chest that lies still.

The bound was found with a heart that beats in an MR and a CT chest, and a head that is bent, by 1 to 16 pixels, with and
without noise: from SAME on, the colours were no further from those that move with the tissue (of the first time point, moved as
the scan was) than matched anew: in the heart 0.5 to 1.7 CIEDE2000 instead of 0.7 to 1.7. Far below it they were: at a likeness
of 0.5, 2.2 instead of 1.8.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import InputError
from ..matching.tissue_guard import Guard
from ..parameters import Settings
from ..plan import LeftOut
from ..progress import Progress, Run, check
from ..scan.grid import MARGIN
from ..scan.slices import sample_slices, slice_on_grid
from ..volume import Volume
from .prepare import Prepared, prepare

if TYPE_CHECKING:
    from ..device import Each
    from ..matching.analogy import Match
    from .engine import Engine

log = logging.getLogger("MedColorLib")

_COST = "none beside that of matching anew, with a heart that beats and a head that is bent"
SAME = 0.85  # likeness from which matches are shared
CELL_PX = 4  # of the raster: a position of layer 3, whose matches colour is made of
BLOCKS = 8  # along each side of the body's box
LEAST_COVER = 0.2  # of a block by the body: less is its outline
SEEN_SLICES = 24  # that are compared


class Seen(NamedTuple):
    """Some slices of a time point, (slice, row, column) of positions: grey, black outside the body, and cover by it, 0..1."""

    grey: np.ndarray
    cover: np.ndarray


class KeptMatches:
    """Matches in memory, slice by slice, as `resume.RunStore` keeps them on disk."""

    resumed_slices, key, problem = 0, None, None  # of no interrupted run
    by_batch = False

    def __init__(self) -> None:
        self._found: dict[tuple[int, int], Match] = {}

    def load(self, slices: Sequence[int], reference: int, device: str) -> Match | None:
        """The match of these slices with a reference, or None where one of them is missing."""
        from ..matching.analogy import joined

        found = [self._found.get((k, reference)) for k in slices]
        return None if None in found else joined(found)

    def save(self, slices: Sequence[int], reference: int, match: Match) -> None:
        """Keep a match; one that is there stays, as that of an earlier time point."""
        for k, part in zip(slices, match.parts()):
            self._found.setdefault((k, reference), part)


class Series:
    """The time points made ready, and for each of them whose matches it takes."""

    def __init__(
        self, volumes: Sequence[Volume], references: Sequence, settings: Settings, guard: Guard | None, run: Run
    ):
        """Args as for `pipeline.colorize_time_points`."""
        _check_grids(volumes)
        self.prepared: list[Prepared] = []
        for n, volume in enumerate(volumes):
            run.step(0.0, f"preparing time point {n + 1} of {len(volumes)}")
            loaded = self.prepared[0].references if self.prepared else None
            self.prepared.append(prepare(volume, references, settings, guard=guard, loaded=loaded))
        self.likeness: list[float | None] = []
        self.source = self._sources()
        self._stores: dict[int, KeptMatches] = {}
        self._engines: dict[int, Engine] = {}

    def __len__(self) -> int:
        return len(self.prepared)

    def matches_for(self, n: int) -> tuple[KeptMatches, Engine | None]:
        """Where the matches of time point n are kept, and the engine that has made them, if one has."""
        source = self.source[n]
        return self._stores.setdefault(source, KeptMatches()), self._engines.get(source)

    def keep(self, n: int, engine: Engine) -> None:
        """Time point n is coloured; what no later one takes is forgotten."""
        source = self.source[n]
        if source in self.source[n + 1 :]:
            self._engines.setdefault(source, engine)
        else:
            self._stores.pop(source)
            self._engines.pop(source, None)

    def say(self, n: int) -> dict:
        """What was decided for time point n, for its report; said in its plan and in the log, too."""
        source, like, plan = self.source[n], self.likeness[n], self.prepared[n].plan
        text = "matched by itself"
        if like is not None:
            text += (
                f" (likeness to the most similar of those before {like:.2f}; {SAME:g} is needed to take its matches)"
            )
        if source != n:
            text = f"takes the matches of time point {source + 1} (likeness {like:.2f})"
            why = f"it shows nearly the same as time point {source + 1} (likeness {like:.2f}), whose matches are taken"
            plan.left_out.append(LeftOut("matching of this time point", why, "network, contrast and matching", _COST))
        if len(self) > 1:
            plan.steps["time point"] = f"{n + 1} of {len(self)}, {text}"
            log.info("time point %d of %d: %s", n + 1, len(self), text)
        likeness_of = None if like is None else round(like, 4)
        return {"number": n + 1, "of": len(self), "matches_of": source + 1, "likeness": likeness_of}

    def _sources(self) -> list[int]:
        """For each time point the earlier one whose matches it takes, or itself."""
        common = sorted(set.intersection(*(set(p.plan.slices) for p in self.prepared)))
        seen = [_seen(p, sample_slices(common, SEEN_SLICES)) for p in self.prepared] if common else []
        sources: list[int] = []
        for n in range(len(self)):
            alike = {m: likeness(seen[m], seen[n]) for m in dict.fromkeys(sources)} if common else {}
            best = max(alike, key=alike.get, default=n)
            self.likeness.append(alike.get(best))
            sources.append(best if alike.get(best, 0.0) >= SAME else n)
        return sources


def taken_over(engine: Engine, prepared: Prepared, run: Run, each: Each) -> Engine:
    """The engine of a time point that takes the matches of another one: only its slices are its own.

    What was learned of the references stays, and what lies in the store is taken up.
    """
    other, known = copy(engine), np.array(sorted(engine.choice))
    other.prepared, other.run, other.each = prepared, run, each
    other.unmatched, other._ahead, other._found = {}, {}, {}
    nearest = {k: int(known[np.abs(known - k).argmin()]) for k in prepared.plan.slices}
    other.choice = {k: engine.choice[near] for k, near in nearest.items()}
    return other


def share_of(progress: Progress | None, number: int, count: int) -> Progress | None:
    """What one time point reports as part of all."""
    if progress is None or count == 1:
        return progress
    return lambda fraction, text="": progress(
        (number + fraction) / count, f"time point {number + 1} of {count}: {text}"
    )


def likeness(first: Seen, second: Seen) -> float:
    """How alike two time points are: 1 (the same) downwards.

    Returns:
        1 less the mean squared difference of grey in the block that changes most, as a share of twice the variance in its
        slice's body, both brought to one mean and spread: the correlation, were that block all. A gain or an offset between
        the two is no change.
    """
    return 1.0 - max(_change(*both) for both in zip(*first, *second))


def _seen(prepared: Prepared, slices: Sequence[int]) -> Seen:
    """Means over each position of some slices."""
    found = []
    for k in slices:
        check()
        grey, mask = slice_on_grid(prepared.view, prepared.body, prepared.window, prepared.grid, k)
        found.append([_in_cells(values[MARGIN:-MARGIN, MARGIN:-MARGIN]) for values in (grey, mask)])
    grey, cover = zip(*found)
    return Seen(np.stack(grey), np.stack(cover))


def _in_cells(values: np.ndarray) -> np.ndarray:
    """Means over CELL_PX x CELL_PX pixels."""
    rows, cols = (n // CELL_PX for n in values.shape)
    return values[: rows * CELL_PX, : cols * CELL_PX].reshape(rows, CELL_PX, cols, CELL_PX).mean(axis=(1, 3))


def _change(grey: np.ndarray, cover: np.ndarray, other: np.ndarray, other_cover: np.ndarray) -> float:
    """0 (nothing changes) upwards, in the block that changes most; positions (row, column) of one slice."""
    both, either = np.minimum(cover, other_cover), np.maximum(cover, other_cover)
    if both.sum() < 1:
        return float(either.sum() >= 1)
    difference = (_standardised(grey, both) - _standardised(other, both)) ** 2 * either
    changed, inside = _in_blocks(difference), _in_blocks(either)
    counts = inside >= LEAST_COVER
    return float((changed[counts] / inside[counts]).max() / 2) if counts.any() else 0.0


def _standardised(grey: np.ndarray, weights: np.ndarray) -> np.ndarray:
    mean = np.average(grey, weights=weights)
    return (grey - mean) / max(np.sqrt(np.average((grey - mean) ** 2, weights=weights)), 1e-6)


def _in_blocks(values: np.ndarray) -> np.ndarray:
    """(BLOCKS, BLOCKS) means of parts of a slice."""
    parts = [np.array_split(part, BLOCKS, axis=1) for part in np.array_split(values, BLOCKS, axis=0)]
    return np.array([[part.mean() for part in row] for row in parts])


def _check_grids(volumes: Sequence[Volume]) -> None:
    if not volumes:
        raise InputError("time points: there is no volume; give at least one")
    first = volumes[0]
    for n, volume in enumerate(volumes):
        if volume.array.shape != first.array.shape or not np.allclose(volume.ijk_to_ras, first.ijk_to_ras, atol=1e-3):
            raise InputError(
                f"time points: {volume.name} (number {n + 1}) lies on another grid than {first.name}; colour volumes of "
                "several grids one by one"
            )
