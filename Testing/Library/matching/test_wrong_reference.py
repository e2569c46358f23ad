"""A reference of another part of the body, or of no body, is noticed; the right one is not."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib import Settings, Volume, colorize
from MedColorLib.matching.orientation import GUESS, WAYS, Lie, laid
from MedColorLib.matching.wrong_reference import doubts, outline

pytestmark = pytest.mark.usefixtures("small_raster")
LEVEL = dict.fromkeys(WAYS, 0.0)
SURE, LOST = Lie("as it is", 0.05, LEVEL), Lie("as it is", 0.002, LEVEL)


def ellipse(height: float, width: float, side: int = 120, centre=(0.0, 0.0)) -> np.ndarray:
    rows, cols = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    return ((rows - centre[0]) / height) ** 2 + ((cols - centre[1]) / width) ** 2 < 1


def of(mask: np.ndarray):
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return outline(mask, (np.ptp(rows) + 1, np.ptp(cols) + 1))


HEAD, TRUNK = of(ellipse(0.6, 0.5)), of(ellipse(0.35, 0.55))


def test_alike_is_not_doubted():
    assert doubts([HEAD] * 3, of(ellipse(0.62, 0.48)), SURE) == []


def test_head_and_trunk_have_other_proportions():
    for scan, picture in ((HEAD, TRUNK), (TRUNK, HEAD)):
        (why,) = doubts([scan] * 3, picture, SURE)
        assert "proportions" in why


def test_a_picture_on_its_side_is_compared_upright():
    lying = of(laid(ellipse(0.35, 0.55), "turned left"))
    assert doubts([TRUNK] * 3, lying, Lie("turned left", 0.05, by_quarter(odd=0.09))) == []
    assert doubts([TRUNK] * 3, lying, SURE) != []


def by_quarter(odd: float) -> dict[str, float]:
    """Scores that tell quarter turns, and nothing else."""
    return {way: odd if quarters % 2 else 0.0 for way, (quarters, _) in WAYS.items()}


def test_a_picture_that_seems_to_lie_on_its_side_must_fit_clearly_better_so():
    """Wood, bread and mosaics fit on their side as well as any other way, right photographs do not."""
    lying, lie = of(laid(ellipse(0.35, 0.55), "turned left")), Lie("turned left", 0.05, by_quarter(odd=0.06))
    (why,) = doubts([TRUNK] * 3, lying, lie)
    assert "one way up" in why
    assert doubts([TRUNK] * 3, TRUNK, Lie("turned by half", 0.05, by_quarter(odd=-0.06))) == []
    assert doubts([TRUNK] * 3, lying, lie, best_margin=np.inf) == []  # which way up says nothing
    assert doubts([TRUNK] * 3, lying, lie, best_margin=0.06) == []  # another one of the series fits better


def test_arms_beside_a_trunk_do_not_count_even_where_they_touch():
    arms = ellipse(0.35, 0.55) | ellipse(0.2, 0.14, centre=(0, -0.68)) | ellipse(0.2, 0.14, centre=(0, 0.68))
    assert of(arms).proportion == pytest.approx(TRUNK.proportion, abs=0.1)
    assert doubts([TRUNK] * 3, of(arms), SURE) == []


def test_a_picture_without_outline():
    wedge = np.tri(60, 60, dtype=bool)
    assert any("outline" in why for why in doubts([HEAD] * 3, of(wedge), SURE))


def test_a_field_of_view_without_air_has_no_outline_to_compare():
    full = outline(np.ones((60, 60), bool), (60, 60))
    assert doubts([full] * 3, HEAD, SURE) == []


def test_no_way_up_fits_better():
    (why,) = doubts([HEAD], HEAD, LOST)
    assert "one way up" in why
    assert doubts([HEAD], HEAD, LOST, best_margin=2 * GUESS) == []


def test_a_trunk_that_is_nearly_as_likely_upside_down_is_right_where_quarter_turns_are_not():
    upright = {way: 0.15 if quarters % 2 == 0 else 0.0 for way, (quarters, _) in WAYS.items()}
    assert doubts([TRUNK], TRUNK, Lie("turned by half", 0.0151, upright)) == []
    assert doubts([TRUNK], TRUNK, Lie("turned by half", 0.0151, LEVEL)) != []
    assert doubts([TRUNK], TRUNK, Lie("turned by half", 0.005, upright)) != []


def test_small_slices_at_the_ends_say_nothing():
    """The cerebellum alone is as wide as a trunk."""
    wide = [of(ellipse(0.15, 0.25))] * 3
    assert wide[0].area < 0.4 * HEAD.area
    assert doubts([*wide, HEAD, HEAD, HEAD], TRUNK, SURE) != []
    assert doubts([*wide, HEAD, HEAD, HEAD], HEAD, SURE) == []


def test_a_quarter_of_the_slices_must_fit():
    assert doubts([TRUNK, TRUNK, HEAD, HEAD], HEAD, SURE) == []
    assert doubts([TRUNK] * 7 + [HEAD], HEAD, SURE) != []


def test_report_log_and_plan(ct, caplog):
    volume = Volume(ct.volume.array[3:8], ct.volume.ijk_to_ras)
    settings = Settings(preset="draft", features="embedded", device="cpu")
    assert colorize(volume, [ct.reference], settings).report["reference_warnings"] == []
    flat = np.repeat(np.repeat(ct.reference, 3, axis=1), 2, axis=1)  # as wide as no head
    report = colorize(volume, [flat], settings).report
    (entry,) = report["reference_warnings"]
    assert set(entry) == {"reference", "slices", "why", "remedy"} and entry["slices"] == [0, 4]
    assert "proportions" in entry["why"] and entry["why"] in caplog.text
    assert any(entry["why"] in text for text in report["plan"]["warnings"])
