"""A run that is cancelled ends inside a batch of slices, which may take a minute at full depth."""

from __future__ import annotations

import threading

import pytest
import torch

from MedColorLib.errors import Cancelled
from MedColorLib.matching import analogy
from MedColorLib.matching.analogy import deep_image_analogy
from MedColorLib.matching.fields import patches
from MedColorLib.progress import Run, check


def match(fine_search="windowed"):
    generator = torch.Generator().manual_seed(0)
    features = {n: torch.randn(2, 8, 3 * 2 ** (5 - n), 4 * 2 ** (5 - n), generator=generator) for n in range(5, 0, -1)}
    reference = {layer: values[:1] for layer, values in features.items()}
    masks = torch.ones(2, 48, 64, dtype=torch.bool), torch.ones(48, 64, dtype=torch.bool)
    return deep_image_analogy(features, reference, *masks, 1, fine_search=fine_search)


@pytest.fixture(autouse=True)
def no_exact_below_layer_5(monkeypatch):
    monkeypatch.setattr(analogy, "EXACT_LIMIT", 1)


def asked_during(work, until=None):
    """How often the run was asked whether it is cancelled; from the `until`-th time on it says so."""
    count = [0]

    def cancelled():
        count[0] += 1
        return until is not None and count[0] > until

    with Run(None, cancelled).timed("matching"):
        work()
    return count[0]


@pytest.mark.parametrize("fine_search", ["windowed", "patchmatch"])
def test_every_layer_asks(fine_search):
    times = asked_during(lambda: match(fine_search))
    assert times > 20
    for until in (0, times // 2, times - 1):
        with pytest.raises(Cancelled):
            asked_during(lambda: match(fine_search), until)


def test_search_by_whole_patches_asks():
    """As the own features are searched where the processor multiplies bfloat16."""
    generator = torch.Generator().manual_seed(0)
    target, reference = (torch.randn(1, 4, 40, 40, generator=generator) for _ in range(2))
    inside = torch.ones(1, 40, 40, dtype=torch.bool)

    def work():
        patches.search(target, reference, 1, inside, inside, inside[0], both=True)

    assert asked_during(work) >= 3
    with pytest.raises(Cancelled):
        asked_during(work, 1)


def test_only_what_works_for_the_run_is_stopped():
    """Neither other threads nor what comes after the stage."""
    other = []
    run = Run(None, lambda: True)
    with run.timed("matching"):
        thread = threading.Thread(target=lambda: other.append(check()))
        thread.start()
        thread.join()
        with pytest.raises(Cancelled):
            check()
        with Run(None, lambda: False).timed("matching"):
            check()
        with pytest.raises(Cancelled):
            check()
    check()
    assert other == [None]
