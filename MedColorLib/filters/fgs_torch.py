"""The solver of the fast global smoother on torch tensors: any device, all slices, channels and lines at once.

Every line of an image gives one system (I + lambda L) x = f, L the Laplacian of a path whose links are the guide's
weights: a chain of resistors in which each node is tied to its source value through a conductance (its ground, 1 at the
start). A node between links a and b, with ground g and load h, is eliminated by sharing it out: with d = g + a + b, its
neighbours get a/d and b/d of its ground and of its load, and a new link a b / d joins them. All terms are positive and
none is ever subtracted, so nothing cancels: the relative error of each output value does not depend on lambda.

The usual order, along the line, needs as many steps as the line has pixels, and in float32 its rounding errors add up
on the way: to 1e-4 at 4096 pixels. Here every other node is eliminated at once, then every other of the rest: log2(n)
steps of large vector operations, and rounding errors that grow with log2(n): 2e-6 at 4096 pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from ..errors import InputError
from .checks import bad_values_error
from .fgs_parameters import FgsParameters, lambda_schedule

_LARGE = 2.0**90  # float32 sources above this are scaled by a power of two: loads add up to the line's length
_LARGE_GUIDE = 2.0**500  # float64 guides above this likewise: distances square the differences
_GUIDE_SCALE = 2.0**-600


@dataclass(frozen=True)
class _Elimination:
    """What is left of one direction's systems, shared by all channels: a level per halving, coarsest last.

    A level holds (left share, right share, 1/d) of its eliminated nodes, each (N, 1, nodes, L).
    """

    levels: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]
    inverse_root: torch.Tensor  # (N, 1, 1, L): 1 / ground of the last node


def _eliminate(link: torch.Tensor) -> _Elimination:
    """Eliminate all nodes but the first.

    link (N, 1, n, L): lambda times the weight between nodes i and i + 1, the last row 0; overwritten.
    """
    ground = torch.ones_like(link)
    levels, stride = [], 1
    while stride < link.shape[-2]:
        links_left, links_right = link[..., :: 2 * stride, :], link[..., stride :: 2 * stride, :]
        kept, gone = ground[..., :: 2 * stride, :], ground[..., stride :: 2 * stride, :]
        count, with_right = gone.shape[-2], kept.shape[-2] - 1
        links_left = links_left[..., :count, :]
        inverse = (gone + links_left).add_(links_right).reciprocal_()
        left, right = links_left * inverse, links_right * inverse
        kept[..., :count, :].addcmul_(left, gone)
        kept[..., 1:, :].addcmul_(right[..., :with_right, :], gone[..., :with_right, :])
        torch.mul(left, links_right, out=links_left)  # the new link, in the place of the kept node's old one
        levels.append((left, right, inverse))
        stride *= 2
    return _Elimination(levels, ground[..., :1, :].reciprocal())


def _solve(planes: torch.Tensor, elimination: _Elimination) -> torch.Tensor:
    """Solve along dimension -2, in place. planes (N, C, n, L)."""
    stride = 1
    for left, right, _ in elimination.levels:
        kept, gone = planes[..., :: 2 * stride, :], planes[..., stride :: 2 * stride, :]
        count, with_right = gone.shape[-2], kept.shape[-2] - 1
        kept[..., :count, :].addcmul_(left, gone)
        kept[..., 1:, :].addcmul_(right[..., :with_right, :], gone[..., :with_right, :])
        stride *= 2
    planes[..., :1, :].mul_(elimination.inverse_root)
    for left, right, inverse in reversed(elimination.levels):
        stride //= 2
        kept, gone = planes[..., :: 2 * stride, :], planes[..., stride :: 2 * stride, :]
        count, with_right = gone.shape[-2], kept.shape[-2] - 1
        gone.mul_(inverse).addcmul_(left, kept[..., :count, :])
        gone[..., :with_right, :].addcmul_(right[..., :with_right, :], kept[..., 1:, :])
    return planes


def _transposed(planes: torch.Tensor) -> torch.Tensor:
    """(N, C, H, W) -> a new contiguous (N, C, W, H)."""
    if planes.device.type != "cpu":
        return planes.transpose(-1, -2).contiguous()
    result = planes.new_empty((*planes.shape[:2], planes.shape[3], planes.shape[2]))
    # plane by plane: torch blocks a transposing copy for the cache only when it has two dimensions
    for target, plane in zip(result.flatten(0, 1), planes.flatten(0, 1)):
        target.copy_(plane.t())
    return result


def _double_where_possible(device: torch.device) -> torch.dtype:
    """Weights are computed once in double precision; Apple's GPUs have none and stay in single."""
    return torch.float32 if device.type == "mps" else torch.float64


def _guide_values(guide: torch.Tensor) -> torch.Tensor:
    """The guide in floating point; whole numbers start at 0, so that large ones keep their differences."""
    double = _double_where_possible(guide.device)
    if guide.is_floating_point():
        return guide.to(double)
    whole = guide.to(torch.int64)
    offset = whole - whole.amin()
    values = offset.to(double)
    return torch.where(offset < 0, values + 2.0**64, values)  # a range beyond int64 has wrapped around


