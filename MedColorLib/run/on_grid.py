"""What the engine keeps of a reference, and of a batch of slices with tissue groups: all on the grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..matching.orientation import Lie, turned
from ..matching.tissue_guard import colors_on_grid
from ..references.photograph import Reference, on_grid
from ..scan.grid import Grid

if TYPE_CHECKING:
    from torch import Tensor

    from ..matching.analogy import Match


class ReferenceOnGrid:
    """A reference brought to the grid; its features are computed when a slice first needs them."""

    def __init__(self, reference: Reference, grid: Grid, groups: np.ndarray | None = None) -> None:
        """Args:
        groups: (h, w) uint8 tissue groups of the picture, or None; see `guard`.
        """
        self.name = reference.name
        self.grey, self.lab, self.mask = on_grid(reference, grid)
        self.groups = None
        if groups is not None:
            self.lab, self.groups = colors_on_grid(groups, reference, grid, self.mask)
        self.lie: Lie | None = None
        self.contrast = self.usual = None

    @property
    def way(self) -> str:
        """How the picture lies; see `orientation`."""
        return self.lie.way if self.lie else "as it is"

    def turn(self, lie: Lie) -> None:
        """Bring a picture that lies so upright; the grid is square, so that any turn stays on it."""
        self.lie, way = lie, lie.way
        if way == "as it is":
            return
        self.grey, self.lab, self.mask = (turned(values, way) for values in (self.grey, self.lab, self.mask))
        if self.groups is not None:
            self.groups = turned(self.groups, way)


@dataclass(frozen=True)
class ReferenceFeatures:
    """What matching needs of a reference, on the device.

    Attributes:
        layers: features by layer, as components where `bases` has the layer; see `features.components`.
        luminance: (1, 1, H, W) grey. mask: (H, W).
    """

    layers: dict
    bases: dict
    luminance: Tensor
    mask: Tensor


class WithinGroups:
    """A batch of slices and one reference whose matches stay inside tissue groups; see `guard`.

    A pixel for which no vote of its own group is found takes its group's mean colour, which counts so little that every
    match nearby outweighs it.
    """

    def __init__(self, groups, masks, reference: ReferenceOnGrid, missing: Sequence[int], count: int, device) -> None:
        """Args:
        groups: (N, H, W) uint8, masks: (N, H, W) bool of the slices. missing: groups that the reference lacks; they are
            matched freely. count: number of groups.
        """
        self._groups, self._masks, self._reference = groups, masks, reference
        self._free = np.isin(groups, missing)
        self._count, self._device = count, device

    def channels(self) -> tuple[Tensor, Tensor]:
        """`Context.groups`."""
        return tuple(
            self._tensor((groups[:, None] == np.arange(self._count)[:, None, None]) & mask[:, None]).float()
            for groups, mask in (
                (self._groups, self._masks),
                (self._reference.groups[None], self._reference.mask[None]),
            )
        )

    def colors(self, found: Match, lab: Tensor) -> tuple[Tensor, Tensor]:
        """T' (N, 3, H, W), and (N, H, W) bool where a vote of the own group was found."""
        from ..matching.vote import matched_within_groups

        own = self._tensor(np.where(self._free, -1, self._groups.astype(np.int64)))
        other = self._tensor(self._reference.groups.astype(np.int64))
        return matched_within_groups(found.field, found.layer, lab, own, other)

    def completed(self, lab: np.ndarray, unvoted: np.ndarray) -> np.ndarray:
        """Matched colours (N, H, W, 3) with the group's mean colour where no vote was found."""
        lab = lab.copy()
        for index in np.unique(self._groups[unvoted]):
            mean = self._reference.lab[self._reference.mask & (self._reference.groups == index)].mean(axis=0)
            lab[unvoted & (self._groups == index)] = mean
        return lab

    def _tensor(self, values: np.ndarray) -> Tensor:
        import torch

        return torch.from_numpy(values).to(self._device)
