"""The preset `full` part by part against independent references: Liao et al. 2017 and Min et al. 2014, written out."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from MedColorLib.bench.exact_smoothing import exact_plane
from MedColorLib.bench.plain_patchmatch import plain_patchmatch
from MedColorLib.filters import fast_global_smoother
from MedColorLib.matching import analogy
from MedColorLib.matching.fields import patchmatch, windowed
from MedColorLib.matching.fields.field import average_vote, upsample
from MedColorLib.parameters import PRESETS, Settings


def smooth_maps(height, width, channels=6, seed=0, moved=(0, 0)):
    """(1, C, h, w) unit features that vary slowly, so that neighbours have neighbouring matches."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.randn(1, channels, height // 4 + 4, width // 4 + 4, generator=generator)
    fine = torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bicubic", align_corners=False)
    top, left = 6 + moved[0], 6 + moved[1]
    fine = fine[:, :, top : top + height, left : left + width]
    return analogy.unit(fine + 0.1 * torch.randn(fine.shape, generator=generator))


def patch_energy(target, reference, field, radius):
    """Mean of |F(p + o) - G(q + o)|^2 over positions and patches, position by position; off a map: nothing in common."""
    here, there = target[0].double().numpy(), reference[0].double().numpy()
    (_, h, w), (_, h2, w2) = here.shape, there.shape
    total = 0.0
    for p in np.ndindex(h, w):
        q = divmod(int(field[p]), w2)
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                y, x, y2, x2 = p[0] + dy, p[1] + dx, q[0] + dy, q[1] + dx
                on_both = 0 <= y < h and 0 <= x < w and 0 <= y2 < h2 and 0 <= x2 < w2
                total += float(((here[:, y, x] - there[:, y2, x2]) ** 2).sum()) if on_both else 2.0
    return total / (h * w * (2 * radius + 1) ** 2)


def exhaustive(target, reference, radius):
    """The best position of every patch by comparing all with all, from padded copies."""
    side = 2 * radius + 1
    here, there = (torch.nn.functional.unfold(m.double(), side, padding=radius)[0].T for m in (target, reference))
    return (here @ there.T).argmax(1).view(target.shape[2:])


def test_the_papers_numbers():
    assert analogy.PATCH_RADIUS == {5: 1, 4: 1, 3: 1, 2: 2, 1: 2}  # patches of 3, 3, 3, 5, 5
    assert analogy.SEARCH_RADIUS == {4: 6, 3: 6, 2: 4, 1: 4}
    assert analogy.BLEND_ALPHA == {4: 0.8, 3: 0.7, 2: 0.6, 1: 0.1}
    full = PRESETS["full"]
    assert (full.stop_layer, full.smoother, full.context, full.weighted, full.components) == (
        1,
        "fgs",
        False,
        False,
        None,
    )
    paper = Settings(preset="full", luminance="paper")
    assert paper.resolved_gamma and paper.resolved_smoother == "fgs"


@pytest.mark.parametrize("layer", [4, 2])
def test_patchmatch_energy_beside_exhaustive_and_the_plain_port(layer):
    """Ten iterations from a field half wrong: never below exhaustive, and no worse than the plain port by more than 5 %."""
    radius, reach = analogy.PATCH_RADIUS[layer], analogy.SEARCH_RADIUS[layer]
    target, reference = smooth_maps(20, 24), smooth_maps(20, 24, moved=(2, -3))
    best = exhaustive(target, reference, radius)
    start = upsample(best[None, ::2, ::2] // 2 // 24 * 12 + best[None, ::2, ::2] % 24 // 2, (20, 24), 12)
    least = patch_energy(target, reference, best, radius)
    everywhere = torch.ones(20, 24, dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    ours, _ = patchmatch.refine(target, reference, start, everywhere, radius, reach, 10, generator)
    plain = plain_patchmatch(target[0].numpy(), reference[0].numpy(), start[0].numpy(), radius, reach, 10)
    by_window, _ = windowed.refine(target, reference, start, everywhere, radius)
    energies = [patch_energy(target, reference, field, radius) for field in (ours[0], plain, by_window[0], start[0])]
    assert all(energy >= least * (1 - 1e-6) for energy in energies)
    assert energies[0] <= 1.05 * energies[1] and energies[2] <= 1.02 * energies[1]  # `full` searches in windows
    assert max(energies[:3]) < 0.9 * energies[3]


def test_latent_images_against_their_formula():
    """F_A' = W F_A + (1 - W) R with W = alpha sigmoid(300 (m - 0.05)), pixel by pixel; the same for B."""
    generator = torch.Generator().manual_seed(1)
    features = [{n: torch.rand(1, 5, s, s, generator=generator) * 9 for n, s in ((5, 4), (4, 8))} for _ in range(2)]
    a, b = (maps[4][0].double().numpy() for maps in features)
    fields = [torch.randint(16, (1, 4, 4), generator=generator) for _ in range(2)]
    _, _, (pair_a, pair_b) = analogy._descend(4, *features, *fields, ((4, 4), (4, 4)), None)
    for own, other, field, latent in ((a, b, fields[0], pair_a[0, 5:]), (b, a, fields[1], pair_b[0, :5])):
        strength = (own**2).sum(0)
        scaled = (strength - strength.min()) / (strength.max() - strength.min())
        for y, x in np.ndindex(8, 8):
            row, col = divmod(int(field[0, y // 2, x // 2]), 4)
            warped = other[:, 2 * row + y % 2, 2 * col + x % 2]
            weight = 0.8 / (1 + math.exp(-300 * (scaled[y, x] - 0.05)))
            expected = weight * own[:, y, x] + (1 - weight) * warped
            expected /= np.linalg.norm(expected)
            np.testing.assert_allclose(latent[:, y, x], expected, atol=1e-6)


def test_vote_of_patches_pixel_by_pixel():
    generator = torch.Generator().manual_seed(2)
    values, field = torch.rand(1, 3, 9, 7, generator=generator), torch.randint(63, (1, 8, 6), generator=generator)
    got = average_vote(values, field, radius=2)[0]
    for y, x in np.ndindex(8, 6):
        votes = []
        for py, px in np.ndindex(8, 6):  # the patch around (py, px) covers (y, x) at the offset (dy, dx)
            dy, dx = y - py, x - px
            row, col = int(field[0, py, px]) // 7 + dy, int(field[0, py, px]) % 7 + dx
            if abs(dy) <= 2 and abs(dx) <= 2 and 0 <= row < 9 and 0 <= col < 7:
                votes.append(values[0, :, row, col])
        torch.testing.assert_close(got[:, y, x], torch.stack(votes).mean(0))


def test_fast_global_smoother_beside_the_two_dimensional_problem(ct):
    """Min et al. solve rows and columns in turn: 7 % of the source's spread off where smoothing itself moves it by 41 %.

    Their share of lambda among the iterations comes nearer than OpenCV's.
    """
    guide = np.rint(ct.reference.astype(np.float64).mean(-1))[:120, :120]
    source = ct.reference[:120, :120].astype(np.float32)
    exact, residual = exact_plane(source, guide, 32.0, 200.0)

    def distance(result):
        return np.sqrt(((result - exact) ** 2).mean()) / source.std()

    theirs = distance(fast_global_smoother(source, guide, 32.0, 200.0, schedule="opencv"))
    assert residual < 1e-12
    assert distance(fast_global_smoother(source, guide, 32.0, 200.0)) < min(0.08, theirs) < 0.25 * distance(source)
