"""The benchmark's measures of detail, place and wrong references, each against a synthetic case whose answer is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from MedColorLib import ColorVolume, Volume
from MedColorLib.bench import front_back, wrong_references
from MedColorLib.bench.detail import detail_of, noise_level
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.gamut import lab_to_srgb_in_gamut
from MedColorLib.errors import InputError


@pytest.fixture(scope="module")
def scan() -> np.ndarray:
    """L* (2, 128, 128): a bright disc on a darker ground, texture in one half of each, noise everywhere."""
    rng = np.random.default_rng(3)
    rows, cols = np.mgrid[:128, :128]
    plane = np.where(np.hypot(rows - 64, cols - 64) < 30, 70.0, 40.0)
    plane += np.where(rows < 64, 6 * np.sin(cols / 2.0), 0)
    return plane + rng.normal(0, 0.5, (2, 128, 128))


@pytest.fixture(scope="module")
def body() -> np.ndarray:
    inside = np.zeros((2, 128, 128), bool)
    inside[:, 6:-6, 6:-6] = True
    return inside


def _smooth(planes: np.ndarray, width: float) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(planes, (0, width, width))


class TestDetail:
    def test_the_scan_itself(self, scan, body):
        result = detail_of(scan, scan, body)
        assert (result.correlation, result.noise, result.halo) == pytest.approx((1, 1, 0))
        assert 0.3 < result.share < 0.8  # the half without texture has noise and the disc's edge alone

    def test_tissues_may_change_their_order_and_their_contrast(self, scan, body):
        for changed in (90 - scan, 20 + 0.4 * scan):
            assert detail_of(scan, changed, body).correlation == pytest.approx(1)

    def test_lost_and_foreign_detail(self, scan, body, rng):
        blurred = detail_of(scan, _smooth(scan, 6), body)
        foreign = detail_of(scan, rng.normal(50, 5, scan.shape), body)
        flat = detail_of(scan, np.full(scan.shape, 50.0), body)
        assert blurred.correlation < 0.8
        assert foreign.correlation < 0.2
        assert (flat.correlation, flat.noise) == (0, 0)

    def test_noise_is_measured_as_it_is_amplified(self, scan, body):
        smooth = _smooth(scan, 1.5)
        assert detail_of(scan, smooth + 3 * (scan - smooth), body).noise == pytest.approx(3, rel=0.1)
        assert detail_of(scan, smooth, body).noise < 0.3

    def test_halo_is_what_an_edge_spreads(self, scan, body):
        clean = np.where(np.hypot(*(np.mgrid[:128, :128] - 64)) < 30, 70.0, 40.0) + np.zeros((2, 1, 1))
        spread = detail_of(clean, clean - _smooth(clean, 8), body)
        steep = detail_of(clean, 2 * clean - 40, body)
        assert steep.halo < 0.2
        assert spread.halo > 3

    def test_what_lies_outside_the_body_does_not_count(self, scan, body):
        other = np.where(body, scan, 3.0)
        assert detail_of(scan, other, body).correlation == pytest.approx(1)

    def test_noise_level_is_the_deviation_of_the_noise(self, rng):
        ramp = np.add.outer(np.arange(200.0), 2 * np.arange(200.0))
        assert noise_level(ramp + rng.normal(0, 2, ramp.shape), np.ones(ramp.shape, bool)) == pytest.approx(2, rel=0.05)


class TestFrontAgainstBack:
    FRONT, BACK = [((4, 4), (59, 4), (59, 20), (4, 20))], [((4, 40), (59, 40), (59, 58), (4, 58))]

    def _score(self, color):
        """`color(grey, behind)` gives L*, a*, b* for a slice whose L* runs from 40 to 60 along the columns."""
        grey = np.broadcast_to(np.linspace(40, 60, 64), (3, 64, 64))
        behind = (np.arange(64) > 32)[None, :, None]
        lab = np.stack(np.broadcast_arrays(*color(grey, behind)), -1).astype(float)
        return front_back.front_back_of(lab_to_srgb_in_gamut(lab)[0], grey, self.FRONT, self.BACK)

    def test_colour_that_follows_grey_alone_is_the_same_everywhere(self):
        result = self._score(lambda grey, behind: (grey, grey / 4, 20 + 0 * grey))
        assert (result.same_lightness, result.same_grey) == pytest.approx((0, 0), abs=1e-9)

    def test_hue_that_follows_place_is_found(self):
        result = self._score(lambda grey, behind: (grey, 14 + 0 * grey, np.where(behind, 25, 15)))
        apart = float(ciede2000([50.0, 14, 25], [50.0, 14, 15]))
        assert result.same_lightness == pytest.approx(apart, abs=0.4)
        assert result.same_grey == pytest.approx(apart, abs=0.4)

    def test_lightness_that_follows_place_shows_at_equal_grey_alone(self):
        result = self._score(lambda grey, behind: (np.where(behind, grey + 8, grey), 14 + 0 * grey, 18 + 0 * grey))
        assert result.same_lightness < 0.5
        assert 6 < result.same_grey < 9

    def test_without_anything_in_common_there_is_no_number(self):
        result = self._score(lambda grey, behind: (np.where(behind, grey + 30, grey), 0 * grey, 0 * grey))
        assert np.isnan(result.same_lightness)

    def test_steps_that_hardly_a_voxel_holds_do_not_count(self):
        colors = np.array([[50.0, 0, 0]] * 100 + [[60.0, 0, 0]] * 3)
        other = colors + np.where(colors[:, :1] == 60, [0, 40, 0], [0, 0, 0])
        assert front_back.apart(colors, other, colors[:, 0], other[:, 0]) == 0


class TestWrongReferences:
    def _cases(self, monkeypatch, warned):
        volume = Volume(np.zeros((20, 8, 8), np.int16))
        monkeypatch.setattr(wrong_references, "load", lambda _path: volume)

        def colorize(volume, references, settings):
            said = warned(references[0])
            return ColorVolume(
                np.zeros((20, 8, 8, 3), np.uint8), volume.ijk_to_ras, {wrong_references.WARNINGS_KEY: said}
            )

        return wrong_references.wrong_references(colorize, Path(), volumes=["chest_ct.nrrd"])

    def test_a_perfect_and_a_blind_judge(self, monkeypatch):
        def fits(reference):
            return isinstance(reference, str) and "thorax" in reference

        assert wrong_references.rates(self._cases(monkeypatch, lambda r: [] if fits(r) else ["not a chest"])) == (1, 0)
        assert wrong_references.rates(self._cases(monkeypatch, lambda r: [])) == (0, 0)
        assert wrong_references.rates(self._cases(monkeypatch, lambda r: ["beware"])) == (1, 1)

    def test_a_refused_picture_is_noticed(self, monkeypatch):
        def warned(reference):
            if not isinstance(reference, str):
                raise InputError("no tissue")
            return []

        cases = self._cases(monkeypatch, warned)
        assert {case.picture for case in cases if case.noticed} == set(wrong_references.foreign_pictures())
        assert all(case.said.startswith("refused") for case in cases if case.noticed)

    def test_foreign_pictures_are_pictures_of_something_that_a_reference_could_be(self):
        from MedColorLib.references.photograph import prepare_reference

        for name, picture in wrong_references.foreign_pictures().items():
            assert prepare_reference(picture, name).mask.mean() > 0.5, name
