"""Which reference each slice takes: dynamic programming against trying everything, and a stack whose order is known."""

from itertools import combinations_with_replacement

import numpy as np
import pytest

from MedColorLib.matching.assignment import assign, monotone


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


@pytest.mark.parametrize(("modality", "up_to"), [("mr", 1.0), ("ct", -0.15)])
def test_sections_of_the_phantom_find_their_level(modality, up_to):
    """A series of colour sections at known heights: every slice takes one within a step of its own height.

    In CT from the base of the skull down: above it the phantom's CT, like a patient's, shows an even oval in a ring of bone.
    """
    from MedColorLib import Settings
    from MedColorLib.phantom import sample, section
    from MedColorLib.progress import Run
    from MedColorLib.run.engine import Engine
    from MedColorLib.run.prepare import prepare

    levels = np.linspace(-0.9, 0.8, 8)
    volume, _ = sample(modality)
    prepared = prepare(volume, [section(level) for level in levels], Settings(preset="draft", features="embedded"))
    engine = Engine(prepared, Run(None, None))
    assert engine.assigned == "along the series"
    slices = np.array(prepared.plan.slices)
    own, height = np.array([levels[engine.choice[k]] for k in slices]), slices / 47 * 2 - 1
    assert np.abs(own - height)[height < up_to].max() < 0.25
    assert (np.diff([engine.choice[k] for k in slices]) >= 0).all()


def photographed(grey, mask, rng):
    """A slice as a photograph of it might look: another order of grey values, bent, a little noise."""
    import cv2

    seen = np.interp(grey, [0, 0.3, 0.5, 0.7, 1], [0, 0.35, 0.55, 0.45, 0.9]).astype(np.float32) * mask
    rows, cols = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(np.float32)
    rows, cols = rows + 6 * np.sin(cols / 40), cols + 6 * np.sin(rows / 50)
    return cv2.remap(seen + rng.normal(0, 0.01, seen.shape).astype(np.float32) * mask, cols, rows, cv2.INTER_LINEAR)


@pytest.fixture(scope="module")
def head(request):
    """Greys and masks of the real head's slices on the raster, by slice number."""
    from MedColorLib import read_volume
    from MedColorLib.scan.body import find_body
    from MedColorLib.scan.grid import choose_grid
    from MedColorLib.scan.intensity import choose_window
    from MedColorLib.scan.slices import slice_on_grid, slice_order

    volume = read_volume(request.getfixturevalue("shared_data") / "vhf_head_ct.nrrd")
    view = slice_order(volume.ijk_to_ras).view(volume.array)
    body = find_body(view)
    sample = list(range(40, 220, 40))
    window = choose_window(view[sample], np.stack([body.plane(k) > 0.5 for k in sample]))
    return {k: slice_on_grid(view, body, window, choose_grid(256), k) for k in range(20, 221, 5)}


# per case: slices asked for, reference slices, order of the references
STACKS = {
    "whole": (range(20, 221, 5), range(20, 221, 10), 1),
    "reversed": (range(20, 221, 5), range(20, 221, 10), -1),
    "part of the series": (range(90, 151, 5), range(20, 221, 10), 1),
    "series is a part": (range(60, 221, 5), range(90, 181, 10), -1),
}


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize(
    ("features", "within_one"), [("embedded", 0.95), pytest.param("vgg19", 0.85, marks=pytest.mark.slow)]
)
def test_a_real_stack_whose_order_is_known(head, request, monkeypatch, rng, stack, features, within_one):
    """References 10 mm apart of a CT head's own slices, remapped and bent; truth is the nearest reference."""
    from MedColorLib.features import make_extractor, unit_descriptors

    if features == "vgg19":
        monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(request.getfixturevalue("shared_weights")))
    slices, references, direction = STACKS[stack]
    references = list(references)[::direction]
    extractor = make_extractor(features)
    library = unit_descriptors(extractor, (photographed(*head[k], rng) for k in references))
    queries = unit_descriptors(extractor, (head[k][0] for k in slices))
    choice, name = assign(queries @ library.T)
    assert name == ("along the series" if direction == 1 else "against the series")
    nearest = np.clip(slices, min(references), max(references))
    error_mm = np.abs(np.array(references)[choice] - nearest)
    assert (error_mm <= 10).mean() >= within_one and error_mm.mean() < 7


@pytest.mark.parametrize("stack", ["whole", "reversed", "part of the series"])
def test_a_stack_made_by_formula_whose_order_is_known(rng, stack):
    """As above with the phantom: 24 slices 8 mm apart, references 16 mm apart."""
    from MedColorLib.features import make_extractor, unit_descriptors
    from MedColorLib.phantom import sample
    from MedColorLib.scan.body import find_body
    from MedColorLib.scan.grid import choose_grid
    from MedColorLib.scan.intensity import Window
    from MedColorLib.scan.slices import slice_on_grid, slice_order

    volume, _ = sample()
    view = slice_order(volume.ijk_to_ras).view(volume.array)
    body = find_body(view)
    stack_of = {k: slice_on_grid(view, body, Window(-100, 900, "given"), choose_grid(256), k) for k in range(2, 46, 2)}
    slices = np.array(sorted(stack_of)) if stack != "part of the series" else np.arange(14, 32, 2)
    references = np.arange(2, 46, 4)[:: -1 if stack == "reversed" else 1]
    extractor = make_extractor("embedded")
    library = unit_descriptors(extractor, (photographed(*stack_of[k], rng) for k in references))
    queries = unit_descriptors(extractor, (stack_of[k][0] for k in slices))
    choice, name = assign(queries @ library.T)
    error = np.abs(references[choice] - slices)
    assert name == ("against the series" if stack == "reversed" else "along the series")
    assert (error <= 4).mean() >= 0.9
