"""Confidence: whether the way back leads home, by loops, and what the agreement of contrasts does with it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from MedColorLib.matching.analogy import unit
from MedColorLib.matching.confidence import (
    GREY_BELOW,
    HOME_POSITIONS,
    Trust,
    consistency,
    in_range,
    likeness,
    on_full_grid,
    saturation,
    trust_of,
)
from MedColorLib.matching.fields.field import identity


def test_distance_of_the_way_back_by_loops():
    generator = torch.Generator().manual_seed(0)
    field = torch.randint(0, 6 * 3, (2, 4, 5), generator=generator)
    reverse = torch.randint(0, 4 * 5, (2, 6, 3), generator=generator)
    got = consistency(field, reverse)
    for n in range(2):
        for row in range(4):
            for col in range(5):
                there = divmod(int(field[n, row, col]), 3)
                back = divmod(int(reverse[n, there[0], there[1]]), 5)
                squared = (back[0] - row) ** 2 + (back[1] - col) ** 2
                expected = math.exp(-squared / (2 * HOME_POSITIONS**2))
                assert got[n, row, col].item() == pytest.approx(expected, abs=1e-6)


def test_the_identity_is_trusted_everywhere():
    field = identity(1, 6, 7)
    torch.testing.assert_close(consistency(field, field), torch.ones(1, 6, 7))


def test_full_grid_keeps_the_range():
    full = on_full_grid(torch.tensor([[[0.0, 1.0], [0.5, 0.0]]]), (16, 24))
    assert full.shape == (1, 16, 24) and full.min() >= 0 and full.max() <= 1


class TestLikeness:
    def maps(self, seed=0):
        generator = torch.Generator().manual_seed(seed)
        a, b = (unit(torch.randn(n, 8, 4, 5, generator=generator) + 0.7) for n in (2, 1))
        return a, b, torch.randint(0, 20, (2, 4, 5), generator=generator)

    def test_by_its_own_words(self):
        a, b, field = self.maps()
        masks = torch.rand(2, 4, 5) > 0.3, torch.rand(4, 5) > 0.3
        got = likeness(a, b, field, *masks)
        for n in range(2):
            inside = [b[0][:, r, c] for r, c in masks[1].nonzero().tolist()]
            pairs = [float(a[n, :, r, c] @ v) for r, c in masks[0][n].nonzero().tolist() for v in inside]
            chance = sum(pairs) / len(pairs)
            for row in range(4):
                for col in range(5):
                    similarity = float(a[n, :, row, col] @ b[0].flatten(1)[:, field[n, row, col]])
                    assert got[n, row, col].item() == pytest.approx((similarity - chance) / (1 - chance), abs=1e-5)

    def test_equal_is_one_and_empty_masks_are_no_nan(self):
        a, _, _ = self.maps()
        none = torch.zeros(1, 4, 5, dtype=torch.bool)
        same = likeness(a[:1], a[:1], identity(1, 4, 5), ~none, ~none[0])
        torch.testing.assert_close(same, torch.ones(1, 4, 5), atol=1e-5, rtol=0)
        assert torch.isfinite(likeness(a[:1], a[:1], identity(1, 4, 5), none, none[0])).all()

    def test_range(self):
        torch.testing.assert_close(in_range(torch.tensor([0.1, 0.3, 0.4, 0.9]), 0.3, 0.5), torch.tensor([0, 0, 0.5, 1]))


def test_colour_fades_where_less_and_less_is_trusted():
    kept = [saturation(mean) for mean in (0.0, GREY_BELOW / 2, GREY_BELOW, 1.0)]
    assert kept == [0.0, 0.5, 1.0, 1.0]


class TestAgreement:
    def planes(self, rng):
        confidence = rng.uniform(0.1, 1, (20, 20)).astype(np.float32)
        confidence[:5] = 0  # outside the body
        return confidence, rng.random((20, 20))

    def test_weighted_correlation(self, rng):
        confidence, grey = self.planes(rng)
        seen = 0.5 * grey + 0.2 * rng.random((20, 20))
        trust = trust_of(confidence, grey, seen, None)
        w, x, y = (values[5:].ravel().astype(np.float64) for values in (confidence, grey, seen))
        x, y = x - (w * x).sum() / w.sum(), y - (w * y).sum() / w.sum()
        expected = (w * x * y).sum() / math.sqrt((w * x * x).sum() * (w * y * y).sum())
        assert trust.agreement == pytest.approx(expected)

    def test_same_and_inverted(self, rng):
        confidence, grey = self.planes(rng)
        assert trust_of(confidence, grey, grey, None).agreement == pytest.approx(1)
        assert trust_of(confidence, grey, 1 - grey, None).agreement == pytest.approx(-1)

    @pytest.mark.parametrize("level", [0.0, 0.3])
    def test_constants_agree_with_nothing(self, rng, level):
        confidence, grey = self.planes(rng)
        assert trust_of(confidence, np.full_like(grey, level), grey, None).agreement == 0

    @pytest.mark.parametrize("pixels", [0, 1])
    def test_next_to_no_body(self, pixels):
        confidence = np.zeros((4, 4), np.float32)
        confidence.flat[:pixels] = 1
        trust = trust_of(confidence, np.ones((4, 4)), np.ones((4, 4)), None)
        assert trust.agreement == 0 and trust.trusted_fraction == pixels

    def test_outside_the_body_does_not_count(self, rng):
        confidence, grey = self.planes(rng)
        poisoned = np.where(confidence > 0, grey, 1e9)
        assert trust_of(confidence, poisoned, grey, None).agreement == pytest.approx(1)


class TestOwnRelation:
    @pytest.mark.parametrize(("agreement", "weight"), [(-1, 0), (0.6, 0), (0.78, 0.74), (0.91, 6.39), (1, 243.6)])
    def test_weight_grows_with_agreement(self, agreement, weight):
        trust = Trust(np.ones((2, 2)), agreement, np.linspace(0, 1, 256))
        assert trust.own_relation_weight == pytest.approx(weight, abs=0.05)

    def test_none_without_a_function_back(self):
        assert Trust(np.ones((2, 2)), 0.95, None).own_relation_weight == 0

    def test_fraction_of_the_body(self):
        confidence = np.array([[0, 0, 0.7, 0.9], [0.5, 0.61, 0.1, 1.0]])
        assert Trust(confidence, 0, None).trusted_fraction == pytest.approx(4 / 6)
