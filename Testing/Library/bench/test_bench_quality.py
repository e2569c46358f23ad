"""The benchmark's suites quality, profile, sidebyside and scaling: their measures against known answers, and their claims."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from MedColorLib.bench import (
    pairs,
    slabs,
    suite_quality,
)
from MedColorLib.bench.matched import Matched, Method, Transfer
from MedColorLib.bench.quality import baselines, color_errors, color_spill, dark_share
from MedColorLib.bench.summary import ERROR_TARGETS, own_variant
from MedColorLib.bench.tables import Suite, Table
from MedColorLib.parameters import PRESETS, Settings
from MedColorLib.phantom import sample
from MedColorLib.run.prepare import prepare


@pytest.fixture(scope="module")
def pair(phantom):
    return pairs.make_pair(phantom, "inverted")


class TestSpill:
    def test_truth_has_none_and_no_colour_misses_every_step(self, pair):
        assert color_spill(pair.truth[..., 1:], pair) == 0
        assert color_spill(np.zeros((256, 256, 2)), pair) == pytest.approx(1)
        assert color_spill(baselines(pair)["mean colour"], pair) == pytest.approx(1)

    def test_what_is_wrong_alike_on_both_sides_does_not_count(self, pair):
        assert color_spill(pair.truth[..., 1:] + [9, -5], pair) == pytest.approx(0, abs=1e-12)

    def test_half_the_step_is_half_missing(self, pair):
        assert color_spill(pair.truth[..., 1:] / 2, pair) == pytest.approx(0.5)

    def test_blur_spills_more_the_wider_it_is(self, pair):
        from scipy.ndimage import gaussian_filter

        spills = [color_spill(gaussian_filter(pair.truth[..., 1:], (s, s, 0)), pair) for s in (1, 3, 9)]
        assert 0 < spills[0] < spills[1] < spills[2] < 1

    def test_without_edges_there_is_no_number(self, pair):
        flat = replace(pair, truth=np.broadcast_to([50.0, 10.0, 10.0], pair.truth.shape))
        assert color_spill(flat.truth[..., 1:], flat) is None


def test_dark_share_counts_what_was_darkened(pair):
    from MedColorLib.color.lab import gray_to_lightness

    scan = gray_to_lightness(pair.grey)
    assert dark_share(scan - 14, pair, pair.mask) == 0
    left = pair.mask & (np.arange(256) < 128)
    assert dark_share(np.where(left, scan - 16, scan), pair, pair.mask) == pytest.approx(left.sum() / pair.mask.sum())
    assert dark_share(np.where(left, scan - 16, scan), pair, pair.mask & ~left) == 0


class TestSwitches:
    @pytest.mark.parametrize("features", ["vgg19", "embedded"])
    def test_each_improvement_changes_one_thing(self, features):
        by_name = {mode.name: mode for mode in suite_quality.modes(features)}
        short = by_name["paper" if features == "embedded" else "paper, to layer 3"]
        labels = {
            "vgg19": (
                "full, to layer 3, without context, histogram match, reference as it lies",
                "full, without context, histogram match, reference as it lies",
            ),
            "embedded": ("full, histogram match, reference as it lies",) * 2,
        }
        assert (short.method.label, by_name["paper"].method.label) == labels[features]
        assert ("+ context" in by_name) == ("+ learned contrast" in by_name) == (features == "vgg19")
        for name, mode in by_name.items():
            if name.startswith("+"):
                differs = [
                    *(
                        field
                        for field in vars(mode.method)
                        if getattr(mode.method, field) != getattr(short.method, field)
                    ),
                    *(
                        field
                        for field in vars(mode.transfer)
                        if getattr(mode.transfer, field) != getattr(short.transfer, field)
                    ),
                ]
                assert len(differs) == (2 if name == "+ regression" else 1), (
                    name,
                    differs,
                )  # it has no remainder, either
        own = PRESETS["balanced"]
        assert by_name["all together"].transfer == Transfer(own.smoother, own.gamma)
        assert by_name["all together"].method == Method(features, "balanced")

    def test_contrast_and_orientation_can_be_left_out(self, phantom):
        target = pairs.make_pair(phantom, "inverted")
        upside_down = phantom.rgb[::-1]
        with_all = Matched(target.volume, upside_down, Method("embedded", "draft")).engine.references[0]
        plain = Method("embedded", "draft", contrast=False, orientation=False)
        without = Matched(target.volume, upside_down, plain).engine.references[0]
        assert with_all.way in ("upside down", "turned by half")
        assert with_all.contrast.kind == "as the matches show it"
        assert without.way == "as it is" and not without.lie.guess
        assert without.contrast.kind == "histogram match"
        assert (np.diff(without.contrast.curve) >= 0).all()

    def test_transfer_switches_matter(self, phantom):
        target = pairs.make_pair(phantom, "inverted")
        matched = Matched(target.volume, phantom.rgb, Method("embedded", "draft"))
        first = Transfer("regression", False)
        changed = [
            replace(first, remainder=False),
            replace(first, weighted=False),
            replace(first, gamma=True),
            replace(first, luminance="paper"),
        ]
        colors = matched.colored(first)
        assert np.array_equal(colors[..., 1:], matched.chroma("regression", False))
        assert not any(np.array_equal(colors, matched.colored(how)) for how in changed)
        assert matched.body[colors.any(-1)].all()


def _mean(section_, remap: str, mode: suite_quality.Mode) -> float:
    target = pairs.make_pair(section_, remap)
    matched = Matched(target.volume, section_.rgb, mode.method, confidence=mode.trusted)
    return color_errors(matched.colored(mode.transfer)[..., 1:], target).mean


def _beats_everything(section_, remap: str, lines: list) -> None:
    suite = Suite({"improvements": Table(suite_quality.COLUMNS)})
    wanted = [mode for mode in lines if mode.name in (suite_quality.PAPER, suite_quality.DEFAULT)]
    suite_quality.measure_pair(suite, pairs.make_pair(section_, remap), section_.rgb, wanted, runs=0)
    rows = suite_quality.beaten(suite.tables["improvements"]).where()
    assert not suite.failures
    assert len(rows) == len(wanted) / 2
    assert all(row["met"] for row in rows), rows


class TestDefaultBeatsPaperAndBaselines:
    @pytest.mark.parametrize("remap", pairs.REMAPS)
    def test_on_the_phantom(self, phantom, remap):
        _beats_everything(phantom, remap, suite_quality.modes("embedded", paper="balanced"))

    @pytest.mark.slow
    @pytest.mark.parametrize("remap", pairs.REMAPS)
    @pytest.mark.parametrize("name", ["thorax", "head"])
    def test_on_photographs_with_embedded_features(self, shared_data, name, remap):
        photograph = next(s for s in pairs.load_sections(shared_data) if s.name == name)
        _beats_everything(photograph, remap, suite_quality.modes("embedded", paper="balanced"))

    @pytest.mark.slow
    @pytest.mark.parametrize("remap", pairs.REMAPS)
    @pytest.mark.parametrize("name", ["thorax", "head"])
    def test_on_photographs_with_vgg19(self, shared_data, shared_weights, monkeypatch, name, remap):
        monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(shared_weights))
        photograph = next(s for s in pairs.load_sections(shared_data) if s.name == name)
        _beats_everything(photograph, remap, suite_quality.modes("vgg19", paper="balanced"))

    @pytest.mark.slow
    @pytest.mark.parametrize(("features", "preset", "remap", "limit"), [t for t in ERROR_TARGETS if t[1] == "balanced"])
    def test_limits_on_the_thorax(self, shared_data, shared_weights, monkeypatch, features, preset, remap, limit):
        monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(shared_weights))
        thorax = pairs.load_sections(shared_data)[0]
        mode = suite_quality.Mode("", Method(features, preset), Transfer(**own_variant(preset)))
        assert _mean(thorax, remap, mode) <= limit


class TestCoherence:
    def test_flicker_is_the_mean_difference_where_grey_agrees(self):
        rgb = np.zeros((3, 2, 2, 3), np.uint8)
        rgb[1] = 119  # L* 50
        pairs_ = np.zeros((2, 2, 2), bool)
        assert slabs.flicker(rgb, pairs_) == 0
        pairs_[0, 0, 0] = True
        one = slabs.flicker(rgb, pairs_)
        pairs_[:, 1, 1] = True
        assert slabs.flicker(rgb, pairs_) == pytest.approx(one)
        pairs_[:] = True
        rgb[:] = 77
        assert slabs.flicker(rgb, pairs_) == 0

    def test_only_equal_grey_inside_the_body_counts(self):
        volume, reference = sample()
        prepared = prepare(volume, [reference], Settings(preset="draft", features="embedded"))
        equal = slabs.equal_voxels(prepared)
        span = prepared.window.high - prepared.window.low
        clipped = np.clip(volume.array.astype(float), prepared.window.low, prepared.window.high)
        step = np.abs(np.diff(clipped, axis=0))
        assert equal.any()
        assert step[equal].max() <= span / 255 / 2 * (1 + 1e-4)
        body = np.stack([prepared.body.painted(k, plane) for k, plane in enumerate(volume.array)])
        assert not (equal & ~body[1:]).any()

    @pytest.mark.slow
    def test_averaging_lessens_flicker_on_the_phantom(self):
        table = Table(slabs.COLUMNS)
        slabs.measure(table, slabs.load_slabs(None, True)[0], Settings(preset="draft", features="embedded"))
        assert table.where()[0]["ratio"] > 1.5

    def test_slabs_keep_their_place(self, shared_data):
        from MedColorLib.io.files import read_volume

        slab = slabs.load_slabs(shared_data, False)[1]
        whole = read_volume(shared_data / "vhf_head_ct.nrrd")
        assert slab.volume.array.shape[0] == 24
        first = int(np.argmax([(plane == slab.volume.array[0]).all() for plane in whole.array]))
        assert np.allclose(slab.volume.ijk_to_ras @ [3, 4, 0, 1], whole.ijk_to_ras @ [3, 4, first, 1])
