"""Confidence: whether the way back leads home, by loops, and what the agreement of contrasts does with it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from MedColorLib.confidence import HOME_POSITIONS, LEAST_TRUST, Trust, consistency, on_full_grid, trust_of
from MedColorLib.correspondence.field import identity


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


def test_full_grid_keeps_the_range_and_leaves_a_rest_of_trust():
    full = on_full_grid(torch.tensor([[[0.0, 1.0], [0.5, 0.0]]]), (16, 24))
    assert full.shape == (1, 16, 24)
    assert full.min() >= LEAST_TRUST - 1e-6 and full.max() <= 1 + LEAST_TRUST + 1e-6


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