def _weights(guide: torch.Tensor, sigma: float) -> torch.Tensor:
    """exp(-distance / sigma) between rows i and i + 1: (N, 1, n, L), last row 0. At sigma = 0: 1 if equal, else 0."""
    steps = guide.diff(dim=-2)
    distance = steps.abs_() if guide.shape[1] == 1 else torch.linalg.vector_norm(steps, dim=1, keepdim=True)
    weights = guide.new_zeros((guide.shape[0], 1, *guide.shape[2:]))
    weights[..., :-1, :] = (distance == 0).to(guide.dtype) if sigma == 0 else (distance / -sigma).exp_()
    return weights


def _checked_range(name: str, tensor: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Smallest and largest value per plane, (N, C, 1, 1). Raises InputError with the count when some are not finite."""
    low, high = tensor.amin((-2, -1), keepdim=True), tensor.amax((-2, -1), keepdim=True)
    if not bool(torch.isfinite(low).all() & torch.isfinite(high).all()):  # both let NaN through
        raise bad_values_error(name, int((~torch.isfinite(tensor)).sum()), tensor.numel())
    return low, high


def _check_shapes(source: torch.Tensor, guide: torch.Tensor, confidence: torch.Tensor | None) -> None:
    if source.ndim != 4 or source.numel() == 0 or not source.is_floating_point():
        raise InputError(
            f"source: expected floats of shape (N, C, H, W), not empty, got {tuple(source.shape)} {source.dtype}"
        )
    for name, other in (("guide", guide), ("confidence", confidence)):
        if other is None:
            continue
        fits = other.ndim == 4 and other.shape[0] in (1, source.shape[0]) and other.shape[2:] == source.shape[2:]
        if not fits or other.shape[1] == 0 or (name == "confidence" and other.shape[1] != 1) or other.is_complex():
            raise InputError(
                f"{name}: expected real numbers of shape (N or 1, {'1' if name == 'confidence' else 'G'}, H, W) beside "
                f"a source of shape {tuple(source.shape)}, got {tuple(other.shape)} {other.dtype}"
            )
        if other.device != source.device:
            raise InputError(f"{name}: is on {other.device}, the source on {source.device}; move both to one device")


def _smoothed(planes: torch.Tensor, guide: torch.Tensor, parameters: FgsParameters) -> torch.Tensor:
    """Min et al.'s passes, along rows then columns in each iteration. Returns new planes (N, C, H, W)."""
    guide, sigma = _guide_values(guide), parameters.sigma
    if guide.abs().amax() > _LARGE_GUIDE:
        guide, sigma = guide * _GUIDE_SCALE, sigma * _GUIDE_SCALE
    along_rows = _weights(_transposed(guide), sigma)
    along_columns = _weights(guide, sigma)
    for lam in lambda_schedule(parameters.lam, parameters.iterations, parameters.schedule):
        elimination = _eliminate((along_rows * lam).to(planes.dtype))
        planes = _transposed(_solve(_transposed(planes), elimination))
        planes = _solve(planes, _eliminate((along_columns * lam).to(planes.dtype)))
    return planes


@torch.no_grad()
def fgs_torch(
    source: torch.Tensor,
    guide: torch.Tensor,
    lam: float = 32.0,
    sigma: float = 200.0,
    iterations: int = 3,
    *,
    schedule: str = "min2014",
    confidence: torch.Tensor | None = None,
) -> torch.Tensor:
    """Fast global smoother of a batch of images (Min et al. 2014). Parameters as in `fgs.fast_global_smoother`.

    Args:
        source: (N, C, H, W) floats on any device; not altered. float64 is solved in float64, all others in float32.
        guide: (N or 1, G, H, W), integers or floats, on the same device.
        confidence: (N or 1, 1, H, W) in 0..1, or None.

    Returns:
        (N, C, H, W), dtype and device of the source; each plane within the range of its source.

    Raises:
        InputError: shapes or devices that do not fit, NaN or infinite values, confidence outside 0..1.
        SettingsError: parameters outside their ranges.
    """
    parameters = FgsParameters(lam, sigma, iterations, schedule)
    _check_shapes(source, guide, confidence)
    low, high = _checked_range("source", source)
    if guide.is_floating_point():
        _checked_range("guide", guide)
    planes = source.to(torch.float64 if source.dtype == torch.float64 else torch.float32)
    low, high = low.to(planes.dtype), high.to(planes.dtype)
    largest = float(torch.maximum(low.abs(), high.abs()).amax())
    scale = 2.0 ** math.floor(math.log2(largest)) if largest > _LARGE else 1.0
    if scale != 1.0:
        planes = planes / scale
    result = (
        _smoothed(planes, guide, parameters)
        if confidence is None
        else _confident(planes, guide, confidence, parameters)
    )
    if scale != 1.0:
        result *= scale
    return torch.clamp(result, low, high).to(source.dtype)


def _confident(
    planes: torch.Tensor, guide: torch.Tensor, confidence: torch.Tensor, parameters: FgsParameters
) -> torch.Tensor:
    """FGS(c f) / FGS(c); the source itself where no confidence reaches: FGS(c) at the number format's lower end."""
    low, high = _checked_range("confidence", confidence)
    if float(low.amin()) < 0 or float(high.amax()) > 1:
        raise InputError(f"confidence: expected values in 0..1, got {float(low.amin()):g} to {float(high.amax()):g}")
    weight = confidence.to(planes.dtype).expand(planes.shape[0], 1, -1, -1)
    solved = _smoothed(torch.cat([planes * weight, weight], dim=1), guide, parameters)
    reached = solved[:, -1:]
    limits = torch.finfo(planes.dtype)
    return torch.where(reached > limits.tiny / limits.eps, solved[:, :-1] / reached, planes)
