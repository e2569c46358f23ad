"""The benchmark's measures of what a viewer sees, each against a synthetic case whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from MedColorLib import ColorVolume, Settings, Volume
from MedColorLib.bench import chroma_pairs, seen, slab_ends, trivial
from MedColorLib.bench.drawn_regions import HEAD, THORAX, drawn
from MedColorLib.bench.pairs import make_pair
from MedColorLib.bench.quality import baselines
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.gamut import lab_to_srgb_in_gamut
from MedColorLib.color.lab import srgb_to_lab

FOUR = {"fat": (72.0, 2.0, 30.0), "muscle": (24.0, 16.0, 12.0), "bone": (60.0, 6.0, 22.0), "lung": (12.0, 8.0, 6.0)}
FOUR = {name: np.array(lab) for name, lab in FOUR.items()}


def _bytes(lab: np.ndarray) -> np.ndarray:
    return lab_to_srgb_in_gamut(np.asarray(lab, np.float64))[0]


class TestDrawn:
    def test_polygon_and_ellipse_have_their_area_and_place(self):
        square = drawn((40, 60), [((10, 5), (29, 5), (29, 24), (10, 24))])
        assert square.sum() == 400
        assert square[5:25, 10:30].all()
        disc = drawn((40, 60), [(30, 20, 12, 6)])
        assert disc.sum() == pytest.approx(np.pi * 12.5 * 6.5, rel=0.06)
        assert disc[20, 42]
        assert not disc[20, 44]

    def test_shapes_of_a_region_count_together(self):
        assert drawn((9, 9), [((0, 0), (1, 0), (1, 1), (0, 1)), ((5, 5), (6, 5), (6, 6), (5, 6))]).sum() == 8

    @pytest.mark.parametrize(
        "regions", [[s for s, _ in HEAD.values()], [s for _, s in HEAD.values()], [*THORAX.values()]]
    )
    def test_no_pixel_belongs_to_two_regions(self, regions):
        counts = sum(drawn((1216, 2048), shapes).astype(int) for shapes in regions)
        assert counts.max() == 1


class TestRegions:
    def test_equal_colours_have_no_error(self):
        assert seen.compare(FOUR, FOUR).seen == seen.Seen(0, 0, 1, 0, 0, chroma=0)

    def test_a_gain_in_linear_light_is_found_and_costs_nothing(self):
        brighter = {name: seen.exposed(lab, 1.5) for name, lab in FOUR.items()}
        result = seen.compare(brighter, FOUR)
        assert result.seen.gain == pytest.approx(1.5, rel=0.02)
        assert result.seen.mean < 0.3
        assert result.seen.mean_as_it_is > 5

    def test_one_wrong_region_is_the_worst_and_its_error_is_that_of_its_colours(self):
        got = {**FOUR, "muscle": np.array([55.0, 5.0, 20.0])}
        result = seen.compare(got, FOUR)
        alone = float(ciede2000(got["muscle"], FOUR["muscle"]))
        assert result.seen.worst_as_it_is == pytest.approx(alone)
        assert result.seen.mean_as_it_is == pytest.approx(alone / 4)
        assert max(result.errors, key=result.errors.get) == "muscle"
        assert result.seen.mean <= result.seen.mean_as_it_is

    def test_a_different_colour_cast_is_no_exposure(self):
        cast = {name: lab + np.array([0, 0, 15.0]) for name, lab in FOUR.items()}
        assert seen.compare(cast, FOUR).seen.mean > 3

    def test_pictures_are_read_in_their_own_regions(self):
        regions = {"left": ([(5, 5, 3, 3)], [(50, 20, 3, 3)]), "right": ([(20, 5, 3, 3)], [(10, 20, 3, 3)])}
        rgb, photograph = np.zeros((12, 30, 3), np.uint8), np.zeros((40, 60, 3), np.uint8)
        for (ours, theirs), color in zip(regions.values(), ((200, 150, 90), (120, 40, 30))):
            rgb[drawn(rgb.shape, ours)], photograph[drawn(photograph.shape, theirs)] = color, color
        assert seen.by_regions(rgb, photograph, regions).seen.mean == pytest.approx(0, abs=1e-9)
        assert seen.by_regions(rgb[:, ::-1], photograph, regions).seen.mean > 10

    def test_the_median_passes_over_a_few_foreign_pixels(self):
        rgb = np.full((10, 10, 3), 90, np.uint8)
        rgb[0, :4] = 255
        assert seen.median_lab(rgb, np.ones((10, 10), bool)) == pytest.approx(srgb_to_lab(rgb[5, 5]), abs=0.01)

    def test_text_names_every_region(self):
        assert all(name in seen.compare(FOUR, FOUR).text() for name in FOUR)


def _chest() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A chest of ellipses in Hounsfield units (384, 512), 0.8 mm, and where its tissues are."""
    rows, cols = np.mgrid[:384, :512].astype(float)

    def ellipse(row, col, height, width):
        return ((rows - row) / height) ** 2 + ((cols - col) / width) ** 2 < 1

    rng = np.random.default_rng(0)
    body, wall, cavity = ellipse(190, 256, 150, 215), ellipse(190, 256, 125, 190), ellipse(180, 256, 90, 150)
    heart, spine = ellipse(160, 290, 45, 55), ellipse(290, 256, 22, 28)
    hu = np.full(body.shape, -1000.0)
    truth = {
        "fat": body & ~wall,
        "muscle": wall & ~cavity & ~spine,
        "lung": cavity & ~heart,
        "heart": heart,
        "bone": spine,
    }
    for name, value in {"fat": -100, "muscle": 50, "lung": -850, "heart": 45, "bone": 400}.items():
        hu[truth[name]] = value
    hu += rng.normal(0, 12, hu.shape)
    hu[(rows > 355) & (rows < 362)] = 100  # the table
    return hu.astype(np.float32), truth


