"""The dense layer that skips zeros equals the plain product, however its matrix is stored."""

from __future__ import annotations

import pytest
import torch

from MedColorLib.features.dense import DenseLayer

OUTPUTS, INPUTS = 70, 600  # blocks of 256 inputs and a rest


class Stored:
    """What `DenseLayer` asks of `NetworkWeights`."""

    def __init__(self, matrix: torch.Tensor, scale: float, low: float) -> None:
        self.matrix, self.scales = matrix, (scale, low)
        self.bias = torch.linspace(-1, 1, OUTPUTS)

    def shape(self, _name):
        return tuple(self.matrix.shape)

    def scaling(self, _name):
        return self.scales

    def stored_blocks(self, _name):
        return ((start, self.matrix[start : start + 32]) for start in range(0, OUTPUTS, 32))

    def tensor(self, _name):
        return self.bias


def stored(dtype: torch.dtype) -> Stored:
    generator = torch.Generator().manual_seed(1)
    if dtype == torch.uint8:
        return Stored(torch.randint(0, 256, (OUTPUTS, INPUTS), generator=generator, dtype=dtype), 0.0007, -0.09)
    return Stored((0.02 * torch.randn((OUTPUTS, INPUTS), generator=generator)).to(dtype), 1.0, 0.0)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.float32])
@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("zeros", [0.0, 0.9, 1.0])
def test_equals_the_plain_product(dtype, count, zeros):
    weights = stored(dtype)
    layer = DenseLayer(weights, "fc6", torch.device("cpu"))
    generator = torch.Generator().manual_seed(2)
    inputs = torch.rand((count, INPUTS), generator=generator) * 50
    inputs[torch.rand((count, INPUTS), generator=generator) < zeros] = 0
    scale, low = weights.scales
    expected = inputs.double() @ (weights.matrix.double() * scale + low).T + weights.bias
    for _ in range(2):  # the blocks of the first call leave nothing behind
        found = layer(inputs)
        assert found.shape == (count, OUTPUTS)
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))
    assert layer._table.dtype == dtype  # no larger in memory than in the file
