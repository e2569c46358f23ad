"""Self-similarity: the definition of MIND by loops, what it must not see (contrast), and what must not break it."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch

from MedColorLib.features.self_similarity import SelfSimilarity, mind

RING = ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
ALL = (1, 2, 3, 4, 5)


def pictures(count=2, height=64, width=48, seed=0):
    """Smooth blobs with noise, 0..1."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 1, height // 8, width // 8, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")
    return (0.9 * smooth + 0.1 * torch.rand(count, 1, height, width, generator=generator)).clamp(0, 1)


def naive_mind(image: np.ndarray, distance: int) -> np.ndarray:
    """The definition, pixel by pixel in float64; beyond the edge the nearest pixel counts."""
    rows, cols = image.shape

    def pixel(row, col):
        return image[min(max(row, 0), rows - 1), min(max(col, 0), cols - 1)]

    def squared(row, col, step):  # of one pixel of the patch; the patch's own pixels stay on the image as well
        row, col = min(max(row, 0), rows - 1), min(max(col, 0), cols - 1)
        return (pixel(row + distance * step[0], col + distance * step[1]) - image[row, col]) ** 2

    patch = list(product((-1, 0, 1), repeat=2))
    difference = np.array(
        [
            [[np.mean([squared(r + y, c + x, step) for y, x in patch]) for c in range(cols)] for r in range(rows)]
            for step in RING
        ]
    )
    variance = difference.mean(0)
    variance = np.clip(variance, variance.mean() / 1000, variance.mean() * 1000)
    similarity = np.exp(-difference / variance)
    similarity -= similarity.mean(0)
    return similarity / np.linalg.norm(similarity, axis=0)


@pytest.mark.parametrize("distance", [1, 2])
def test_mind_follows_its_definition(distance):
    image = pictures(1, 16, 16).double()
    expected = naive_mind(image[0, 0].numpy(), distance)
    np.testing.assert_allclose(mind(image, distance)[0].numpy(), expected, atol=1e-9)


def test_zero_mean_and_unit_length():
    values = mind(pictures())
    torch.testing.assert_close(values.norm(dim=1), torch.ones(2, 64, 48))
    assert values.mean(1).abs().max() < 1e-6


@pytest.mark.parametrize(("height", "width"), [(48, 48), (64, 48), (48, 160)])
def test_shapes_of_all_layers(height, width):
    features = SelfSimilarity().extract(pictures(2, height, width), ALL)
    for layer in ALL:
        side = 2 ** (layer - 1)
        assert features[layer].shape[0] == 2 and features[layer].shape[2:] == (height // side, width // side)
        assert 10 <= features[layer].shape[1] <= 26 or layer == 1
        assert features[layer].dtype == torch.float32


def test_only_the_layers_asked_for_and_each_without_the_others():
    both = SelfSimilarity().extract(pictures(), (5, 3))
    assert sorted(both) == [3, 5]
    torch.testing.assert_close(SelfSimilarity().extract(pictures(), (3,))[3], both[3], rtol=0, atol=0)


def test_inverted_contrast_is_not_seen():
    features, inverted = (SelfSimilarity().extract(p, ALL) for p in (pictures(), 1 - pictures()))
    for layer in ALL:
        torch.testing.assert_close(features[layer], inverted[layer], atol=2e-3, rtol=0)


def test_brightness_and_contrast_are_not_seen_by_mind():
    torch.testing.assert_close(mind(0.3 * pictures() + 0.5), mind(pictures()), atol=1e-3, rtol=0)


def test_another_picture_is_seen():
    features, other = (SelfSimilarity().extract(pictures(seed=seed), (3,))[3] for seed in (0, 1))
    assert torch.nn.functional.cosine_similarity(features, other).mean() < 0.9


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_constant_pictures_give_no_nan(level):
    constant = torch.full((1, 1, 48, 48), level)
    assert not mind(constant).any()
    for values in SelfSimilarity().extract(constant, ALL).values():
        assert torch.isfinite(values).all()


def test_a_single_bright_pixel_in_black():
    picture = torch.zeros(1, 1, 48, 48)
    picture[0, 0, 20, 30] = 1
    for values in SelfSimilarity().extract(picture, ALL).values():
        assert torch.isfinite(values).all() and values.abs().max() <= 1 + 1e-5


def test_slices_together_as_alone():
    batch = pictures(3)
    together = SelfSimilarity().extract(batch, ALL)
    for n, layer in product(range(3), ALL):
        alone = SelfSimilarity().extract(batch[n : n + 1], (layer,))[layer]
        torch.testing.assert_close(together[layer][n : n + 1], alone, rtol=0, atol=1e-6)


def test_moves_with_the_picture():
    picture = pictures(1, 64, 192)
    moved = torch.roll(picture, 16, 3)
    for layer in (1, 3, 5):
        step = 16 // 2 ** (layer - 1)
        features, shifted = (SelfSimilarity().extract(p, (layer,))[layer] for p in (picture, moved))
        inner = slice(step + 3, -step - 3)
        torch.testing.assert_close(torch.roll(features, step, 3)[..., inner], shifted[..., inner], atol=1e-4, rtol=0)


def test_input_is_not_altered():
    picture = pictures()
    before = picture.clone()
    SelfSimilarity().extract(picture, ALL)
    torch.testing.assert_close(picture, before, rtol=0, atol=0)
