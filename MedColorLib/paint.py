"""Stage *paint*: matched slices, in the order of the stack, become pictures in the result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np

from .engine import Engine
from .grid import from_grid
from .prepare import Prepared

if TYPE_CHECKING:
    from .transfer import SliceMatch, TransferParameters

_NOTHING = np.zeros((), np.float32)  # evidence of a group that a slice does not have


class Painter:
    """Colours slices from their matches and, where matches are weighed, from the evidence of their neighbours, too."""

    def __init__(
        self, prepared: Prepared, engine: Engine, stack: np.ndarray | None, confidence: np.ndarray | None = None
    ) -> None:
        """Args:
        stack: (slice, row, col, 3) uint8 to be filled, in the order of the stack; None colours for nothing (a probe).
        confidence: (slice, row, col) uint8 to be filled with per cent, or None.
        """
        from .coherence import SliceAverage, frames
        from .transfer import TransferParameters

        settings, plan = prepared.settings, prepared.plan
        self.clipped = 0
        self.trusted: dict[int, float] = {}
        self.agreement: dict[int, float] = {}
        self.saturation: dict[int, float] = {}
        self._engine, self._stack, self._confidence, self._boxes = engine, stack, confidence, prepared.body.boxes
        self._weighs = settings.weighs_matches
        options = settings.smoother_options
        self._parameters = TransferParameters(
            plan.smoother, settings.luminance, settings.resolved_gamma, engine.guide_curve, options
        )
        spacing, sigma = prepared.slice_spacing_mm, settings.coherence_mm
        self._groups = prepared.groups
        names = (None,) if self._groups is None else range(len(self._groups))
        self._evidence = {name: Evidence(plan.slices, spacing, sigma, self._parameters) for name in names}
        self._means, self._mean = SliceAverage(plan.slices, spacing, sigma), {}
        self.uncolored = 0
        chosen = list(plan.slices)
        self._frames = dict(zip(chosen, frames(self._boxes[chosen], spacing, sigma)))
        self._region = prepared.region[1:]
        self._last = None

    def add(self, ks: Sequence[int], matches) -> None:
        """Colour what can be coloured now that slices `ks` are matched; None: the same match as the slice before."""
        from .transfer import SliceMatch

        if matches is not None:
            self._last = [(grey, mask, lab, trust) for grey, mask, lab, trust in zip(*matches)]
        for n, k in enumerate(ks):
            grey, mask, lab, trust = self._last[n] if matches is not None else self._last[-1]
            if trust is not None:
                self.trusted[k], self.agreement[k] = round(trust.trusted_fraction, 4), round(trust.agreement, 4)
                self._put_confidence(k, trust)
            match = SliceMatch(lab, grey, mask, trust, self._frames[k])
            (self._gather if self._weighs else self._color_alone)(k, match)

    def _gather(self, k: int, match: SliceMatch) -> None:
        """Add a slice's evidence to what is known of colour and grey; slices whose neighbours are all in are coloured."""
        self._mean.update(self._means.push(k, np.float64(match.trust.mean)))
        streams = [evidence.push(k, own) for evidence, own in zip(self._evidence.values(), self._by_group(k, match))]
        for ready in zip_longest(*streams):  # all have the same slices ready; zip would leave the last ones unfinished
            self._color(*ready)

    def _by_group(self, k: int, match: SliceMatch) -> Iterator[tuple[SliceMatch, bool]]:
        """The slice's match for each group, with nothing outside it, and whether the slice has that group at all."""
        if self._groups is None:
            yield match, True
            return
        on_grid, there = self._engine.groups_on_grid([k])[0], np.unique(self._groups.in_box(k, self._boxes[k]))
        for name in self._evidence:
            yield replace(match, mask=match.mask & (on_grid == name)), name in there

    def _color(self, *ready: tuple[int, np.ndarray | None, np.ndarray]) -> None:
        """Colour a slice from its evidence, of everything or group by group."""
        from .confidence import saturation
        from .transfer import combine, to_picture

        k = ready[0][0]
        grey, mask = self._engine.slice_in_box(k)[0], self._engine.painted_in_box(k)
        self.saturation[k] = kept = saturation(self._mean.pop(k))
        groups = None if self._groups is None else self._groups.in_box(k, self._boxes[k])
        lab = None
        for name, (_, relation, rest) in zip(self._evidence, ready):
            own = mask if groups is None else mask & (groups == name)
            if groups is not None and not own.any():
                continue
            part = combine(grey, own, relation, rest, self._parameters, self._frames[k], kept)
            lab = part if lab is None else lab + part  # each is 0 outside its own pixels
            if groups is not None and not rest[..., -1].any():
                self.uncolored += int(np.count_nonzero(own))
        if lab is not None:
            self._put(k, *to_picture(lab, mask))

    def _color_alone(self, k: int, match: SliceMatch) -> None:
        from .transfer import transfer

        grey, mask = self._engine.slice_in_box(k)[0], self._engine.painted_in_box(k)
        self._put(k, *transfer(grey, mask, match, self._parameters))

    def _put(self, k: int, rgb: np.ndarray, clipped: int) -> None:
        self.clipped += clipped
        self._paste(self._stack, k, rgb)

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


class Evidence:
    """What matches say of colour, all or those of one tissue group, averaged along the stack."""

    def __init__(
        self, slices: Sequence[int], spacing_mm: float, sigma_mm: float, parameters: TransferParameters
    ) -> None:
        """Args: as for `coherence.SliceAverage` and `transfer`."""
        from .coherence import SliceAverage

        self._relations, self._remainders = (SliceAverage(slices, spacing_mm, sigma_mm) for _ in range(2))
        self._parameters = parameters
        self._waiting: dict[int, tuple[SliceMatch, bool]] = {}
        self._known: dict[int, np.ndarray | None] = {}

    def push(self, k: int, match: tuple[SliceMatch, bool]) -> Iterator[tuple[int, np.ndarray | None, np.ndarray]]:
        """Add a slice; yields (slice, relation, remainder) as `transfer.combine` takes them, for each that is complete now.

        Args:
            match: and whether the slice has the group; without it, it adds nothing, and what is yielded is not to be used.
        """
        from .transfer import relation_sums, solve_relation

        self._waiting[k] = match
        own, there = match
        if self._parameters.smoother != "regression":
            yield from self._settle(k, None)
            return
        sums = relation_sums(own, self._parameters) if there else _NOTHING
        for ready, total in self._relations.push(k, sums):
            relation = solve_relation(total, self._parameters) if self._waiting[ready][1] else None
            yield from self._settle(ready, relation)

    def _settle(self, k: int, relation: np.ndarray | None) -> Iterator[tuple[int, np.ndarray | None, np.ndarray]]:
        """Take the remainder of a slice, which is averaged along the stack in its turn."""
        from .transfer import remainder, remainder_guide

        match, there = self._waiting.pop(k)
        self._known[k] = relation
        rest = remainder(match, relation, self._parameters) if there else _NOTHING
        for ready, total in self._remainders.push(k, rest, remainder_guide(match, self._parameters)):
            yield ready, self._known.pop(ready), total
