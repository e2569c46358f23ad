"""Fixtures of the tests of `Library/`."""

from __future__ import annotations

import pytest
from pipeline_samples import DRAFT, part

from MedColorLib import ColorVolume, colorize


@pytest.fixture(scope="module")
def colored(ct, small_raster) -> ColorVolume:
    return colorize(part(ct), [ct.reference], DRAFT)


@pytest.fixture(scope="session")
def narrow_vgg19_file(tmp_path_factory):
    """Weights by chance of a VGG-19 that is a few channels wide: the same layers, a thousandth of the work."""
    import torch
    from safetensors.torch import save_file

    architecture = _narrow_vgg19()
    generator, tensors = torch.Generator().manual_seed(0), {}
    for name, shape in {**architecture.required(), **architecture.optional()}.items():
        values = torch.randn(shape, generator=generator)
        tensors[name] = values * (2 / max(values[0].numel(), 1)) ** 0.5 if len(shape) > 1 else 0.1 * values
    path = tmp_path_factory.mktemp("narrow") / "vgg19.safetensors"
    save_file(tensors, path, {"medcolor_preprocessing": "oxford"})
    return path


@pytest.fixture
def narrow_vgg19(narrow_vgg19_file, monkeypatch):
    """`features="vgg19"` works, and is the narrow one: for what is said and done of layers, whatever they hold."""
    from MedColorLib.features.architectures import ARCHITECTURES

    monkeypatch.setitem(ARCHITECTURES, "vgg19", _narrow_vgg19())
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(narrow_vgg19_file))


def _narrow_vgg19():
    from MedColorLib.features.architectures import Architecture

    return Architecture("vgg19", widths=(6, 8, 12, 100, 100), descriptor_width=8)
