"""Stage *paint*: matched slices, in the order of the stack, become pictures in the result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np

from ..device import Each
from ..scan.grid import from_grid
from ..scan.intensity import AS_SHOWN, Window
from .engine import Engine
from .prepare import Prepared

if TYPE_CHECKING:
    from ..coloring.transfer import SliceMatch, TransferParameters

_NOTHING = np.zeros((), np.float32)  # evidence of a group that a slice does not have


class PaintedMasks:
    """Looks like a stack of masks for reading, `masks[n]`: where a slice was coloured, nothing where it was not."""

    def __init__(self, prepared: Prepared, ks: Sequence[int], part: tuple[slice, slice] = (slice(None), slice(None))):
        """Args: ks: slices in the order asked for. part: rows and columns."""
        self._prepared, self._ks, self._part = prepared, ks, part
        self._chosen = frozenset(prepared.plan.slices)

    def __len__(self) -> int:
        return len(self._ks)

    def __getitem__(self, n: int) -> np.ndarray:
        k, view = self._ks[n], self._prepared.view
        if k not in self._chosen:
            return np.zeros(view[k].shape, bool)[self._part]
        return self._prepared.body.painted(k, view[k])[self._part]


class Painter:
    """Colours slices from their matches and, where matches are weighed, from the evidence of their neighbours, too."""

    def __init__(
        self,
        prepared: Prepared,
        engine: Engine,
        stack: np.ndarray | None,
        confidence: np.ndarray | None = None,
        each: Each = map,
    ) -> None:
        """Args:
        stack: (slice, row, col, 3) uint8 to be filled, in the order of the stack; None colours for nothing (a probe).
        confidence: (slice, row, col) uint8 to be filled with per cent, or None.
        each: how work on several slices is done that do not depend on each other; see `device.side_by_side`.
        """
        from ..coloring.coherence import SliceAverage, frames

        settings, plan = prepared.settings, prepared.plan
        self.clipped = self.bent = 0
        self.trusted: dict[int, float] = {}
        self.agreement: dict[int, float] = {}
        self.saturation: dict[int, float] = {}
        self.one_tissue: dict[int, float] = {}
        self._engine, self._stack, self._confidence, self._boxes = engine, stack, confidence, prepared.body.boxes
        self._weighs = settings.weighs_matches
        self._parameters = engine.transfer_parameters()
        spacing, sigma = prepared.slice_spacing_mm, settings.coherence_mm
        self._groups = prepared.groups
        names = (None,) if self._groups is None else range(len(self._groups))
        how = spacing, sigma, self._parameters, self._parameters_of
        self._evidence = {name: Evidence(plan.slices, *how) for name in names}
        self._means = SliceAverage(plan.slices, spacing, sigma)
        self._mean: dict[int, np.ndarray] = {}  # confidence and trusted fraction of a slice and its neighbours
        self.uncolored = 0
        chosen = list(plan.slices)
        self._frames = dict(zip(chosen, frames(self._boxes[chosen], spacing, sigma)))
        self._region = prepared.region[1:]
        self._last, self._each = None, each
        self._passing = (
            None if self._weighs else PassingColors(engine.choice, plan.slices, spacing, sigma, prepared.window)
        )

    def add(self, ks: Sequence[int], matches) -> None:
        """Colour what can be coloured now that slices `ks` are matched; None: the same match as the slice before."""
        from ..coloring.transfer import SliceMatch

        if matches is not None:
            self._last = [(grey, mask, lab, trust) for grey, mask, lab, trust in zip(*matches)]
        found = {}
        for n, k in enumerate(ks):
            grey, mask, lab, trust = self._last[n] if matches is not None else self._last[-1]
            if trust is not None:
                self.trusted[k], self.agreement[k] = round(trust.trusted_fraction, 4), round(trust.agreement, 4)
                self._put_confidence(k, trust)
            found[k] = SliceMatch(lab, grey, mask, trust, self._frames[k])
        colored = self._gathered(found) if self._passing is None else self._passed(found, self._passing)
        for k, rgb, clipped, bent, uncolored in colored:
            self.clipped += clipped
            self.bent += bent
            self.uncolored += uncolored
            self._paste(self._stack, k, rgb)

    def _gathered(self, found: dict[int, SliceMatch]) -> Iterator[tuple[int, np.ndarray, int, int, int]]:
        """Add slices' evidence to what is known of colour and grey; slices whose neighbours are all in are coloured."""
        from ..matching.confidence import saturation

        for k, match in found.items():
            self._mean.update(self._means.push(k, np.float64([match.trust.mean, match.trust.trusted_fraction])))
        by_group = [self._by_group(k, match) for k, match in found.items()]
        streams = [
            evidence.add(dict(zip(found, own)), self._each)
            for evidence, own in zip(self._evidence.values(), zip(*by_group))
        ]
        ready = list(zip_longest(*streams))  # all have the same slices ready
        for (k, *_), *_others in ready:
            self.saturation[k] = saturation(self._mean[k][0])
            self.one_tissue[k] = round(self._parameters_of(k).one_tissue, 4)
        return self._each(self._color, ready)

    def _parameters_of(self, k: int) -> TransferParameters:
        """Those of a slice whose neighbours' matches are known."""
        return self._engine.transfer_parameters(trusted_fraction=float(self._mean[k][1]))

    def _passed(self, found: dict[int, SliceMatch], passing: PassingColors) -> Iterator:
        """Colour slices by themselves, but for what passes between references."""
        ready = dict(passing.add(found))
        return self._each(self._color_alone, ready, ready.values())

    def _by_group(self, k: int, match: SliceMatch) -> list[tuple[SliceMatch, bool]]:
        """The slice's match for each group, with nothing outside it, and whether the slice has that group at all."""
        if self._groups is None:
            return [(match, True)]
        on_grid, there = self._engine.groups_on_grid([k])[0], np.unique(self._groups.in_box(k, self._boxes[k]))
        return [(replace(match, mask=match.mask & (on_grid == name)), name in there) for name in self._evidence]

    def _color(
        self, ready: Sequence[tuple[int, np.ndarray | None, np.ndarray]]
    ) -> tuple[int, np.ndarray, int, int, int]:
        """Colour a slice from its evidence, of everything or group by group.

        Returns:
            Slice, what `transfer.to_picture` returns, number of pixels without any evidence.
        """
        from ..coloring.transfer import combine, to_picture

        k = ready[0][0]
        grey, mask = self._engine.slice_in_box(k)[0], self._engine.painted_in_box(k)
        kept, parameters = self.saturation[k], self._parameters_of(k)
        groups = None if self._groups is None else self._groups.in_box(k, self._boxes[k])
        colors, uncolored = np.zeros((np.count_nonzero(mask), 3)), 0
        for name, (_, relation, rest) in zip(self._evidence, ready):
            own = mask if groups is None else mask & (groups == name)
            if groups is not None and not own.any():
                continue
            found = combine(grey, own, relation, rest, parameters, self._frames[k], kept)
            if groups is None:
                colors = found
                continue
            colors[own[mask]] = found
            if not rest[..., -1].any():
                uncolored += int(np.count_nonzero(own))
        return k, *to_picture(colors, mask), uncolored

    def _color_alone(self, k: int, match: SliceMatch) -> tuple[int, np.ndarray, int, int, int]:
        """`_color` from the slice's own match."""
        from ..coloring.transfer import transfer

        grey, mask = self._engine.slice_in_box(k)[0], self._engine.painted_in_box(k)
        return k, *transfer(grey, mask, match, self._parameters), 0

    def _put_confidence(self, k: int, trust) -> None:
        if self._confidence is not None:
            j0, j1, i0, i1 = self._boxes[k]
            share = from_grid(trust.share, (j1 - j0, i1 - i0)) * self._engine.painted_in_box(k)
            self._paste(self._confidence, k, np.rint(100 * share).astype(np.uint8))

    def _paste(self, stack: np.ndarray | None, k: int, values: np.ndarray) -> None:
        if stack is None:
            return
        j0, j1, i0, i1 = self._boxes[k]
        (row0, row1), (col0, col1) = self._region
        top, bottom, left, right = max(j0, row0), min(j1, row1), max(i0, col0), min(i1, col1)
        if top < bottom and left < right:
            stack[k, top:bottom, left:right] = values[top - j0 : bottom - j0, left - i0 : right - i0]


