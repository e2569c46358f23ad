"""Which reference each slice takes: dynamic programming against trying everything, and a stack whose order is known."""

from itertools import combinations_with_replacement

import numpy as np
import pytest

from MedColorLib.assignment import assign, monotone


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1), (3, 4), (5, 3), (6, 4)])
def test_monotone_is_the_best_of_all(rng, shape):
    for _ in range(20):
        similarity = rng.normal(size=shape)
        totals = {
            c: similarity[np.arange(shape[0]), list(c)].sum()
            for c in combinations_with_replacement(range(shape[1]), shape[0])
        }
        choice, total = monotone(similarity)
        assert total == pytest.approx(max(totals.values()))
        assert similarity[np.arange(shape[0]), choice].sum() == pytest.approx(total)
        assert (np.diff(choice) >= 0).all()


def series(slices=30, references=10, noise=0.0, seed=0):
    level, own = np.linspace(0, 1, slices), np.linspace(0, 1, references)
    likeness = np.exp(-(((level[:, None] - own) / 0.15) ** 2))
    return likeness + np.random.default_rng(seed).normal(0, noise, likeness.shape)


@pytest.mark.parametrize("flipped", [False, True])
def test_order_outvotes_noise(flipped):
    truth = np.rint(np.linspace(0, 9, 30))
    similarity = series(noise=0.5)
    if flipped:
        similarity, truth = similarity[:, ::-1], 9 - truth
    choice, name = assign(similarity)
    assert name == ("against the series" if flipped else "along the series")
    free_error = np.abs(similarity.argmax(1) - truth).mean()
    assert np.abs(choice - truth).mean() < 0.8 < free_error


def test_volume_that_covers_part_of_the_series():
    choice, _ = assign(series(slices=100, references=20)[30:60])
    assert 4 <= choice.min() <= 7 and 10 <= choice.max() <= 13


def test_a_set_without_order_is_free():
    similarity = series(slices=40, references=8)[:, [3, 0, 6, 1, 7, 4, 2, 5]]
    choice, name = assign(similarity)
    assert name == "freely"
    np.testing.assert_array_equal(choice, similarity.argmax(1))


def test_sections_of_the_phantom_find_their_level():
    """A series of colour sections at known heights; every slice takes one within a step of its own height."""
    from MedColorLib import Settings
    from MedColorLib.engine import Engine
    from MedColorLib.phantom import sample, section
    from MedColorLib.prepare import prepare
    from MedColorLib.progress import Run

    levels = np.linspace(-0.9, 0.8, 8)
    volume, _ = sample()
    prepared = prepare(volume, [section(level) for level in levels], Settings(preset="draft", features="embedded"))
    engine = Engine(prepared, Run(None, None))
    assert engine.assigned == "along the series"
    slices = np.array(prepared.plan.slices)
    own = np.array([levels[engine.choice[k]] for k in slices])
    error = np.abs(own - (slices / 47 * 2 - 1))
    assert np.median(error) < 0.25 and error.max() < 0.6
