"""Orientation: a photograph that lies another way is turned, one that lies well is left; and time is estimated."""

from __future__ import annotations

import numpy as np
import pytest

from MedColorLib import Settings, Volume, colorize
from MedColorLib.color.lab import srgb_to_lab
from MedColorLib.matching.orientation import WAYS, choose_way, turned
from MedColorLib.run.estimate import estimate

pytestmark = pytest.mark.usefixtures("small_raster")
DRAFT = Settings(preset="draft", features="embedded", device="cpu")


@pytest.mark.parametrize("way", WAYS)
def test_turning_twice_is_nothing(way, rng):
    picture = rng.random((5, 7, 3))
    once = turned(picture, way)
    np.testing.assert_array_equal(turned(once, way), picture)
    assert once.flags["C_CONTIGUOUS"] and (way == "as it is") == np.array_equal(once, picture)


@pytest.mark.parametrize(("rows", "way"), [(1, "as it is"), (-1, "upside down")])
def test_phantom_face_up_and_face_down(ct, rows, way):
    volume = Volume(ct.volume.array[3:8], ct.volume.ijk_to_ras)
    result = colorize(volume, [ct.reference[::rows]], DRAFT)
    assert result.report["reference_lies"] == {"reference 1": way}


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
