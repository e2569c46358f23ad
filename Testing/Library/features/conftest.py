"""Fixtures of the tests of `features/`."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from networks_samples import NARROW
from safetensors.torch import save_file
from weights_samples import NARROW as NARROW_FILES

from MedColorLib.features import weights
from MedColorLib.features.architectures import ARCHITECTURES


@pytest.fixture
def narrow(monkeypatch, tmp_path):
    """A function that makes the weights of a narrow network: tensors in float32, and the file opened by MedColor."""
    for name, architecture in NARROW.items():
        monkeypatch.setitem(ARCHITECTURES, name, architecture)
    monkeypatch.setattr(weights, "cache_folder", lambda: tmp_path / "cache")

    def make(network="vgg19", preprocessing="oxford", seed=0):
        generator = torch.Generator().manual_seed(seed)
        architecture = NARROW[network]
        tensors = {}
        for name, shape in {**architecture.required(), **architecture.optional()}.items():
            values = torch.randn(shape, generator=generator)
            if len(shape) > 1:
                values *= (2 / np.prod(shape[1:])) ** 0.5  # activations keep their size through the layers
            tensors[name] = values.abs() + 0.3 if name.endswith("_var") else values
        save_file(tensors, tmp_path / "narrow.safetensors", {"medcolor_preprocessing": preprocessing})
        return tensors, weights.load_weights(tmp_path / "narrow.safetensors")

    return make


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Narrow networks, an empty cache folder, and no setting of the developer's own."""
    for name, architecture in NARROW_FILES.items():
        monkeypatch.setitem(ARCHITECTURES, name, architecture)
    monkeypatch.delenv("MEDCOLOR_WEIGHTS", raising=False)
    monkeypatch.setenv("NO_PROXY", "*")
    monkeypatch.setattr(weights, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"
