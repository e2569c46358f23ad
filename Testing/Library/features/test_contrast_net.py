"""The own features: a network that sees anatomy through any contrast, and its training."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from MedColorLib.errors import InputError, SettingsError, WeightsError
from MedColorLib.features import contrast_net

TRAINING = Path(__file__).resolve().parents[2] / "Training"
sys.path.insert(0, str(TRAINING))

from pictures import make_anatomy, make_pair  # noqa: E402
from train import save, train  # noqa: E402


def test_shape_length_and_type():
    found = contrast_net.extract(torch.rand(2, 1, 64, 96))
    assert found.shape == (2, 32, 16, 24)
    assert found.dtype == torch.float32
    assert torch.allclose(found.norm(dim=1), torch.ones(2, 16, 24), atol=1e-5)


def test_same_bits_alone_and_in_a_batch():
    pictures = torch.rand(3, 1, 64, 64, generator=torch.Generator().manual_seed(0))
    together = contrast_net.extract(pictures)
    assert torch.equal(together, contrast_net.extract(pictures))
    assert torch.equal(together[1:2], contrast_net.extract(pictures[1:2]))


@pytest.mark.parametrize("picture", [torch.zeros(1, 1, 64, 64), torch.ones(1, 1, 64, 64), torch.rand(1, 1, 16, 16)])
def test_flat_and_tiny_pictures_have_features(picture):
    assert torch.isfinite(contrast_net.extract(picture)).all()


@pytest.mark.parametrize(
    "picture",
    [torch.rand(1, 3, 64, 64), torch.rand(64, 64), torch.rand(1, 1, 60, 64), torch.full((1, 1, 64, 64), torch.nan)],
)
def test_refuses_what_it_cannot_describe(picture):
    with pytest.raises(InputError):
        contrast_net.extract(picture)


def test_context_is_what_a_far_part_of_the_picture_says():
    picture = torch.rand(1, 1, 128, 256, generator=torch.Generator().manual_seed(2))
    without, half, whole = (contrast_net.extract(picture, context=share) for share in (0.0, 0.5, 1.0))
    assert torch.equal(without, contrast_net.extract(picture))  # as the pipeline takes it
    assert (whole * without).sum(1).mean() < (whole * half).sum(1).mean() < 1


def test_layers_of_the_extractor():
    extractor = contrast_net.Contrast()
    layers = extractor.extract(torch.rand(1, 1, 64, 64), (5, 4, 3))
    assert {n: tuple(v.shape) for n, v in layers.items()} == {5: (1, 32, 4, 4), 4: (1, 32, 8, 8), 3: (1, 32, 16, 16)}
    assert extractor.descriptor(torch.rand(2, 1, 64, 64)).norm(dim=1).tolist() == pytest.approx([1, 1], abs=1e-5)
    with pytest.raises(SettingsError, match="layers 3, 4 and 5"):
        extractor.extract(torch.rand(1, 1, 64, 64), (1,))


def test_a_slightly_changed_slice_is_described_most_like_itself():
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(6, 1, 8, 6, generator=generator)
    slices = torch.nn.functional.interpolate(coarse, size=(64, 48), mode="bilinear")
    noise = 0.03 * torch.randn(6, 1, 64, 48, generator=generator)
    extractor = contrast_net.Contrast()
    library, queries = extractor.descriptor(slices), extractor.descriptor((slices + noise).clamp(0, 1))
    assert (queries @ library.T).argmax(1).tolist() == list(range(6))


def test_weights_are_small_and_those_of_the_log():
    content = contrast_net.WEIGHTS.read_bytes()
    assert len(content) < 1_000_000
    log = json.loads((TRAINING / "log.json").read_text(encoding="utf-8"))
    assert hashlib.sha256(content).hexdigest() == log["sha256"]


def test_missing_and_foreign_weights_are_named(tmp_path, monkeypatch):
    from safetensors.torch import save_file

    contrast_net._loaded.cache_clear()
    monkeypatch.setattr(contrast_net, "WEIGHTS", tmp_path / "none.safetensors")
    with pytest.raises(WeightsError, match="cannot be read"):
        contrast_net.extract(torch.rand(1, 1, 64, 64))
    save_file({"head.weight": torch.zeros(3)}, str(tmp_path / "none.safetensors"))
    with pytest.raises(WeightsError, match="another version"):
        contrast_net.extract(torch.rand(1, 1, 64, 64))


def test_pairs_know_their_truth():
    levels = (make_anatomy(7, 192),) * 2
    pair = make_pair(np.random.default_rng(7), levels, 128)
    rows, cols = np.nonzero(pair.valid)
    there = pair.first_tissue[np.rint(pair.y[rows, cols]).astype(int), np.rint(pair.x[rows, cols]).astype(int)]
    assert len(rows) > 1000
    assert np.mean(there == pair.second_tissue[rows, cols]) > 0.99


def test_neighbouring_sections_resemble_each_other():
    own, near, other = make_anatomy(9, 160), make_anatomy(9, 160, 0.1), make_anatomy(10, 160)
    assert np.array_equal(own.roles, near.roles)
    agree = np.mean(own.labels == near.labels)
    assert 0.5 < agree < 1
    assert np.mean(own.labels == other.labels) < agree


@pytest.mark.slow
def test_training_learns_and_repeats(tmp_path):
    network, log = train(40, seed=1, say=lambda row: None, every=10)
    again, log2 = train(40, seed=1, say=lambda row: None, every=10)
    assert log[-1]["loss"] < log[0]["loss"] - 0.5
    assert [row["loss"] for row in log] == [row["loss"] for row in log2]
    for path, one in ((tmp_path / "a.safetensors", network), (tmp_path / "b.safetensors", again)):
        save(one, path, 1, 40)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
