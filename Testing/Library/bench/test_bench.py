"""The benchmark: its references against slower ones, its bookkeeping, its stability cases, and the committed results."""

from __future__ import annotations

import importlib

import mpmath
import numpy as np
import pytest
import torch

from MedColorLib.bench import case, exact_smoothing, pairs, stability, suite_pipeline
from MedColorLib.bench.matched import Matched, Method
from MedColorLib.bench.quality import baselines, color_errors
from MedColorLib.bench.suite_correspondence import exhaustive
from MedColorLib.bench.summary import own_variant, summarise, targets
from MedColorLib.bench.tables import Suite, Table, timed
from MedColorLib.errors import InputError, SettingsError


class TestPairs:
    def test_truth_is_the_section_where_it_came_from(self, phantom):
        pair = pairs.make_pair(phantom, "as it is", seed=3)
        rows, cols = (np.clip(np.rint(pair.source[..., axis]).astype(int), 0, 255) for axis in (0, 1))
        nearest = phantom.lab[rows, cols]
        assert np.median(np.abs(nearest - pair.truth)[pair.mask]) < 0.5
        assert np.median(np.abs(phantom.lab - pair.truth)[pair.mask]) > 2  # and not where it is now

    def test_field_mirrors_and_shifts_smoothly(self):
        rows, cols = np.mgrid[:256, :256]
        shift = pairs.warp_field(5) - np.stack([rows, 255 - cols], -1)
        assert 2 < np.abs(shift).max() < 1.5 * 0.03 * 256  # bicubic interpolation overshoots
        assert np.abs(np.diff(shift, axis=0)).max() < 0.5

    def test_seed_decides(self):
        assert np.array_equal(pairs.warp_field(1), pairs.warp_field(1))
        assert not np.array_equal(pairs.warp_field(1), pairs.warp_field(2))

    @pytest.mark.parametrize("remap", pairs.REMAPS)
    def test_volume_shows_the_remapped_grey(self, phantom, remap):
        pair = pairs.make_pair(phantom, remap)
        volume = pair.volume
        assert volume.array.shape == (1, 256, 256)
        assert np.allclose(volume.array[0][pair.mask], pair.grey[pair.mask])
        assert volume.array[0][~pair.mask].max() < -1  # air is far below
        assert pair.grey.min() >= 0 and pair.grey.max() <= 1

    def test_inverted_is_inverted(self, phantom):
        one, other = (pairs.make_pair(phantom, remap) for remap in ("as it is", "inverted"))
        assert np.allclose((one.grey + other.grey)[one.mask], 1)

    def test_look_up_table_fails_where_luminance_is_folded(self, shared_data):
        thorax = pairs.load_sections(shared_data)[0]
        means = {}
        for remap in ("as it is", "strong"):
            pair = pairs.make_pair(thorax, remap)
            means[remap] = {name: color_errors(chroma, pair).mean for name, chroma in baselines(pair).items()}
        assert means["as it is"]["look-up table"] == pytest.approx(2.6, abs=0.3)
        assert means["as it is"]["grey"] == pytest.approx(16.2, abs=0.3)
        assert means["as it is"]["mean colour"] == pytest.approx(8.7, abs=0.3)
        assert means["as it is"]["same position"] == pytest.approx(6.3, abs=0.3)
        assert 7.5 < means["strong"]["look-up table"] < 9.5


