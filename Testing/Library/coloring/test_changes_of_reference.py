"""Changes of reference along the stack: colour passes without a seam, and no slice is matched with two references."""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from MedColorLib import Settings, Volume, colorize, make_plan
from MedColorLib.bench.slabs import equal_voxels, flicker
from MedColorLib.coloring.coherence import GUIDE_SIGMA, REACH_SIGMAS, shares_near_changes
from MedColorLib.coloring.transfer import SliceMatch
from MedColorLib.phantom import TISSUES, labels, section
from MedColorLib.run.engine import Engine
from MedColorLib.run.paint import PassingColors
from MedColorLib.run.prepare import prepare


@given(
    st.lists(st.integers(1, 9), min_size=1, max_size=5), st.sampled_from([0.0, 0.4, 1.0, 2.5]), st.sampled_from([1, 3])
)
def test_shares_fall_from_the_change_to_the_reach(lengths, sigma, step):
    reference_of = {step * n: run for n, run in enumerate(np.repeat(np.arange(len(lengths)), lengths).tolist())}
    got = shares_near_changes(reference_of, 0.5, 0.5 * sigma)
    assert list(got) == sorted(got)
    for k in reference_of:
        away = [
            abs(k - n - step / 2)
            for n in reference_of
            if n + step in reference_of and reference_of[n] != reference_of[n + step]
        ]
        expected = max([1 - (a / (REACH_SIGMAS * sigma)) ** 2 for a in away if a < REACH_SIGMAS * sigma], default=0)
        assert got.get(k, 0) == pytest.approx(expected)


def test_matched_colours_pass_near_a_change_alone(rng):
    """Pixel by pixel, by its own words; elsewhere, and outside the body, nothing is touched."""
    choice = {k: 0 if k < 8 else 1 for k in range(16)}
    lab, grey = rng.uniform(0, 60, (16, 3, 4, 3)).astype(np.float32), rng.random((16, 3, 4)).astype(np.float32)
    mask = rng.random((16, 3, 4)) < 0.7
    passing, got = PassingColors(choice, range(16), 1.0, 1.5), {}
    for k in range(0, 16, 2):
        got.update(passing.add({n: SliceMatch(lab[n], grey[n], mask[n]) for n in (k, k + 1)}))
    assert sorted(got) == list(range(16))
    shares = {k: 1 - (abs(k - 7.5) / 3) ** 2 for k in range(5, 11)}
    for k, match in got.items():
        np.testing.assert_array_equal(match.lab[~mask[k]], lab[k][~mask[k]])
        if k not in shares:
            np.testing.assert_array_equal(match.lab, lab[k])
            continue
        for row, col in zip(*np.nonzero(mask[k])):
            near = [n for n in shares if abs(n - k) <= 3 and mask[n, row, col]]
            affinity = [abs(grey[n, row, col] - grey[k, row, col]) * 255 / GUIDE_SIGMA for n in near]
            weights = np.exp([-0.5 * ((n - k) / 1.5) ** 2 - a for n, a in zip(near, affinity)])
            mean = weights @ lab[near, row, col] / weights.sum()
            expected = lab[k, row, col] + shares[k] * (mean - lab[k, row, col])
            np.testing.assert_allclose(match.lab[row, col], expected, rtol=1e-4, atol=1e-4)


def tinted_series(strength: float = 0.04, count: int = 4) -> list[np.ndarray]:
    """Small sections from the feet up, taken in turns in warmer and in cooler light."""
    pictures = []
    for number, level in enumerate(np.linspace(-0.7, 0.3, count)):
        picture = cv2.resize(section(level), (124, 132), interpolation=cv2.INTER_AREA)
        light = 1 + strength * np.array([1, 0, -1]) * (1 if number % 2 else -1)
        gelatin = (picture[..., 2] > picture[..., 0])[..., None]
        pictures.append(np.where(gelatin, picture, np.clip(picture * light, 0, 255)).astype(np.uint8))
    return pictures


def head() -> Volume:
    """The phantom's head with the noise of a scan, from the jaw to the ventricles."""
    anatomy = labels((64, 64, 56))[8:48]
    table = np.array([tissue[0] for tissue in TISSUES.values()], float)
    noise = np.random.default_rng(0).normal(0, 12, anatomy.shape)
    array = np.rint(gaussian_filter(table[anatomy], (0.6, 0.3, 0.3)) + noise).astype(np.int16)
    return Volume(array, np.diag([-3.2, -3.2, 3.0, 1.0]))


def jumps(result, prepared) -> tuple[float, float]:
    """Median CIEDE2000 between neighbouring slices at voxels of equal grey: at changes of reference, elsewhere."""
    pairs, rgb = equal_voxels(prepared), prepared.order.view(result.rgb)
    name_of = {int(k): name for k, name in result.report["reference_of_slice"].items()}
    found: dict[bool, list[float]] = {True: [], False: []}
    for k in range(len(pairs)):
        found[name_of[k] != name_of[k + 1]].append(flicker(rgb[k : k + 2], pairs[k : k + 1]))
    assert (len(found[True]), len(found[False])) == (3, 36) and pairs.sum((1, 2)).min() > 30
    return float(np.median(found[True])), float(np.median(found[False]))


def settings(**changes) -> Settings:
    return Settings(**{"preset": "draft", "features": "embedded", **changes})


@pytest.mark.usefixtures("small_raster")
@pytest.mark.parametrize("changes", [{}, {"smoother": "guided"}], ids=["evidence", "matched colours"])
def test_no_seam_and_no_slice_matched_twice(changes, monkeypatch):
    """What is averaged along the stack. Jump at changes over that elsewhere, measured: 1.5 and 1.9; 3.8 and 7.5 apart."""
    matched, match = Counter(), Engine._match_part

    def counted(engine, ks, *arguments):
        matched.update(ks)
        return match(engine, ks, *arguments)

    monkeypatch.setattr(Engine, "_match_part", counted)
    monkeypatch.setattr("MedColorLib.run.engine.assign", lambda alike: (np.arange(40) // 10, "along the series"))
    volume, series = head(), tinted_series()
    prepared = prepare(volume, series, settings(**changes))
    result = colorize(volume, series, settings(**changes))
    assert matched == dict.fromkeys(range(40), 1)
    at_changes, elsewhere = jumps(result, prepared)
    apart = jumps(colorize(volume, series, settings(coherence_mm=0.0, **changes)), prepared)
    assert at_changes <= 2 * elsewhere
    assert apart[0] > 2 * apart[1], "without the average there is a seam to be seen"


def test_the_plan_says_so(ct):
    small = [cv2.resize(picture, (62, 66), interpolation=cv2.INTER_AREA) for picture in tinted_series(0)]

    def plan(count, **changes):
        return make_plan(ct.volume, small[:count], settings(**changes))

    assert plan(4).steps["coherence"].endswith("across changes of reference")
    assert "changes" not in plan(1).steps["coherence"]
    assert "near changes of reference" in plan(2, smoother="guided").steps["coherence"]
    assert plan(1, smoother="guided").steps["coherence"] == "each slice by itself"
    assert "colours jump where the reference changes" in plan(2, coherence_mm=0.0).steps["coherence"]
    for count, changes, expected in ((4, {}, 1), (2, {}, 1), (1, {}, 0), (4, {"coherence_mm": 0.0}, 0)):
        assert len([e for e in plan(count, **changes).left_out if "second match" in e.what]) == expected
