"""Orientation: a photograph that lies another way is turned, one that lies well is left; and time is estimated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from MedColorLib import Settings, Volume, colorize
from MedColorLib.color.lab import srgb_to_lab
from MedColorLib.matching.orientation import (
    GUESS,
    PAIRS,
    WAYS,
    Lie,
    choose_way,
    common_way,
    find_way,
    inner_part,
    laid,
    mirrored_by_both,
    turned,
)
from MedColorLib.phantom import section
from MedColorLib.references.photograph import on_grid, prepare_reference
from MedColorLib.run.estimate import estimate
from MedColorLib.scan.grid import choose_grid

pytestmark = pytest.mark.usefixtures("small_raster")
DRAFT = Settings(preset="draft", features="embedded", device="cpu")


@pytest.mark.parametrize("way", WAYS)
def test_turned_undoes_what_laid_does(way, rng):
    picture = rng.random((5, 7, 3))
    lying = laid(picture, way)
    assert lying.shape == ((7, 5, 3) if "left" in way or "right" in way else (5, 7, 3))
    np.testing.assert_array_equal(turned(lying, way), picture)
    assert turned(lying, way).flags["C_CONTIGUOUS"] and (way == "as it is") == np.array_equal(lying, picture)


def test_the_eight_ways_are_eight(rng):
    picture = rng.random((6, 6))
    assert len({laid(picture, way).tobytes() for way in WAYS}) == 8


def test_ways_that_differ_in_left_and_right_only():
    """A picture whose halves are mirror images looks the same in both of a pair; its mirror image is the other one."""
    same, other = np.array([[1, 2, 1], [3, 4, 3], [5, 6, 5]]), np.arange(9).reshape(3, 3)
    for pair in PAIRS:
        np.testing.assert_array_equal(*(laid(same, way) for way in pair))
        np.testing.assert_array_equal(turned(laid(other, pair[0]), pair[1]), other[:, ::-1])
    assert sorted(way for pair in PAIRS for way in pair) == sorted(WAYS)


@pytest.fixture(scope="module")
def photograph() -> tuple[np.ndarray, np.ndarray]:
    grey, _, mask = on_grid(prepare_reference(section()), choose_grid(128))
    return grey, mask


@pytest.mark.parametrize("way", WAYS)
def test_all_eight_ways_are_found(way, photograph):
    """The same section with another contrast; left and right of the phantom are mirror images but for its noise."""
    grey, mask = photograph
    scan = np.where(mask, 1 - 0.8 * grey, 0).astype(np.float32)[None]
    lie = find_way(scan, mask[None], laid(grey, way), laid(mask, way))
    assert WAYS[lie.way][0] == WAYS[way][0] and lie.margin > GUESS and not lie.guess


@pytest.mark.parametrize("way", ["as it is", "upside down", "turned left"])
def test_a_head_without_scalp_and_skull(way, photograph):
    grey, mask = photograph
    inside, within = inner_part(np.where(mask, 1 - 0.8 * grey, 0).astype(np.float32), mask)
    lie = find_way(inside[None], within[None], laid(grey, way), laid(mask, way))
    assert lie.way in {"as it is": ("as it is",), "upside down": ("upside down", "turned by half")}.get(
        way, ("turned left", "turned left and mirrored")
    )


def test_a_disc_lies_as_it_is_and_that_is_a_guess():
    rows, cols = np.mgrid[-1:1:96j, -1:1:96j]
    disc = np.hypot(rows, cols) < 0.8
    lie = find_way((0.5 * disc).astype(np.float32)[None], disc[None], 0.7 * disc.astype(np.float32), disc)
    assert lie.way == "as it is" and lie.guess and "a guess" in lie.describe()


def test_a_series_lies_as_most_of_it(photograph):
    grey, mask = photograph
    lies = [
        find_way(grey[None], mask[None], laid(grey, way), laid(mask, way))
        for way in ("upside down",) * 2 + ("as it is",)
    ]
    assert common_way(lies).way in ("upside down", "turned by half")


@pytest.mark.parametrize("truth", ["mirrored", "upside down", "turned left and mirrored"])
def test_mirrored_only_where_the_own_features_say_so_too(truth, rng):
    """One half of a disc is striped, so that left and right differ: self-similarity is said to be wrong, or right."""
    rows, cols = np.mgrid[-1:1:128j, -1:1:128j]
    mask = np.hypot(rows, cols * 1.2) < 0.8
    grey = np.where(cols < 0, 0.5 + 0.4 * np.sin(40 * rows), 0.5 + 0.2 * rows + 0.1 * cols).astype(np.float32) * mask
    plain = {"mirrored": "as it is", "upside down": "turned by half"}.get(truth, "turned left")
    said = Lie(truth, 0.05, dict.fromkeys(WAYS, 0.0))
    for lies in (truth, plain):
        found = mirrored_by_both(said, (1 - grey)[None], mask[None], laid(grey, lies), laid(mask, lies))
        assert found == replace(said, way=lies)
    not_mirrored = replace(said, way=plain)
    assert mirrored_by_both(not_mirrored, grey[None], mask[None], laid(grey, truth), laid(mask, truth)) is not_mirrored


@pytest.mark.parametrize("way", ["as it is", "upside down", "turned left and mirrored"])
def test_phantom_face_up_and_face_down(ct, way):
    volume = Volume(ct.volume.array[3:8], ct.volume.ijk_to_ras)
    result = colorize(volume, [laid(ct.reference, way)], DRAFT)
    sides = {"upside down": "turned by half", "turned left and mirrored": "turned left"}
    assert result.report["reference_lies"]["reference 1"] in (way, sides.get(way))
    assert ("orientation" in result.report["plan"]["steps"]) == (way != "as it is")


def test_a_turned_reference_gives_the_colors_of_the_right_one(ct):
    volume = Volume(ct.volume.array[3:8], ct.volume.ijk_to_ras)
    right, wrong = (colorize(volume, [ct.reference[::rows]], DRAFT) for rows in (1, -1))
    difference = np.abs(srgb_to_lab(right.rgb) - srgb_to_lab(wrong.rgb))[ct.labels[3:8] > 0]
    assert difference.mean() < 1


def test_own_way_where_nothing_speaks_for_another(rng):
    greys, masks = rng.random((2, 64, 64)).astype(np.float32), np.ones((2, 64, 64), bool)
    assert choose_way(greys, masks, np.full((64, 64), 0.5, np.float32), np.ones((64, 64), bool)) == "as it is"


def test_estimate_counts_the_slices_that_will_be_matched(ct):
    array = ct.volume.array[[3, 4, 4, 5, 6]]
    expected = estimate(Volume(array, ct.volume.ijk_to_ras), [ct.reference], DRAFT)
    assert expected.slices == 4
    assert 0 < expected.seconds_per_slice < expected.low <= expected.seconds <= expected.high
    assert expected.text().startswith("about ") and expected.text().endswith(" for 4 slices")
