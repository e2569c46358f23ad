"""A dense layer that is asked again and again for few pictures: fc6 of VGG-19, kept as it is stored.

What feeds fc6 has passed a ReLU and a maximum: nine tenths of it are zero for one medical slice. Rows of the transposed
matrix that meet only zeros are skipped, which changes nothing, and the others become float32 in blocks that stay in the
processor's cache. One picture takes 2 ms on two cores; the matrix read and multiplied as a whole took 0.3 s.
"""

from __future__ import annotations

import torch

from .network_weights import NetworkWeights

_BLOCK_INPUTS = 256  # rows of the transposed matrix at once: 4 MB in float32 for fc6


class DenseLayer:
    """`inputs @ weight.T + bias`, with the weight in memory in its stored type.

    fc6 takes 103 MB from the 8-bit file, 206 MB from a file that MedColor converted (float16), 411 MB from float32.
    """

    def __init__(self, weights: NetworkWeights, name: str, device: torch.device) -> None:
        """Read `name`.weight (outputs, inputs), transposed, and `name`.bias.

        Raises:
            WeightsError: not in the file, of another type than it promises, or not finite.
        """
        outputs, inputs = weights.shape(f"{name}.weight")
        self._scale, low = weights.scaling(f"{name}.weight")
        # The stored number nearest to 0: without it sums would be differences of much larger ones.
        self._zero = round(max(0.0, min(255.0, -low / self._scale))) if self._scale > 0 else 0
        self._low = low + self._scale * self._zero
        self._table = None
        for start, rows in weights.stored_blocks(f"{name}.weight"):
            if self._table is None:
                self._table = torch.empty((inputs, outputs), dtype=rows.dtype, device=device)
            self._table[:, start : start + len(rows)] = rows.T
        self._bias = weights.tensor(f"{name}.bias").to(device)
        self._stored = torch.empty((_BLOCK_INPUTS, outputs), dtype=self._table.dtype, device=device)
        self._block = torch.empty((_BLOCK_INPUTS, outputs), dtype=torch.float32, device=device)

    def __call__(self, inputs: torch.Tensor) -> torch.Tensor:
        """(N, inputs) float32 on the layer's device -> (N, outputs) float32. Not for two threads at once."""
        total = torch.zeros((len(inputs), len(self._bias)), device=inputs.device)
        used = (inputs != 0).any(dim=0).nonzero()[:, 0]
        for rows in used.split(_BLOCK_INPUTS):
            stored, block = self._stored[: len(rows)], self._block[: len(rows)]
            torch.index_select(self._table, 0, rows, out=stored)
            block.copy_(stored).sub_(self._zero)
            total.addmm_(inputs[:, rows], block)
        return total.mul_(self._scale).add_(inputs.sum(dim=1, keepdim=True), alpha=self._low).add_(self._bias)
