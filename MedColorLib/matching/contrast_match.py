"""Matching by the own features: one exhaustive search at their stride, both ways, without latent pictures.

The features of `features.contrast_net` do not change with contrast, so there is nothing for a latent pair to bridge: all
patches of 3 x 3 positions are compared with all, by cosine similarity. Position joins weakly: it decides between matches that
look alike.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, max_pool2d

from ..device import fast_dtype
from .fields import exact, patches
from .fields.field import warp

PATCH_RADIUS = 1
GROUP_WEIGHT = (
    4.0  # one pixel of another tissue group costs its square; a patch of features and position has at most 10
)
POSITION_WEIGHT = 0.1  # similarity lost over 0.8 of the body's width, in units of the cosine of the features


class ContrastMatch(NamedTuple):
    """What the search found; the parts mean what they mean in `analogy.Match`, of layer 3 (positions of 4 x 4 pixels).

    Attributes:
        field: (N, h, w) int64, target to reference, flat row-major indices into the reference's (h2, w2).
        similarity: (N, h, w) mean cosine -1..1 of the matched patches, position left out.
        reverse: (N, h2, w2) reference to target, or None.
        likeness: (N, h, w), `similarity` with 0 for what chance gives and 1 for equal, or None like `reverse`.
    """

    field: Tensor
    similarity: Tensor
    reverse: Tensor | None
    likeness: Tensor | None


def match(
    target: Tensor,
    reference: Tensor,
    target_mask: Tensor,
    reference_mask: Tensor,
    position_weight: float = POSITION_WEIGHT,
    keep_reverse: bool = True,
    groups: tuple[Tensor, Tensor] | None = None,
) -> ContrastMatch:
    """Match slices with one reference.

    Args:
        target: (N, C, h, w) unit features; reference: (1, C, h2, w2).
        target_mask: (N, H, W) bool body; reference_mask: (H2, W2) bool tissue; on the full grid. They say where matches may
            lie; patches reach beyond, since what surrounds a body tells its outline.
        position_weight: similarity lost over 0.8 of the body's height or width; 0 leaves position out.
        keep_reverse: whether the way back, and likeness, are wanted.
        groups: tissue groups that matches do not cross, as `analogy.Context.groups`.
    """
    inside, inside2 = _mask_at(target_mask, target.shape[2:]), _mask_at(reference_mask[None], reference.shape[2:])[0]
    a, b = target.float(), reference.float()
    placed, placed2 = _with_position(a, position_weight), _with_position(b, position_weight)
    if groups is not None:
        placed, placed2 = (_with_groups(*side) for side in zip((placed, placed2), groups))
    kind = torch.float32 if groups is not None else fast_dtype(a.device)  # their weight leaves bfloat16 no digits
    if by_whole_patches(kind, a.device.type):
        near = max_pool2d(_cover(target_mask, a.shape[2:]), 3, 1, 1) > 0  # all that give a pixel of the body its colour
        field, total, reverse = patches.search(placed, placed2, PATCH_RADIUS, near, inside, inside2, keep_reverse)
    else:
        field, total, reverse, _ = exact.search(
            placed.to(kind), placed2.to(kind), PATCH_RADIUS, inside, inside2, keep_reverse
        )
    if groups is not None:
        similarity = (a * warp(b, field)).sum(1)
    else:
        similarity = _without_position(total, field, a.shape[2:], b.shape[2:], position_weight)
    alike = _above_chance(similarity, a, b, inside, inside2) if keep_reverse else None
    return ContrastMatch(field, similarity, reverse, alike)


def by_whole_patches(kind: torch.dtype, device: str) -> bool:
    """Whether `patches` is the faster search: where a CPU multiplies bfloat16."""
    return kind == torch.bfloat16 and device == "cpu"


def _with_position(features: Tensor, weight: float) -> Tensor:
    """Features with row and column as points on circles: their inner product adds what `_nearness` gives."""
    if weight <= 0:
        return features
    height, width = features.shape[2:]
    places = []
    for size, shape in ((height, (1, 1, -1, 1)), (width, (1, 1, 1, -1))):
        angle = _angles(size, features.device).view(shape).expand(len(features), 1, height, width)
        places += [torch.cos(angle), torch.sin(angle)]
    return torch.cat([features, *(plane * (weight / 2) ** 0.5 for plane in places)], 1)


def _with_groups(features: Tensor, groups: Tensor) -> Tensor:
    cover = adaptive_avg_pool2d(groups, features.shape[2:])
    return torch.cat([features, GROUP_WEIGHT * cover / cover.norm(dim=1, keepdim=True).clamp_min(1e-12)], 1)


def _angles(size: int, device) -> Tensor:
    return torch.linspace(0, 1.2 * torch.pi, size, device=device)


def _nearness(rows: Tensor, size: int, size2: int, own_rows: Tensor) -> Tensor:
    """Cosine of the distance along one axis, 1 at the same place, -1 at 0.83 of the body's height or width."""
    return torch.cos(_angles(size2, rows.device)[rows] - _angles(size, rows.device)[own_rows])


def _without_position(total: Tensor, field: Tensor, shape, shape2, weight: float) -> Tensor:
    """Mean cosine of the features over the part of both patches that lies on the maps.

    Args:
        total: (N, h, w) mean over whole patches, position included, what is off either map counted as 0.
    """
    (height, width), (height2, width2) = shape, shape2
    own_rows = torch.arange(height, device=field.device).view(-1, 1).expand(height, width)
    own_cols = torch.arange(width, device=field.device).expand(height, width)
    rows, cols = field // width2, field % width2
    share = _on_maps(own_rows, rows, height, height2) * _on_maps(own_cols, cols, width, width2)
    near = _nearness(rows, height, height2, own_rows) + _nearness(cols, width, width2, own_cols)
    return total / share - max(weight, 0.0) / 2 * near


def _on_maps(own: Tensor, other: Tensor, size: int, size2: int) -> Tensor:
    """Share of a patch's rows (or columns) that lie on both maps."""
    before = torch.minimum(own, other).clamp_max(PATCH_RADIUS)
    behind = torch.minimum(size - 1 - own, size2 - 1 - other).clamp_max(PATCH_RADIUS)
    return (before + behind + 1) / (2 * PATCH_RADIUS + 1)


def _above_chance(similarity: Tensor, a: Tensor, b: Tensor, inside: Tensor, inside2: Tensor) -> Tensor:
    """0 for the mean similarity of all pairs of positions inside, 1 for equal."""
    own = (a * inside[:, None]).sum((2, 3)) / inside.sum((1, 2)).clamp_min(1)[:, None]
    other = (b[0] * inside2).sum((1, 2)) / inside2.sum().clamp_min(1)
    chance = (own @ other).view(-1, 1, 1)
    return (similarity - chance) / (1 - chance).clamp_min(1e-6)


def _mask_at(mask: Tensor, shape) -> Tensor:
    """(N, h, w) bool: more than half covered; where that leaves nothing (tiny bodies), any coverage."""
    cover = _cover(mask, shape)
    small = cover > 0.5
    return torch.where(small.flatten(1).any(1)[:, None, None], small, cover > 0)


def _cover(mask: Tensor, shape) -> Tensor:
    """(N, H, W) bool -> (N, h, w): share of each position."""
    return adaptive_avg_pool2d(mask.float()[:, None], tuple(shape))[:, 0]