class TestChest:
    def test_tissues_are_found_where_they_are(self):
        from scipy import ndimage

        hu, truth = _chest()
        found = seen.slice_tissues(hu, 0.8, ndimage)
        assert set(found) == set(THORAX)
        for name, mask in found.items():
            assert mask.sum() > 150, name
            assert (mask & truth[name]).sum() / mask.sum() > 0.98, name
            assert not mask[355:362].any(), name

    def test_breast_glands_are_not_muscle(self):
        from scipy import ndimage

        hu, _ = _chest()
        front = np.s_[60:75, 200:320]
        assert not seen.slice_tissues(hu, 0.8, ndimage)["muscle"][front].any()


class TestPairs:
    def _painted(self, section, remap, how):
        pair = seen.pair_of(section, remap, 0)

        def colorize(volume, references, settings):
            assert settings.window == (0.0, 1.0)
            return ColorVolume(_bytes(how(pair))[None] * pair.mask[None, ..., None], volume.ijk_to_ras)

        return seen.seen_pair(colorize, section, remap)

    @pytest.mark.parametrize("remap", seen.SEEN_REMAPS)
    def test_the_truth_is_seen_without_error(self, phantom, remap):
        result = self._painted(phantom, remap, lambda pair: pair.truth)
        assert result.mean < 0.6  # bytes
        assert result.gain == 1

    def test_lightness_counts(self, phantom):
        def kept(pair):
            from MedColorLib.color.lab import gray_to_lightness

            lab = pair.truth.copy()
            lab[..., 0] = gray_to_lightness(pair.grey)
            return lab

        assert self._painted(phantom, "as it is", kept).mean < 0.6
        assert self._painted(phantom, "inverted", kept).mean_as_it_is > 20

    def test_exposure_is_free(self, phantom):
        result = self._painted(phantom, "as it is", lambda pair: seen.exposed(pair.truth, 0.5))
        assert result.gain == pytest.approx(0.5, rel=0.1)
        assert result.mean < 1.5 < result.mean_as_it_is

    def test_remaps_reach_the_target(self, phantom):
        plain = seen.pair_of(phantom, "as it is", 0)
        for remap, curve in seen.SEEN_REMAPS.items():
            pair = seen.pair_of(phantom, remap, 0)
            assert np.array_equal(pair.truth, plain.truth)
            assert pair.grey[pair.mask] == pytest.approx(np.clip(curve(plain.grey), 0, 1)[pair.mask])