class PassingColors:
    """Matched colours T', averaged along the stack near changes of reference: for smoothers that share no evidence.

    There a pixel of the body goes towards the mean of the same place in the slices around, each counting by distance and by
    how alike the greys are. All other slices go through as they are.
    """

    def __init__(
        self,
        choice: Mapping[int, int],
        slices: Sequence[int],
        spacing_mm: float,
        sigma_mm: float,
        window: Window = AS_SHOWN,
    ) -> None:
        """Args:
        choice: slice -> index of its reference, of these slices at least. window: of the scan, whose tones the greys are.
        Others as for `coherence.SliceAverage`."""
        from ..coloring.coherence import SliceAverage, shares_near_changes

        self._shares = shares_near_changes({k: choice[k] for k in slices}, spacing_mm, sigma_mm)
        self._colors = SliceAverage(list(self._shares), spacing_mm, sigma_mm)
        self._waiting: dict[int, SliceMatch] = {}
        self._window = window

    def add(self, found: dict[int, SliceMatch]) -> Iterator[tuple[int, SliceMatch]]:
        """Add slices, in order; yields (slice, its match) for each that can be coloured now."""
        for k, match in found.items():
            if k not in self._shares:
                yield k, match
                continue
            self._waiting[k] = match
            weight = match.mask[..., None].astype(np.float32)
            witnesses = np.concatenate([match.lab * weight, weight], -1)
            for ready, total in self._colors.push(k, witnesses, 255 * self._window.shown(match.grey)):
                own = self._waiting.pop(ready)
                mean = total[..., :-1] / np.maximum(total[..., -1:], 1e-6)
                share = np.float32(self._shares[ready]) * own.mask[..., None]
                yield ready, replace(own, lab=own.lab + share * (mean - own.lab))


