"""Time points of a series: which of them are matched, and that the colours of the others are as good."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pipeline_samples import part, settings

from MedColorLib import Guard, Volume, colorize, colorize_time_points
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.lab import srgb_to_lab
from MedColorLib.errors import Cancelled, InputError
from MedColorLib.phantom import section
from MedColorLib.run.engine import Engine
from MedColorLib.run.timepoints import BLOCKS, SAME, Seen, likeness

pytestmark = pytest.mark.usefixtures("small_raster")


@pytest.fixture
def matched(monkeypatch) -> list[tuple]:
    """The slices that were matched, batch by batch; for what is learned of a reference, none."""
    found, real = [], Engine._correspondence
    monkeypatch.setattr(Engine, "_correspondence", lambda *a: found.append(len(a[2])) or real(*a))
    return found


def bent(volume: Volume, pixels: float) -> Volume:
    """The same body, bent within its slices by at most so many pixels."""
    rows, cols = np.mgrid[: volume.array.shape[1], : volume.array.shape[2]].astype(np.float32)
    moved = cols + pixels * np.sin(2 * np.pi * rows / len(rows)).astype(np.float32)
    planes = [
        cv2.remap(p.astype(np.float32), moved, rows, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE) for p in volume.array
    ]
    return Volume(np.rint(planes).astype(volume.array.dtype), volume.ijk_to_ras, name=f"bent by {pixels:g}")


def slowly(first: Seen, second: Seen) -> float:
    """`likeness`, block by block, position by position."""
    worst = 0.0
    for grey, cover, other, other_cover in zip(*first, *second):

        def weighted(values, both):
            mean = (values * both).sum() / both.sum()
            return (values - mean) / np.sqrt(((values - mean) ** 2 * both).sum() / both.sum())

        both = np.minimum(cover, other_cover)
        change = (weighted(grey, both) - weighted(other, both)) ** 2
        for rows in np.array_split(np.arange(len(grey)), BLOCKS):
            for cols in np.array_split(np.arange(grey.shape[1]), BLOCKS):
                total = inside = 0.0
                for row in rows:
                    for col in cols:
                        weight = max(cover[row, col], other_cover[row, col])
                        total, inside = total + weight * change[row, col], inside + weight
                if inside >= 0.2 * len(rows) * len(cols):
                    worst = max(worst, total / inside / 2)
    return 1 - worst


class TestLikeness:
    def seen(self, rng, slices=3):
        cover = np.zeros((slices, 20, 22))
        cover[:, 2:-3, 3:-2] = 1
        return Seen(rng.random(cover.shape) * cover, cover)

    def test_as_slowly(self, rng):
        one, other = self.seen(rng), self.seen(rng)
        assert likeness(one, other) == pytest.approx(slowly(one, other))
        near = Seen(0.9 * one.grey + 0.1 * other.grey, one.cover)
        assert likeness(one, near) == pytest.approx(slowly(one, near))
        assert likeness(one, other) < SAME < likeness(one, near)

    def test_gain_and_offset_are_no_change(self, rng):
        one = self.seen(rng)
        assert likeness(one, one) == pytest.approx(1)
        assert likeness(one, Seen((0.3 * one.grey + 0.2) * one.cover, one.cover)) == pytest.approx(1)

    def test_what_changes_in_one_place_of_one_slice_counts(self, rng):
        one = self.seen(rng)
        grey = one.grey.copy()
        grey[1, 8:11, 9:12] = 1 - grey[1, 8:11, 9:12]
        assert likeness(one, Seen(grey, one.cover)) < SAME

    def test_a_slice_without_body_on_one_side(self, rng):
        one = self.seen(rng)
        cover = one.cover.copy()
        cover[0] = 0
        assert likeness(one, Seen(one.grey * cover, cover)) <= 0
        assert likeness(Seen(one.grey * cover, cover), Seen(one.grey * cover, cover)) == pytest.approx(1)


def test_nearly_the_same_is_matched_once(ct, matched, caplog):
    caplog.set_level("INFO")
    first = part(ct)
    series = [first, bent(first, 0.2), bent(first, 12)]
    results = list(colorize_time_points(series, [ct.reference], settings()))
    said = [result.report["time_point"] for result in results]
    assert [one["matches_of"] for one in said] == [1, 1, 3]
    assert said[0]["likeness"] is None and said[1]["likeness"] > SAME > said[2]["likeness"]
    for result in results:
        result.report.pop("time_point")
    together, alone = sum(matched), []
    for volume in series:
        matched.clear()
        alone.append(colorize(volume, [ct.reference], settings()))
    assert together == sum(matched) + len(alone[0].report["plan"]["slices"])
    for n in (0, 2):
        np.testing.assert_array_equal(results[n].rgb, alone[n].rgb)
    inside = results[1].rgb.any(-1) & alone[1].rgb.any(-1)
    assert ciede2000(*(srgb_to_lab(one[1].rgb)[inside] for one in (results, alone))).mean() < 1.0
    assert "time point 2 of 3: takes the matches of time point 1" in caplog.text
    plans = [result.report["plan"] for result in results]
    assert "takes the matches of time point 1" in plans[1]["steps"]["time point"]
    assert [sum("this time point" in entry["what"] for entry in plan["left_out"]) for plan in plans] == [0, 1, 0]


def test_colours_are_those_of_its_own_grey(ct):
    """A lesion that lights up in the second time point (too small for a block) is seen there."""
    first = part(ct)
    array = first.array.copy()
    body = np.argwhere(colorize(first, [ct.reference], settings()).rgb[2].any(-1))
    row, col = body[len(body) // 2]
    array[2, row, col] = array.max()
    second = Volume(array, first.ijk_to_ras)
    results = list(colorize_time_points([first, second], [ct.reference], settings(luminance="keep")))
    assert results[1].report["time_point"]["matches_of"] == 1
    assert results[1].rgb[2, row, col].sum() > results[0].rgb[2, row, col].sum() + 60


@pytest.mark.parametrize("kind", ["guard", "references", "slices of its own", "a finer preset"])
def test_with_everything_else(ct, kind, matched):
    first = part(ct)
    options, references, changes = {}, [ct.reference], {}
    second = bent(first, 0.2)
    if kind == "guard":
        options["guard"] = Guard(Volume((first.array > 0).astype(np.uint8), first.ijk_to_ras))
    elif kind == "references":
        references = [section(-0.45), ct.reference]
    elif kind == "slices of its own":
        array = first.array.copy()
        array[0] = array.min()
        first = Volume(array, first.ijk_to_ras)
    else:
        changes = {"smoother": "guided", "confidence": True, "preset": "full"}
    results = list(colorize_time_points([first, second], references, settings(**changes), **options))
    assert [result.report["time_point"]["matches_of"] for result in results] == [1, 1]
    counts = [len(result.report["plan"]["slices"]) for result in results]
    assert (counts[0] < counts[1]) == (kind == "slices of its own")
    assert sum(matched) < sum(counts) + 5
    assert all(result.rgb[-1].any() for result in results)


def test_progress_cancel_and_memory_of_the_engine(ct):
    first, seen = part(ct), []
    series = [first, bent(first, 0.2), bent(first, 0.1)]
    results = colorize_time_points(series, [ct.reference], settings(), progress=lambda *step: seen.append(step))
    next(results)
    assert max(fraction for fraction, _ in seen) == pytest.approx(1 / 3)
    assert len(list(results)) == 2
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions) and fractions[-1] == 1
    assert seen[-1][1].startswith("time point 3 of 3: ")
    calls = []
    with pytest.raises(Cancelled):
        list(
            colorize_time_points(
                series, [ct.reference], settings(), cancelled=lambda: calls.append(1) or len(calls) > 90
            )
        )


def test_what_cannot_be_a_series(ct):
    first = part(ct)
    thicker = Volume(first.array, first.ijk_to_ras @ np.diag([1, 1, 2, 1]), name="thicker")
    with pytest.raises(InputError, match="no volume"):
        list(colorize_time_points([], [ct.reference], settings()))
    with pytest.raises(InputError, match=r"thicker \(number 2\) lies on another grid .* one by one"):
        list(colorize_time_points([first, thicker], [ct.reference], settings()))
    (only,) = colorize_time_points([first], [ct.reference], settings())
    np.testing.assert_array_equal(only.rgb, colorize(first, [ct.reference], settings()).rgb)
    assert "time point" not in only.report["plan"]["steps"]