class TestChromaPairs:
    def test_truth_scores_nothing_and_a_brighter_exposure_of_it_next_to_nothing(self, phantom):
        pair = make_pair(phantom, "extreme")
        assert chroma_pairs.error_of(lambda p: p.truth[..., 1:], pair) == pytest.approx(0, abs=1e-6)
        brighter = chroma_pairs.error_of(lambda p: seen.exposed(p.truth, 1.5)[..., 1:], pair)
        assert brighter < 0.5

    def test_no_colour_scores_what_the_colours_are_worth(self, phantom):
        pair = make_pair(phantom, "extreme")
        grey = chroma_pairs.error_of(lambda p: np.zeros((256, 256, 2)), pair)
        mean = chroma_pairs.error_of(lambda p: baselines(p)["mean colour"], pair)
        assert 0 < mean < grey


class TestSlabEnds:
    def _volume(self):
        return Volume(np.zeros((12, 8, 8), np.int16), np.diag([1.0, 1.0, 2.0, 1.0]))

    def _score(self, monkeypatch, shade):
        monkeypatch.setattr(slab_ends, "load", lambda _path: self._volume())

        def colorize(volume, references, settings):
            first = round(volume.ijk_to_ras[2, 3] / 2)
            rgb = np.zeros((*volume.array.shape, 3), np.uint8)
            for k in range(len(rgb)):
                rgb[k, 2:6, 2:6] = shade(first + k, len(rgb))
            return ColorVolume(rgb, volume.ijk_to_ras)

        from pathlib import Path

        return slab_ends.slab_ends(colorize, Path(), slabs=((1, 11),))

    def test_colours_that_belong_to_the_slice_do_not_move(self, monkeypatch):
        result = self._score(monkeypatch, lambda k, count: (10 * k, 80, 60))
        assert (result.mean, result.worst) == (0, 0)

    def test_colours_that_belong_to_the_slab_move_by_their_difference(self, monkeypatch):
        result = self._score(monkeypatch, lambda k, count: (90, 80, 60) if count == 10 else (150, 80, 60))
        apart = ciede2000(*(srgb_to_lab(np.array(c, np.uint8)) for c in ((90, 80, 60), (150, 80, 60))))
        assert result.mean == pytest.approx(float(apart), abs=1e-3)
        assert result.worst == pytest.approx(result.mean)

    def test_what_is_left_black_in_one_of_them_counts(self):
        one, two = np.zeros((2, 1, 4, 4, 3), np.uint8)
        one[0, :2] = 120
        assert slab_ends.changes(one, two)[0] > 20
        assert slab_ends.changes(two, two)[0] == 0


class TestTrivial:
    @pytest.mark.parametrize("name", trivial.WITHOUT_FEATURES)
    def test_every_grey_has_one_colour_and_black_stays_outside(self, ct, name):
        result = trivial.METHODS[name](ct.volume, [ct.reference], Settings(features="embedded"))
        assert result.rgb.shape == (*ct.volume.array.shape, 3)
        values, colors = ct.volume.array.astype(int), result.rgb.astype(int) @ [65536, 256, 1]
        colored = result.rgb.max(-1) > 0
        for value in np.unique(values[colored])[:40]:
            assert len(np.unique(colors[colored & (values == value)])) == 1
        assert not result.rgb[:, 0].any()

    def test_the_table_is_right_where_lightness_tells_the_tissue_and_wrong_where_it_does_not(self, phantom):
        errors = {
            remap: seen.seen_pair(trivial.look_up_table, phantom, remap).mean for remap in ("as it is", "inverted")
        }
        assert errors["as it is"] < 5
        assert errors["inverted"] > 15

    def test_luminance_is_that_of_the_name(self, monkeypatch, ct):
        asked = []
        monkeypatch.setattr("MedColorLib.pipeline.colorize", lambda v, r, s: asked.append(s.luminance))
        for name in ("keep", "paper"):
            trivial.METHODS[name](ct.volume, [ct.reference], replace(Settings(), features="embedded"))
        assert asked == ["keep", "paper"]
