"""Stage *reconstruction*: how matched features come one layer down (Liao et al. 2017, section 4.2).

"warp" takes the reference's own finer features, moved by the upsampled field: no optimisation. "lbfgs" looks for features
of the finer layer whose image under the network is what was matched: min over R of |CNN(R) - warped|^2, by L-BFGS.

torch's L-BFGS begins with a step of 1 / |gradient|_1 and stops by absolute tolerances, so the scale of the problem decides
whether it moves at all: with the loss as a mean over a million values it stopped after one evaluation. Here the unknown is
divided by its root mean square, and the loss is the sum of squares of features divided by theirs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..progress import check

# Liao et al. go on for up to 500. On pairs of the thorax the votes of the matches are as good as warped ones after 8 iterations,
# 0.2 to 0.4 CIEDE2000 worse after 16, which halve the loss, and 0.4 to 0.7 worse after 32.
MOST_ITERATIONS = 16
EVERY = 8  # iterations between two looks at the loss
LEAST_GAIN = 0.05  # of the loss, by the last EVERY iterations; less means converged
SOLVED = 1e-4  # of the target's squared length: far below what a match is uncertain by
DIRECTIONS = ("reference to target", "target to reference")


@dataclass(frozen=True)
class Solved:
    """How one deconvolution of one slice went.

    Attributes:
        layer: of the unknown features. direction: one of DIRECTIONS.
        before, after: |CNN(R) - warped|^2 / |warped|^2 for the start and the result; "after" is never larger.
        evaluations: of the network and its gradient. converged: False where MOST_ITERATIONS ended it.
    """

    layer: int
    direction: str
    before: float
    after: float
    evaluations: int
    converged: bool


class Deconvolution:
    """Brings matched features one layer down by `deconvolve` and remembers how it went, for the report."""

    def __init__(self, extractor, iterations: int = MOST_ITERATIONS) -> None:
        """Args: extractor: a network with `layer_forward(layer, x)`."""
        self.solved: list[Solved] = []
        self._extractor, self._iterations = extractor, iterations

    def __call__(self, layer: int, direction: str, coarse: Tensor, fine: Tensor) -> Tensor:
        """Features of `layer`; see `deconvolve`."""
        features, found = deconvolve(self._extractor, layer, coarse, fine, self._iterations)
        self.solved += [Solved(layer, direction, *one) for one in found]
        return features

    def report(self) -> list[dict]:
        """One entry per layer and direction: slices, loss before and after (means), evaluations (sum), converged slices."""
        entries = []
        for layer, direction in sorted({(s.layer, s.direction) for s in self.solved}, key=lambda k: (-k[0], k[1])):
            of_it = [s for s in self.solved if (s.layer, s.direction) == (layer, direction)]
            before, after = (sum(getattr(s, name) for s in of_it) / len(of_it) for name in ("before", "after"))
            entries.append(
                {
                    "layer": layer,
                    "direction": direction,
                    "slices": len(of_it),
                    "loss_before": float(f"{before:.4g}"),
                    "loss_after": float(f"{after:.4g}"),
                    "evaluations": sum(s.evaluations for s in of_it),
                    "converged_slices": sum(s.converged for s in of_it),
                }
            )
        return entries


def make_reconstruction(name: str, extractor) -> Deconvolution | None:
    """A `Deconvolution`, or None for "warp" (nothing to compute)."""
    return None if name == "warp" else Deconvolution(extractor)


def deconvolve(
    extractor, layer: int, coarse: Tensor, start: Tensor, iterations: int = MOST_ITERATIONS
) -> tuple[Tensor, list[tuple[float, float, int, bool]]]:
    """Features of `layer` that the network maps to `coarse` at `layer + 1`.

    Each slice is solved by itself, so that the result does not depend on the batch. It stops when EVERY iterations have lowered
    the loss by less than LEAST_GAIN of it, when the loss is below SOLVED, or after `iterations`.

    Args:
        extractor: a network with `layer_forward(layer, x)`.
        coarse: (N, C', h', w') matched features of `layer + 1`.
        start: (N, C, h, w) first guess, the warped features of `layer`.

    Returns:
        (N, C, h, w) float32; for each slice (loss before, loss after, evaluations, converged), see `Solved`.
    """
    pairs = zip(coarse.float(), start.float())
    solutions, found = zip(*(_deconvolve_one(extractor, layer, c[None], s[None], iterations) for c, s in pairs))
    return torch.cat(solutions), list(found)


def _deconvolve_one(extractor, layer: int, coarse: Tensor, start: Tensor, iterations: int):
    of_coarse, of_start = (_root_mean_square(values) for values in (coarse, start))
    unknown = (start.detach() / of_start).contiguous().requires_grad_(True)
    energy = float((coarse / of_coarse).square().sum().clamp_min(1e-12))
    losses = []

    def misfit() -> Tensor:
        return ((extractor.layer_forward(layer, unknown * of_start) - coarse) / of_coarse).square().sum()

    def loss():
        check()
        optimizer.zero_grad()
        value = misfit()
        value.backward()
        losses.append(float(value.detach()) / energy)
        return value

    optimizer = torch.optim.LBFGS(
        [unknown], max_iter=EVERY, history_size=8, line_search_fn="strong_wolfe", tolerance_grad=0, tolerance_change=0
    )
    converged = False
    for _ in range(0, iterations, EVERY):
        begin = len(losses)
        with torch.enable_grad():
            optimizer.step(loss)
        converged = min(losses[begin:]) > (1 - LEAST_GAIN) * losses[begin] or min(losses[begin:]) < SOLVED
        if converged:
            break
    with torch.no_grad():
        after = float(misfit()) / energy
    if not after < losses[0]:  # rounding, where the start is a solution
        return start.detach(), (losses[0], losses[0], len(losses), converged)
    return unknown.detach() * of_start, (losses[0], after, len(losses), converged)


def _root_mean_square(values: Tensor) -> Tensor:
    return values.detach().square().mean().sqrt().clamp_min(1e-12)
