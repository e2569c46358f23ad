"""One slice through the stages of the pipeline, opened up: match once, then transfer in every way and look at L*a*b*."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..engine import Engine
from ..grid import to_grid
from ..parameters import Settings
from ..prepare import prepare
from ..progress import Run
from ..transfer import SliceMatch, TransferParameters, transfer_lab
from ..volume import Volume


@dataclass(frozen=True)
class Method:
    """A point on the curve of error against time.

    Attributes:
        features: "vgg19" or "embedded". preset: key of PRESETS.
        stop_layer, context: other than the preset's; None takes the preset's.
        reconstruction: "warp" or "lbfgs".
    """

    features: str
    preset: str
    stop_layer: int | None = None
    context: bool | None = None
    reconstruction: str = "warp"

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
        return ", ".join(parts)

    def settings(self, **changes) -> Settings:
        """Settings for one slice; the target's display grey is 0..1 unless `window` is given."""
        options = {"window": (0.0, 1.0), "features": self.features, "reconstruction": self.reconstruction, **changes}
        return Settings(preset=self.preset, **options)


class Matched:
    """Slice `k` of a volume after matching.

    Attributes:
        lab: (H, W, 3) matched colours T' on the grid.
    """

    def __init__(self, volume: Volume, reference: np.ndarray, method: Method, k: int = 0, **changes) -> None:
        self.prepared = prepare(volume, [reference], method.settings(**changes))
        self.engine = Engine(self.prepared, Run(None, None))
        if method.stop_layer is not None:
            self.engine.stop_layer = method.stop_layer
            self.engine.layers = tuple(range(5, method.stop_layer - 1, -1))
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

    def chroma(self, smoother: str, gamma: bool) -> np.ndarray:
        """a*, b* (rows, cols, 2) of the whole slice before they are drawn into the gamut; 0 outside the body."""
        parameters = TransferParameters(smoother, "keep", gamma, self.engine.guide_curve)
        grey, cover = self.engine.slice_in_box(self._k)
        match = SliceMatch(
            self.lab, self._greys[0], self._masks[0], self._trusts[0] if self._weighs(smoother) else None
        )
        lab = transfer_lab(grey, cover > 0.5, match, parameters)
        out = np.zeros((*self.prepared.view.shape[1:], 2))
        j0, j1, i0, i1 = self.prepared.body.boxes[self._k]
        out[j0:j1, i0:i1] = lab[..., 1:]
        return out

    def _weighs(self, smoother: str) -> bool:
        return replace(self.prepared.settings, smoother=smoother).weighs_matches

    def box(self, plane: np.ndarray) -> np.ndarray:
        """A plane (rows, cols[, c]) of the whole slice, cut to the body's box."""
        j0, j1, i0, i1 = self.prepared.body.boxes[self._k]
        return plane[j0:j1, i0:i1]
