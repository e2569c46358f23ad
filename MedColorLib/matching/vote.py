"""Stage *vote*: from the field of the last layer to colours on the full grid."""

from __future__ import annotations

from torch import Tensor

from .fields.field import average_vote, group_vote


def matched_colors(field: Tensor, layer: int, reference: Tensor) -> Tensor:
    """T': the reference's colours at the target's positions, average vote of 5 x 5 patches.

    Args:
        field: (N, h, w) of `layer`. reference: (1, C, H, W) on the full grid.

    Returns:
        (N, C, H, W).
    """
    return average_vote(reference, field, radius=2, scale=2 ** (layer - 1))


def matched_within_groups(
    field: Tensor, layer: int, reference: Tensor, groups: Tensor, reference_groups: Tensor
) -> tuple[Tensor, Tensor]:
    """T' from votes of each pixel's own group only.

    Args:
        field, layer, reference: as for `matched_colors`.
        groups: (N, H, W) integers, negative where every vote counts. reference_groups: (H, W).

    Returns:
        (N, C, H, W), 0 where no vote counts; (N, H, W) bool, where at least one does.
    """
    return group_vote(reference, field, groups, reference_groups, radius=2, scale=2 ** (layer - 1))