class Evidence:
    """What matches say of colour, all or those of one tissue group, averaged along the stack."""

    def __init__(
        self,
        slices: Sequence[int],
        spacing_mm: float,
        sigma_mm: float,
        parameters: TransferParameters,
        parameters_of: Callable[[int], TransferParameters],
    ) -> None:
        """Args: as for `coherence.SliceAverage` and `transfer`; parameters_of: of a slice whose relation is due."""
        from ..coloring.coherence import SliceAverage

        self._relations, self._remainders = (SliceAverage(slices, spacing_mm, sigma_mm) for _ in range(2))
        self._parameters, self._parameters_of = parameters, parameters_of
        self._waiting: dict[int, tuple[SliceMatch, bool]] = {}
        self._known: dict[int, np.ndarray | None] = {}

    def add(
        self, matches: dict[int, tuple[SliceMatch, bool]], each: Each
    ) -> list[tuple[int, np.ndarray | None, np.ndarray]]:
        """Add slices; returns (slice, relation, remainder) as `transfer.combine` takes them, for each that is complete now.

        Args:
            matches: slice -> its match, and whether it has the group; without it, it adds nothing, and what is returned for
                it is not to be used.
        """
        self._waiting.update(matches)
        if self._parameters.smoother == "regression":
            sums = zip(matches, each(self._sums, matches.values()))
            due = [found for k, own in sums for found in self._relations.push(k, own)]
            relations = zip((k for k, _ in due), each(self._relation, due))
        else:
            relations = [(k, None) for k in matches]
        complete = []
        for k, relation, rest, guide in each(self._remainder, relations):
            self._known[k] = relation
            for ready, total in self._remainders.push(k, rest, guide):
                complete.append((ready, self._known.pop(ready), total))
        return complete

    def _sums(self, match: tuple[SliceMatch, bool]) -> np.ndarray:
        from ..coloring.transfer import relation_sums

        own, there = match
        return relation_sums(own, self._parameters) if there else _NOTHING

    def _relation(self, due: tuple[int, np.ndarray]) -> np.ndarray | None:
        from ..coloring.transfer import solve_relation

        k, total = due
        return solve_relation(total, self._parameters_of(k)) if self._waiting[k][1] else None

    def _remainder(
        self, solved: tuple[int, np.ndarray | None]
    ) -> tuple[int, np.ndarray | None, np.ndarray, np.ndarray]:
        """What is averaged along the stack in its turn: slice, relation, remainder, guide."""
        from ..coloring.transfer import remainder, remainder_guide

        k, relation = solved
        match, there = self._waiting.pop(k)
        rest = remainder(match, relation, self._parameters) if there else _NOTHING
        return k, relation, rest, remainder_guide(match, self._parameters)