class TestErrors:
    def test_truth_has_none(self, phantom):
        pair = pairs.make_pair(phantom, "strong")
        errors = color_errors(pair.truth[..., 1:], pair)
        assert (errors.mean, errors.p95, errors.worst_patch) == (0, 0, 0)

    def test_luminance_does_not_count(self, phantom):
        one, other = (
            color_errors(np.zeros((256, 256, 2)), pairs.make_pair(phantom, r)) for r in ("as it is", "inverted")
        )
        assert one == other

    def test_worst_patch_finds_a_spot(self, phantom):
        pair = pairs.make_pair(phantom, "as it is")
        chroma = pair.truth[..., 1:].copy()
        chroma[128:144, 128:144] += 40
        errors = color_errors(chroma, pair)
        assert errors.p95 == 0
        assert errors.mean < 0.2
        assert errors.worst_patch > 10

    def test_perfect_match_leaves_the_transfer_alone(self, phantom):
        pair = pairs.make_pair(phantom, "as it is")
        matched = Matched(pair.volume, phantom.rgb, Method("embedded", "draft"))
        found = color_errors(matched.chroma("fgs", False), pair).mean
        matched.use_truth(pair.truth)
        assert color_errors(matched.chroma("fgs", False), pair).mean < found

    def test_stop_layer_and_context_change_the_match(self, phantom, narrow_vgg19):
        pair = pairs.make_pair(phantom, "as it is")
        methods = (
            Method("vgg19", "draft"),
            Method("vgg19", "draft", stop_layer=5),
            Method("vgg19", "draft", context=False),
        )
        found = [Matched(pair.volume, phantom.rgb, method).lab for method in methods]
        assert not np.array_equal(found[0], found[1])
        assert not np.array_equal(found[0], found[2])
        assert [m.label for m in methods] == ["draft", "draft, to layer 5", "draft, without context"]

    @pytest.mark.parametrize(
        "changes", [{"stop_layer": 4}, {"context": True}, {"context": False}, {"whole_features": True}]
    )
    def test_own_features_have_no_layers_to_choose_from(self, changes):
        with pytest.raises(SettingsError, match="the own features have one layer"):
            Method("embedded", "draft", **changes)

    @pytest.mark.parametrize("with_network", [True, False])
    @pytest.mark.parametrize("quick", [True, False])
    def test_every_point_of_the_curve_can_be_measured(self, quick, with_network):
        found = suite_pipeline.methods(quick, with_network)
        assert len(found) == len(set(found))
        assert {method.features for method in found} == ({"vgg19", "embedded"} if with_network else {"embedded"})


class TestExactSmoothing:
    @pytest.mark.parametrize("count", [1, 2, 7])
    @pytest.mark.parametrize("lam", [0.0, 1.0, 1e4])
    def test_lines_solve_the_system(self, count, lam):
        rng = np.random.default_rng(count)
        links, source = lam * rng.random((3, count - 1)), rng.normal(size=(3, count))
        got = exact_smoothing.exact_lines(source, links)
        for line, link, right in zip(got, links, source):
            matrix = np.eye(count)
            for i, value in enumerate(link):
                matrix[i : i + 2, i : i + 2] += value * np.array([[1, -1], [-1, 1]])
            assert np.allclose(matrix @ line.astype(float), right, rtol=1e-9, atol=1e-9)

    def test_lines_keep_every_digit_at_huge_lambda(self):
        rng = np.random.default_rng(1)
        links, source = 1e12 * rng.random(40), rng.random(41)
        with mpmath.workdps(60):
            matrix = mpmath.eye(41)
            for i, value in enumerate(links):
                for row, col, sign in ((i, i, 1), (i + 1, i + 1, 1), (i, i + 1, -1), (i + 1, i, -1)):
                    matrix[row, col] += sign * mpmath.mpf(float(value))
            exact = np.array([float(v) for v in mpmath.lu_solve(matrix, mpmath.matrix(source.tolist()))])
        assert np.abs(exact_smoothing.exact_lines(source, links).astype(float) / exact - 1).max() < 1e-14

    def test_plane_solves_the_system(self):
        rng = np.random.default_rng(2)
        source, guide = rng.normal(size=(4, 5, 2)), rng.integers(0, 255, (4, 5)).astype(float)
        got, residual = exact_smoothing.exact_plane(source, guide, 30.0, 50.0)
        total = np.zeros_like(got)
        for (y, x), _ in np.ndenumerate(guide):
            for y2, x2 in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                if 0 <= y2 < 4 and 0 <= x2 < 5:
                    total[y, x] += 30 * np.exp(-abs(guide[y, x] - guide[y2, x2]) / 50) * (got[y, x] - got[y2, x2])
        assert np.allclose(got + total, source, atol=1e-12)
        assert residual < 1e-13

    def test_constant_stays(self):
        guide = np.random.default_rng(3).integers(0, 255, (6, 7))
        got = exact_smoothing.exact_fgs(np.full((6, 7, 1), -3.5), guide, 1e9, 20.0, 3, "opencv")
        assert np.abs(got + 3.5).max() < 1e-12


class TestCorrespondence:
    def test_exhaustive_is_the_plain_definition(self):
        generator = torch.Generator().manual_seed(0)
        target, reference = torch.rand(1, 3, 5, 6, generator=generator), torch.rand(1, 3, 4, 7, generator=generator)
        mask = torch.ones(4, 7, dtype=torch.bool)
        mask[1, 2] = False
        found = exhaustive(target, reference, mask, 1)[0]
        here, there = (torch.nn.functional.pad(side[0], (1, 1, 1, 1)) for side in (target, reference))
        for y in range(5):
            for x in range(6):
                scores = {
                    (v, u): float((here[:, y : y + 3, x : x + 3] * there[:, v : v + 3, u : u + 3]).sum())
                    for v in range(4)
                    for u in range(7)
                    if mask[v, u]
                }
                v, u = max(scores, key=scores.get)
                assert int(found[y, x]) == v * 7 + u


