"""Stage *reconstruction*: how matched features come one layer down (Liao et al. 2017, section 4.2).

"warp" takes the reference's own finer features, moved by the upsampled field: no optimisation. "lbfgs" looks for features
of the finer layer whose image under the network is what was matched: min over R of |CNN(R) - warped|^2, by L-BFGS.
"""

from __future__ import annotations

import torch
from torch import Tensor

LBFGS_STEPS = 30


def make_reconstruction(name: str, extractor):
    """Function `f(layer, coarse_warped, fine_warped) -> features of layer`, or None for "warp" (nothing to compute)."""
    if name == "warp":
        return None
    return lambda layer, coarse, fine: deconvolve(extractor, layer, coarse, fine)


def deconvolve(extractor, layer: int, coarse: Tensor, start: Tensor, steps: int = LBFGS_STEPS) -> Tensor:
    """Features of `layer` that the network maps to `coarse` at `layer + 1`; (N, C, h, w) float32.

    Each slice is solved by itself, so that the result does not depend on the batch.

    Args:
        extractor: a network with `layer_forward(layer, x)`.
        coarse: (N, C', h', w') matched features of `layer + 1`.
        start: (N, C, h, w) first guess, the warped features of `layer`.
    """
    return torch.cat([_deconvolve_one(extractor, layer, c[None], s[None], steps) for c, s in zip(coarse, start)])


def _deconvolve_one(extractor, layer, coarse, start, steps):
    scale = coarse.square().mean().sqrt().clamp_min(1e-12)
    solution = start.detach().clone().requires_grad_(True)
    optimizer = torch.optim.LBFGS([solution], max_iter=steps, history_size=8, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        value = ((extractor.layer_forward(layer, solution) - coarse) / scale).square().mean()
        value.backward()
        return value

    with torch.enable_grad():
        optimizer.step(loss)
    return solution.detach()
