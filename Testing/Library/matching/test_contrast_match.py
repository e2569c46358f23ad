"""The matcher of the own features."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from MedColorLib.features import contrast_net
from MedColorLib.matching.contrast_match import match

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "Training"))

from pictures import make_anatomy, view

INSIDE_PX = 8


def _picture(seed: int = 3, kind: str = "photograph", size: int = 128) -> tuple[np.ndarray, np.ndarray]:
    anatomy = make_anatomy(seed, size)
    rng = np.random.default_rng(seed)
    return view(rng, anatomy, kind, rng.random(len(anatomy.roles)).astype(np.float32)), anatomy.labels > 0


def _tensor(picture: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(picture, np.float32))[None, None]


def _self_match(first, second, mask, **options):
    masks = torch.from_numpy(mask)
    return match(
        contrast_net.extract(_tensor(first)), contrast_net.extract(_tensor(second)), masks[None], masks, **options
    )


def _off_px(found, mask: np.ndarray) -> np.ndarray:
    """Distance in pixels of every position's match from its own place, inside the body."""
    height, width = found.field.shape[1:]
    rows, cols = np.mgrid[:height, :width]
    field = found.field[0].numpy()
    inside = mask.reshape(height, 4, width, 4).mean((1, 3)) > 0.5
    return 4 * np.hypot(field // width - rows, field % width - cols)[inside]


@pytest.mark.parametrize("remap", [lambda g: 1 - g, lambda g: 0.5 - 0.5 * np.cos(2.4 * np.pi * g)])
def test_a_remapped_picture_finds_itself(remap):
    anatomy = make_anatomy(11, 192)
    tissue = np.linspace(0.1, 0.95, len(anatomy.roles)).astype(np.float32)
    mask = anatomy.labels > 0
    picture = np.clip(tissue[anatomy.labels] + 0.03 * anatomy.detail, 0, 1) * mask
    off = _off_px(_self_match(remap(picture) * mask, picture, mask), mask)
    assert np.mean(off <= INSIDE_PX) > 0.85
    assert np.median(off) <= 4


def test_trusts_a_picture_after_itself_more_than_after_another():
    (picture, mask), (other, mask2) = _picture(3), _picture(4)
    own = _self_match(picture, (1 - picture) * mask, mask)
    foreign = match(
        contrast_net.extract(_tensor(picture)),
        contrast_net.extract(_tensor(other)),
        torch.from_numpy(mask)[None],
        torch.from_numpy(mask2),
    )
    inside = torch.from_numpy(mask.reshape(32, 4, 32, 4).mean((1, 3)) > 0.5)
    assert own.likeness[0][inside].mean() > foreign.likeness[0][inside].mean() + 0.1


@pytest.fixture
def in_float32(monkeypatch):
    """Products of the search in float32, so that what it finds can be held against exact arithmetic."""
    monkeypatch.setattr("MedColorLib.matching.contrast_match.fast_dtype", lambda *_: torch.float32)


def test_the_fast_type_finds_as_good_matches(monkeypatch):
    """Products in bfloat16, whatever this machine multiplies fastest: matches as alike as those of float32."""
    (picture, mask), (other, _) = _picture(3), _picture(4)
    inside, found = torch.from_numpy(mask.reshape(32, 4, 32, 4).mean((1, 3)) > 0), {}
    for kind in (torch.float32, torch.bfloat16):
        monkeypatch.setattr("MedColorLib.matching.contrast_match.fast_dtype", lambda *_, kind=kind: kind)
        found[kind] = _self_match(picture, other * mask, mask).similarity[0][inside].mean()
    assert found[torch.bfloat16] == pytest.approx(float(found[torch.float32]), abs=2e-3)


def test_match_is_the_slow_search(in_float32):
    """Against all patches compared one by one."""
    rng = np.random.default_rng(0)
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.nn.functional.normalize(torch.randn(1, 5, 6, 7, generator=generator), dim=1) for _ in range(2))
    mask, mask2 = (torch.from_numpy(rng.random((6, 7)) > 0.3) for _ in range(2))
    full, full2 = (m.repeat_interleave(4, 0).repeat_interleave(4, 1) for m in (mask, mask2))
    found = match(a, b, full[None], full2, position_weight=0.0)
    offsets = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    for y, x in mask.nonzero().tolist():
        scores, shares = {}, {}
        for v, u in mask2.nonzero().tolist():
            on_maps = [
                (dy, dx)
                for dy, dx in offsets
                if min(y + dy, v + dy) >= 0
                and max(y + dy, v + dy) < 6
                and min(x + dx, u + dx) >= 0
                and max(x + dx, u + dx) < 7
            ]
            scores[v * 7 + u] = sum(float(a[0, :, y + dy, x + dx] @ b[0, :, v + dy, u + dx]) for dy, dx in on_maps)
            shares[v * 7 + u] = len(on_maps)
        chosen = int(found.field[0, y, x])
        assert scores[chosen] == pytest.approx(max(scores.values()), abs=1e-5)
        assert float(found.similarity[0, y, x]) == pytest.approx(scores[chosen] / shares[chosen], abs=1e-5)


def test_similarity_leaves_position_out(in_float32):
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.nn.functional.normalize(torch.randn(1, 5, 6, 7, generator=generator), dim=1) for _ in range(2))
    mask = torch.ones(24, 28, dtype=torch.bool)
    placed = match(a, b, mask[None], mask, position_weight=0.3)
    without = match(a, b, mask[None], mask, position_weight=0.0)
    same = placed.field == without.field
    assert same.any() and not same.all()
    assert torch.allclose(placed.similarity[same], without.similarity[same], atol=1e-5)


def test_matches_lie_inside_the_masks_and_lead_back():
    picture, mask = _picture(5)
    half = mask & (np.arange(128)[:, None] < 64)
    features = contrast_net.extract(_tensor(picture))
    found = match(features, features, torch.from_numpy(mask)[None], torch.from_numpy(half))
    inside = torch.from_numpy(half.reshape(32, 4, 32, 4).mean((1, 3)) > 0.5).flatten()
    body = torch.from_numpy(mask.reshape(32, 4, 32, 4).mean((1, 3)) > 0.5)
    assert inside[found.field[0][body]].all()
    home = torch.arange(1024).view(32, 32)[body & inside.view(32, 32)]
    back = found.reverse[0].flatten()[found.field[0].flatten()[home]]
    assert (back == home).float().mean() > 0.9
    without = match(features, features, torch.from_numpy(mask)[None], torch.from_numpy(half), keep_reverse=False)
    assert without.reverse is None and without.likeness is None
    assert torch.equal(without.field, found.field)


def test_position_decides_between_matches_that_look_alike():
    """Two equal halves: without position the first is taken, with it the near one; a better look wins over a near place."""
    half = torch.nn.functional.normalize(torch.randn(1, 8, 16, 8, generator=torch.Generator().manual_seed(1)), dim=1)
    features, mask = torch.cat([half, half], 3), torch.ones(64, 64, dtype=torch.bool)
    columns = torch.arange(16).view(1, 1, 16)
    near = match(features, features, mask[None], mask, position_weight=0.1).field % 16
    assert (near - columns).abs()[..., 1:-1].max() == 0
    moved = torch.roll(features, 4, dims=3)
    far = match(moved[..., :8], half, mask[None, :, :32], mask[:, :32], position_weight=0.1).field % 8
    assert ((far - (torch.arange(8) - 4) % 8).abs()[:, 1:-1, [1, 2, 5, 6]] == 0).float().mean() > 0.95
