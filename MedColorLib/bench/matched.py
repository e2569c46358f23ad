"""One slice through the stages of the pipeline, opened up: match once, then transfer in every way and look at L*a*b*."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..coloring.transfer import (
    SliceMatch,
    TransferParameters,
    combine,
    on_plane,
    relation_sums,
    remainder,
    solve_relation,
    transfer_lab,
)
from ..errors import SettingsError
from ..matching.contrast import Contrast
from ..matching.orientation import WAYS, Lie
from ..parameters import Settings
from ..progress import Run
from ..run.engine import Engine
from ..run.prepare import prepare
from ..scan.grid import from_grid, to_grid
from ..scan.intensity import histogram_match_curve, spreading_curve
from ..volume import Volume


@dataclass(frozen=True)
class Method:
    """A point on the curve of error against time.

    Attributes:
        features: "vgg19" or "embedded". preset: key of PRESETS.
        stop_layer, context: other than the preset's; None takes the preset's. Not with the own features, which have neither.
        reconstruction: "warp" or "lbfgs".
        whole_features: True compares all channels of the features instead of the preset's components.
        contrast, orientation: False takes the histogram match, and the photograph as it lies: both as in the paper.

    Raises:
        SettingsError: a layer, context or whole features of the own features.
    """

    features: str
    preset: str
    stop_layer: int | None = None
    context: bool | None = None
    reconstruction: str = "warp"
    whole_features: bool = False
    contrast: bool = True
    orientation: bool = True

    def __post_init__(self) -> None:
        if self.features == "embedded" and (self.stop_layer, self.context, self.whole_features) != (None, None, False):
            raise SettingsError("the own features have one layer, no context and no components: leave these out")

    @property
    def label(self) -> str:
        """For tables: the preset, and what differs from it."""
        parts = [self.preset]
        if self.stop_layer is not None:
            parts.append(f"to layer {self.stop_layer}")
        if self.context is not None:
            parts.append("with context" if self.context else "without context")
        if self.reconstruction != "warp":
            parts.append(self.reconstruction)
        if self.whole_features:
            parts.append("whole features")
        if not self.contrast:
            parts.append("histogram match")
        if not self.orientation:
            parts.append("reference as it lies")
        return ", ".join(parts)

    def settings(self, **changes) -> Settings:
        """Settings for one slice; the target's display grey is 0..1 unless `window` is given.

        The truth of a pair is the photograph as it is: no exposure.
        """
        options = {
            "window": (0.0, 1.0),
            "exposure": "off",
            "features": self.features,
            "reconstruction": self.reconstruction,
            **changes,
        }
        return Settings(preset=self.preset, **options)


@dataclass(frozen=True)
class Transfer:
    """How matched colours become a slice.

    Attributes:
        smoother, gamma, luminance: as in `Settings`.
        weighted: whether matches count by their trust; None as the pipeline does with this smoother. Needs a match with
            trust: `Matched(..., confidence=True)`.
        remainder: False leaves out, beside the regression, what the regression does not explain.
    """

    smoother: str
    gamma: bool
    luminance: str = "keep"
    weighted: bool | None = None
    remainder: bool = True


class SwitchedEngine(Engine):
    """An engine of which two steps that are not in the paper can be left out: see `Method`."""

    def __init__(self, prepared, run: Run, method: Method) -> None:
        self._method = method
        super().__init__(prepared, run)

    def _turn_references(self) -> None:
        if self._method.orientation:
            super()._turn_references()
            return
        for reference in self.references:
            reference.turn(Lie("as it is", math.inf, dict.fromkeys(WAYS, 0.0)))  # as if it were known

    def _learn_contrast(self, index: int) -> None:
        super()._learn_contrast(index)
        if self._method.contrast:
            return
        reference = self.references[index]  # how much grey explains stays as found: the context reads it
        greys, masks = self.slices_on_grid(self.prepared.plan.slices)
        curve = histogram_match_curve(greys[masks], reference.grey[reference.mask])
        reference.contrast = Contrast(curve, "histogram match", reference.contrast.explained, 0.0)


class Matched:
    """Slice `k` of a volume after matching.

    Attributes:
        lab: (H, W, 3) matched colours T' on the grid.
    """

    def __init__(self, volume: Volume, reference: np.ndarray, method: Method, k: int = 0, **changes) -> None:
        self.prepared = prepare(volume, [reference], method.settings(**changes))
        self.engine = SwitchedEngine(self.prepared, Run(None, None), method)
        if method.stop_layer is not None:
            self.engine.stop_layer = method.stop_layer
            self.engine.layers = tuple(range(5, method.stop_layer - 1, -1))
            self.engine.forget_features()
        if method.whole_features:
            self.engine.components = None
            self.engine.forget_features()
        if method.context is not None:
            self.engine.uses_context = method.context
        self._k = k
        self.match()

    def match(self) -> np.ndarray:
        """Features of the slice and matching: what is done again for every slice. Sets and returns `lab`."""
        self._greys, self._masks, found, self._trusts = self.engine.match([self._k], 0)
        self.lab = found[0]
        return self.lab

    def use_truth(self, lab: np.ndarray) -> None:
        """Replace the matched colours by the true ones (rows, cols, 3) of the whole slice: a match without error."""
        j0, j1, i0, i1 = self.prepared.body.boxes[self._k]
        self.lab, self._trusts = to_grid(lab[j0:j1, i0:i1], self.prepared.grid), [None]

    def unsmoothed(self) -> np.ndarray:
        """L* a* b* (rows, cols, 3) of the whole slice by the votes of the matches alone; 0 outside the body's box."""
        j0, j1, i0, i1 = self.prepared.body.boxes[self._k]
        out = np.zeros((*self.prepared.view.shape[1:], 3))
        out[j0:j1, i0:i1] = from_grid(self.lab, (j1 - j0, i1 - i0))
        return out

    def chroma(self, smoother: str, gamma: bool) -> np.ndarray:
        """a*, b* (rows, cols, 2) of the whole slice before they are drawn into the gamut; 0 outside the body."""
        return self.colored(Transfer(smoother, gamma))[..., 1:]

    def colored(self, how: Transfer) -> np.ndarray:
        """L* a* b* (rows, cols, 3) of the whole slice before they are drawn into the gamut; 0 outside the body."""
        curve, engine = self._guide_curve(how.smoother), self.engine
        options = engine.smoother_options if how.smoother == self.prepared.plan.smoother else None
        grey, cover = self.engine.slice_in_box(self._k)
        trust = self._trusts[0] if self._weighs(how) else None
        one_tissue = engine.one_tissue(1.0 if trust is None else trust.trusted_fraction)
        parameters = TransferParameters(
            how.smoother,
            how.luminance,
            how.gamma,
            curve,
            options,
            one_tissue=one_tissue,
            doubts_outliers=engine.own_features,
            tints=engine.tints if how.luminance == "natural" and not how.gamma else None,
        )
        match = SliceMatch(self.lab, self._greys[0], self._masks[0], trust)
        out = np.zeros((*self.prepared.view.shape[1:], 3))
        j0, j1, i0, i1 = self.prepared.body.boxes[self._k]
        out[j0:j1, i0:i1] = _transferred(grey, cover > 0.5, match, parameters, how.remainder)
        return out

    def _guide_curve(self, smoother: str) -> np.ndarray | None:
        """The pipeline's curve for this slice, also where the preset's own smoother has none."""
        if smoother != "regression" or self.engine.guide_curve is not None:
            return self.engine.guide_curve
        grey, cover = self.engine.slice_in_box(self._k)
        return spreading_curve(grey[cover > 0.5])

    def _weighs(self, how: Transfer) -> bool:
        if how.weighted is not None:
            return how.weighted
        return replace(self.prepared.settings, smoother=how.smoother).weighs_matches

    @property
    def body(self) -> np.ndarray:
        """(rows, cols) bool: the body that was found, the only place that is coloured."""
        return self.prepared.body.plane(self._k) > 0.5

    def box(self, plane: np.ndarray) -> np.ndarray:
        """A plane (rows, cols[, c]) of the whole slice, cut to the body's box."""
        j0, j1, i0, i1 = self.prepared.body.boxes[self._k]
        return plane[j0:j1, i0:i1]


def _transferred(grey, mask, match: SliceMatch, parameters: TransferParameters, with_remainder: bool) -> np.ndarray:
    if with_remainder or parameters.smoother != "regression":
        return transfer_lab(grey, mask, match, parameters)
    relation = solve_relation(relation_sums(match, parameters), parameters)
    nothing = np.zeros_like(remainder(match, relation, parameters))
    return on_plane(combine(grey, mask, relation, nothing, parameters, match.within), mask)
