"""Stage *paint*: matched slices, in the order of the stack, become pictures in the result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .engine import Engine
from .prepare import Prepared


class Painter:
    """Colours slices from their matches; with the regression, from the evidence of their neighbours, too."""

    def __init__(self, prepared: Prepared, engine: Engine, stack: np.ndarray | None) -> None:
        from .coherence import SliceAverage
        from .transfer import TransferParameters

        settings, plan = prepared.settings, prepared.plan
        self.clipped = 0
        self.trusted: dict[int, float] = {}
        self.agreement: dict[int, float] = {}
        self._engine, self._stack, self._boxes = engine, stack, prepared.body.boxes
        self._parameters = TransferParameters(
            plan.smoother, settings.luminance, settings.resolved_gamma, engine.guide_curve
        )
        self._average = SliceAverage(plan.slices, prepared.slice_spacing_mm, settings.coherence_mm)
        self._region = prepared.region[1:]
        self._changes: dict[int, np.ndarray | None] = {}
        self._last = None

    def add(self, ks: Sequence[int], matches) -> None:
        """Colour what can be coloured now that slices `ks` are matched; None: the same match as the slice before."""
        if matches is not None:
            self._last = [(grey, mask, lab, trust) for grey, mask, lab, trust in zip(*matches)]
        for n, k in enumerate(ks):
            grey, mask, lab, trust = self._last[n] if matches is not None else self._last[-1]
            if self._parameters.smoother == "regression":
                self._add_evidence(k, grey, mask, lab, trust)
            else:
                self._color_alone(k, grey, mask, lab)

    def _add_evidence(self, k, grid_grey, grid_mask, lab, trust) -> None:
        from .transfer import evidence, lightness_change, to_picture, transfer_evidence

        self.trusted[k], self.agreement[k] = round(trust.trusted_fraction, 4), round(trust.agreement, 4)
        sums = evidence(lab, grid_grey, grid_mask, self._parameters, trust)
        self._changes[k] = lightness_change(lab, grid_grey, self._parameters)
        for ready, total in self._average.push(k, sums):
            grey, mask = self._engine.slice_in_box(ready)[0], self._engine.painted_in_box(ready)
            colored = transfer_evidence(grey, mask, total, self._parameters, self._changes.pop(ready))
            self._put(ready, *to_picture(colored, mask))

    def _color_alone(self, k, grid_grey, grid_mask, lab) -> None:
        from .transfer import transfer

        grey, mask = self._engine.slice_in_box(k)[0], self._engine.painted_in_box(k)
        self._put(k, *transfer(grey, mask, lab, grid_grey, grid_mask, self._parameters))

    def _put(self, k: int, rgb: np.ndarray, clipped: int) -> None:
        self.clipped += clipped
        if self._stack is None:
            return
        j0, j1, i0, i1 = self._boxes[k]
        (row0, row1), (col0, col1) = self._region
        top, bottom, left, right = max(j0, row0), min(j1, row1), max(i0, col0), min(i1, col1)
        if top < bottom and left < right:
            self._stack[k, top:bottom, left:right] = rgb[top - j0 : bottom - j0, left - i0 : right - i0]