class TestBookkeeping:
    def test_warm_up_does_not_count(self):
        calls = []
        result, seconds = timed(lambda: calls.append(0) or len(calls), 4)
        assert (result, len(calls), seconds.runs) == (1, 5, 4)
        assert 0 < seconds.low <= seconds.median <= seconds.high

    def test_warm_call_counts(self):
        calls = []
        _, seconds = timed(lambda: calls.append(0), 1, warm=True)
        assert (len(calls), seconds.runs) == (1, 1)

    def test_unknown_column_is_a_mistake(self):
        with pytest.raises(KeyError, match="colour"):
            Table(("color",)).add(colour=1)

    def test_what_is_not_finite_becomes_text(self):
        table = Table(("a", "b", "c"))
        table.add(a=np.float32(np.nan), b=np.inf, c=np.float64(1 / 3))
        assert table.rows == [("nan", "inf", 0.333333)]

    def test_summary_and_targets_take_the_presets_own_variant(self):
        errors = Table(suite_pipeline.COLUMNS)
        keys = {"section": "thorax", "features": "vgg19", "method": "balanced"}
        own = own_variant("balanced")
        for remap, mean in (("as it is", 2.9), ("strong", 4.4), ("inverted", 5.1)):
            errors.add(**keys, **own, remap=remap, mean=mean, seconds=1.5)
            errors.add(**keys, smoother=own["smoother"], gamma=not own["gamma"], remap=remap, mean=1.0)
        errors.add(section="thorax", remap="as it is", method="look-up table", mean=2.7)
        calls = Table(suite_pipeline.CALL_COLUMNS)
        calls.add(features="vgg19", method="balanced", seconds=3.5)
        table = targets(Suite({"errors": errors, "calls": calls}))
        met = {row["target"]: row["met"] for row in table.where()}
        assert met["vgg19 balanced, thorax as it is: mean CIEDE2000"] is False
        assert met["vgg19 balanced, thorax strong: mean CIEDE2000"] is True
        assert met["vgg19 balanced, thorax inverted: mean CIEDE2000"] is False
        assert met["vgg19 full, thorax as it is: mean CIEDE2000"] is None
        assert met["vgg19 balanced, one slice of 256 x 256 by colorize(): seconds"] is False
        lines = summarise(errors).where()
        assert [line["method"] for line in lines] == ["balanced", "look-up table"]
        assert lines[0]["strong"] == 4.4


class TestStability:
    @pytest.mark.parametrize("name", ["stability_color", "stability_matching"])
    def test_no_case_fails(self, name):
        _none_fails(importlib.import_module(f"MedColorLib.bench.{name}").cases)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["stability_filters", "stability_volumes"])
    def test_no_case_fails_in_the_larger_parts(self, name):
        _none_fails(importlib.import_module(f"MedColorLib.bench.{name}").cases)

    def test_verdicts(self):
        def refuse():
            raise InputError("no")

        def warn():
            return bool(np.float64(1) / np.float64(0)), "infinity"

        def crash():
            raise ZeroDivisionError("division by zero")

        def verdict(expected, check, **options):
            return case.Case("area", "case", "condition", expected, check, **options).verdict()[1]

        assert verdict("1", lambda: (True, "1")) == "pass"
        assert verdict("1", lambda: (False, "2")) == "FAIL"
        assert verdict(case.REFUSED, refuse) == "refused"
        assert verdict("1", refuse) == "FAIL"
        assert verdict("1", refuse, may_refuse=True) == "refused"
        assert verdict(case.REFUSED, case.refuses(lambda: None)) == "FAIL"
        assert verdict(case.REFUSED, lambda: (True, "1")) == "FAIL"
        assert verdict("1", warn) == "FAIL"
        assert verdict("1", crash) == "FAIL"
        assert verdict("small", case.at_most(lambda: float("nan"), 1.0)) == "FAIL"

    def test_threads_are_given_back(self):
        before = torch.get_num_threads()
        stability.run(lambda _f, _t: None, lambda: iter(()))
        assert torch.get_num_threads() == before


def _none_fails(cases):
    suite = stability.run(lambda _f, _t: None, cases)
    failed = suite.tables["stability"].where(verdict="FAIL")
    assert len(suite.tables["stability"].rows) > 30
    assert not failed, failed
