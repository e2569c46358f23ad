"""Stage *paint*: matched slices, in the order of the stack, become pictures in the result."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .engine import Engine
from .grid import from_grid
from .prepare import Prepared

if TYPE_CHECKING:
    from .transfer import SliceMatch


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
        averages = (SliceAverage(plan.slices, spacing, sigma) for _ in range(3))
        self._relations, self._remainders, self._means = averages
        chosen = list(plan.slices)
        self._frames = dict(zip(chosen, frames(self._boxes[chosen], spacing, sigma)))
        self._region = prepared.region[1:]
        self._waiting: dict[int, SliceMatch] = {}
        self._known: dict[int, np.ndarray | None] = {}
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
        """Add a slice's evidence to what is known of colour and grey; slices whose neighbours are all in go on."""
        from .transfer import relation_sums, solve_relation

        self._waiting[k] = match
        if self._parameters.smoother != "regression":
            self._settle(k, None)
            return
        for ready, sums in self._relations.push(k, relation_sums(match, self._parameters)):
            self._settle(ready, solve_relation(sums, self._parameters))

    def _settle(self, k: int, relation: np.ndarray | None) -> None:
        """Take the remainder of a slice, which is averaged along the stack in its turn; colour the slices that are ready."""
        from .confidence import saturation
        from .transfer import combine, remainder, remainder_guide, to_picture

        parameters, match = self._parameters, self._waiting.pop(k)
        self._known[k] = relation
        means = dict(self._means.push(k, np.array([match.trust.mean, 1.0])))
        rest = remainder(match, relation, parameters)
        for ready, total in self._remainders.push(k, rest, remainder_guide(match, parameters)):
            mean, weight = means[ready]
            grey, mask = self._engine.slice_in_box(ready)[0], self._engine.painted_in_box(ready)
            self.saturation[ready] = kept = saturation(mean / weight)
            relation = self._known.pop(ready)
            lab = combine(grey, mask, relation, total, parameters, self._frames[ready], kept)
            self._put(ready, *to_picture(lab, mask))

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
