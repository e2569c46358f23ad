"""Benchmark: suites profile, side by side and scaling, and real volumes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from MedColorLib.bench import (
    real_volumes,
    run,
    schema,
    slabs,
    suite_profile,
    suite_quality,
    suite_scaling,
    suite_sidebyside,
    work,
)
from MedColorLib.bench.machine import Machine
from MedColorLib.bench.peak_memory import tall_phantom
from MedColorLib.bench.plain_patchmatch import PatchDistance, plain_patchmatch
from MedColorLib.bench.stopwatch import Stopwatch
from MedColorLib.bench.summary import all_targets
from MedColorLib.bench.tables import Suite, Table
from MedColorLib.cli.main import main
from MedColorLib.device import fast_dtype
from MedColorLib.errors import InputError, MedColorError, SettingsError
from MedColorLib.features import contrast_net
from MedColorLib.matching.fields import exact, patchmatch, windowed
from MedColorLib.parameters import Settings


class TestProfile:
    def test_inner_stages_do_not_count_to_outer_ones(self, monkeypatch):
        ticks = iter([0.0, 1.0, 4.0, 10.0])  # outer from 0 to 10, inner from 1 to 4
        monkeypatch.setattr("MedColorLib.bench.stopwatch.time.perf_counter", lambda: next(ticks))
        watch = Stopwatch()
        with watch.stage("outer"), watch.stage("inner"):
            pass
        assert watch.seconds == {"outer": 7.0, "inner": 3.0}

    def test_functions_are_given_back_after_an_error(self):
        before = exact.search
        watch = Stopwatch()
        with pytest.raises(ZeroDivisionError), watch.watching((exact, "search", "search")):
            assert exact.search is not before
            raise ZeroDivisionError
        assert exact.search is before

    def test_network_operations_are_those_that_torch_counts(self):
        class Weights:
            """Tensors of VGG-19's shapes, all zero."""

            def tensor(self, name: str) -> torch.Tensor:
                block, index = int(name[4]), int(name[6])
                widths = (3, 64, 128, 256, 512, 512)
                inputs = widths[block - 1] if index == 1 else widths[block]
                return torch.zeros((widths[block], inputs, 3, 3) if "weight" in name else widths[block])

        forward = suite_profile._bare(Weights(), torch.zeros(1, 3, 32, 48), torch.contiguous_format)
        with FlopCounterMode(display=False) as counter:
            forward()
        third_plane = 18 * 64 * 32 * 48
        assert work.vgg19_work(32 * 48, "float32").operations == counter.get_total_flops() - third_plane

    @pytest.mark.parametrize("context", [0.0, 1.0])
    def test_operations_of_the_own_network_are_those_that_torch_counts(self, context):
        with FlopCounterMode(display=False) as counter:
            contrast_net._loaded("cpu")(torch.zeros(1, 1, 48, 64), context)  # torch counts on this thread alone
        assert work.own_work(48 * 64, context).operations == counter.get_total_flops()

    def test_product_operations_are_those_that_torch_counts(self):
        sides = torch.rand(7, 4, 5), torch.rand(7, 4, 5)
        with FlopCounterMode(display=False) as counter:
            exact.similarity_volume(*sides, 1)
        counted = work.matching_work({4: 20}, {4: 7})
        assert counted["similarity product"].operations == counter.get_total_flops()

    def test_limit_is_the_slower_of_computing_and_moving(self):
        machine = Machine({"float32": 100.0, "bfloat16": 400.0}, 10.0)
        assert machine.least_seconds(200, 5, "float32") == 2
        assert machine.least_seconds(200, 50, "bfloat16") == 5
        assert machine.least_seconds(None, 50, "float32") == 5

    def test_notes_hold_the_formulas(self):
        assert "similarity product: 2 C P^2 operations; bytes: 8 C P" in work.formulas()

    def test_all_stages_take_time_and_shares_add_up(self, phantom, small_raster):
        table = Table(suite_profile.COLUMNS)
        machine = Machine({"float32": 1e11, "bfloat16": 1e11}, 1e10)
        settings = Settings(preset="balanced", features="embedded", window=(0.0, 1.0))
        volume = suite_profile.slice_volume(phantom, 64, 0)
        suite_profile.measure(table, machine, volume, phantom.rgb, settings, quick=True)
        rows = {row["stage"]: row for row in table.where()}
        added = fast_dtype(torch.device("cpu")) == torch.float32  # in bfloat16 whole patches are multiplied
        own_stages = [  # one layer: nothing to descend to
            stage for stage in suite_profile.PER_SLICE if stage != "descent" and (added or stage != "box sum")
        ]
        assert list(rows) == [*suite_profile.ONCE, *own_stages]
        assert sum(row["share"] for row in rows.values() if row["per"] == "slice") == pytest.approx(1, abs=1e-4)
        assert all(row["seconds"] > 0 for row in rows.values())
        counted = [s for s in ("features", "similarity product", "box sum", "argmax", "colour") if s in rows]
        assert all(rows[stage]["operations"] > 0 and rows[stage]["share_of_limit"] > 0 for stage in counted)


def unit_maps(shape, shape2, channels=6, seed=0):
    """Random features of length 1: (C, h, w) and (C, h2, w2) torch tensors."""
    generator = torch.Generator().manual_seed(seed)
    maps = [torch.randn(channels, *s, generator=generator) for s in (shape, shape2)]
    return [values / values.norm(dim=0, keepdim=True) for values in maps]


class TestPlainPatchMatch:
    @pytest.mark.parametrize("radius", [0, 1, 2])
    def test_distance_is_the_papers(self, radius):
        target, reference = unit_maps((5, 4), (3, 6))
        table = 2 - 2 * exact.similarity_volume(target, reference, radius)
        distance = PatchDistance(target.numpy(), reference.numpy(), radius)
        for p in np.ndindex(5, 4):
            for q in np.ndindex(3, 6):
                assert distance(p, q) == pytest.approx(float(table[p[0] * 4 + p[1], q[0] * 6 + q[1]]), abs=1e-5)

    def test_finds_the_exhaustive_field_when_it_searches_everywhere(self):
        target, reference = unit_maps((6, 6), (6, 6), seed=1)
        start = np.random.default_rng(0).integers(0, 36, (6, 6))
        found = plain_patchmatch(target.numpy(), reference.numpy(), start, 1, 6, 300)
        everywhere = torch.ones(1, 6, 6, dtype=torch.bool)
        best = exact.search(target[None], reference[None], 1, everywhere, everywhere[0], False)[0][0]
        assert np.array_equal(found, best.numpy())

    def test_finds_a_shift_by_propagation_alone(self):
        reference = unit_maps((9, 9), (9, 9), seed=2)[1].numpy()
        target = reference[:, 2:8, 1:7]
        start = np.zeros((6, 6), np.int64)
        start[0, 0] = 2 * 9 + 1
        found = plain_patchmatch(target, reference, start, 0, 0, 1)
        assert np.array_equal(np.stack(np.divmod(found, 9)), np.mgrid[2:8, 1:7])

    def test_matches_lie_where_they_may_and_none_gets_worse(self):
        target, reference = unit_maps((5, 6), (6, 5), seed=3)
        allowed = np.zeros((6, 5), bool)
        allowed[1:5, 1:4] = True
        start = np.full((5, 6), 2 * 5 + 2)
        found = plain_patchmatch(target.numpy(), reference.numpy(), start, 1, 4, 3, allowed=allowed)
        assert allowed.ravel()[found].all()
        distance = PatchDistance(target.numpy(), reference.numpy(), 1)
        assert all(distance(p, divmod(int(found[p]), 5)) <= distance(p, (2, 2)) for p in np.ndindex(5, 6))

    @pytest.mark.parametrize("seed", range(4))
    def test_no_search_of_ours_is_beaten_by_it(self, seed):
        target, reference = unit_maps((8, 7), (7, 8), seed=seed)
        mask = torch.rand(7, 8, generator=torch.Generator().manual_seed(seed)) < 0.8
        mask[3, 3] = True
        start = torch.full((1, 8, 7), 3 * 8 + 3)
        plain = plain_patchmatch(target.numpy(), reference.numpy(), start[0].numpy(), 1, 8, 4, seed, mask.numpy())
        generator = torch.Generator().manual_seed(seed)
        sides = target[None], reference[None]
        fields = {
            "exact": exact.search(*sides, 1, torch.ones(1, 8, 7, dtype=torch.bool), mask, False)[0],
            "windowed": windowed.refine(*sides, start, mask, 1)[0],
            "patchmatch": patchmatch.refine(*sides, start, mask, 1, 8, 8, generator)[0],
        }

        def mean(field):
            distance = PatchDistance(target.numpy(), reference.numpy(), 1)
            return np.mean([distance(p, divmod(int(field[p]), 8)) for p in np.ndindex(8, 7)])

        theirs = mean(plain)
        assert mean(fields["exact"][0]) <= theirs + 1e-6
        assert mean(fields["windowed"][0]) <= theirs + 1e-6  # the window holds the whole map
        assert mean(fields["patchmatch"][0]) <= 1.1 * theirs


class TestSideBySide:
    def test_opencv_filters_agree(self, phantom):
        pytest.importorskip("cv2.ximgproc")
        suite = Suite({"sidebyside": Table(suite_sidebyside.COLUMNS)})
        for method in suite_sidebyside.opencv_filters(suite):
            suite_sidebyside._measure_filter(suite, method, phantom, 0)
        rows = suite.tables["sidebyside"].where()
        assert len(rows) == 4
        assert not suite.failures
        assert max(row["difference"] for row in rows) < 1e-3
        assert all(row["time_ratio"] == pytest.approx(row["seconds"] / row["seconds_beside"], rel=1e-4) for row in rows)

    def test_the_larger_picture_has_three_channels(self, phantom):
        pytest.importorskip("cv2.ximgproc")
        suite = Suite({"sidebyside": Table(suite_sidebyside.COLUMNS)})
        method = next(suite_sidebyside.opencv_filters(suite))
        suite_sidebyside._measure_filter(suite, method, phantom, 0, 512)
        (row,) = suite.tables["sidebyside"].where()
        assert row["condition"].endswith("512 x 512 x 3") and row["runs"] == 15 and not suite.failures

    def test_results_that_differ_have_no_time(self, phantom):
        suite = Suite({"sidebyside": Table(suite_sidebyside.COLUMNS)})
        wrong = suite_sidebyside.Beside("a filter", "other", "as it is", lambda s, g: s, lambda s, g: 2 * s)
        suite_sidebyside._measure_filter(suite, wrong, phantom, 0)
        assert suite.tables["sidebyside"].where()[0]["seconds"] is None
        assert "differs from OpenCV's" in suite.failures[0][1]


class TestScaling:
    def test_power_laws_are_found(self):
        x = np.array([1.0, 2, 4, 8, 16])
        exponent, error = suite_scaling.fit_exponent(x, 3 * x**1.7)
        assert (exponent, error) == (pytest.approx(1.7), pytest.approx(0, abs=1e-12))
        assert suite_scaling.fit_exponent(x[:2], x[:2] ** -2)[1] is None

    def test_standard_error_is_that_of_the_regression(self):
        from scipy.stats import linregress

        x, noise = np.array([1.0, 2, 4, 8, 16]), np.array([1.1, 0.9, 1.05, 0.97, 1.0])
        exponent, error = suite_scaling.fit_exponent(x, x * noise)
        expected = linregress(np.log(x), np.log(x * noise))
        assert (exponent, error) == (pytest.approx(expected.slope), pytest.approx(expected.stderr))

    def test_tall_phantom_has_no_two_slices_alike(self):
        volume = tall_phantom(30, 16)
        assert volume.array.shape == (30, 16, 16)
        assert len({plane.tobytes() for plane in volume.array}) == 30

    def test_a_process_that_fails_is_said(self, monkeypatch):
        suite, memory = Suite(), Table(suite_scaling.MEMORY_COLUMNS)
        suite_scaling.add_memory(suite, memory, -1)
        assert not memory.rows
        assert suite.failures[0][0] == "memory of -1 slices"

    @pytest.mark.slow
    def test_memory_does_not_grow_with_slices(self):
        suite, memory = Suite(), Table(suite_scaling.MEMORY_COLUMNS)
        for count in (50, 200):
            suite_scaling.add_memory(suite, memory, count)
        assert not suite.failures
        assert (
            memory.where()[1]["growth_mb"] < 16
        )  # a body mask and bookkeeping; 150 slices of evidence would be 150 MB


class TestRun:
    def test_unknown_suites_are_refused_with_what_there_is(self, tmp_path):
        for wanted in (["quality", "speed"], []):
            with pytest.raises(SettingsError, match="choose from time, pipeline, quality"):
                run.run_bench(tmp_path, suites=wanted)
        with pytest.raises(SettingsError, match="suite by itself"):
            run.run_bench(tmp_path, suites=["quality"], stability=True)
        assert not list(tmp_path.iterdir())

    def test_command_refuses_an_unknown_suite(self, tmp_path, capsys):
        assert main(["bench", "-o", str(tmp_path), "--suites", "speed"]) == 2
        assert f"choose from {', '.join(run.SUITES)}" in capsys.readouterr().err

    def test_quick_leaves_out_what_takes_long(self):
        assert "scaling" not in run._chosen(None, True, False)
        assert run._chosen(["stability", "scaling"], True, False) == ("scaling", "stability")
        assert run._chosen(None, False, False) == tuple(run.SUITES)


def test_targets_of_the_new_suites():
    beaten = Table(suite_quality.BEATEN_COLUMNS)
    for met in (True, False):
        beaten.add(section="phantom", remap="mild", features="embedded", met=met)
    coherence = Table(slabs.COLUMNS)
    for volume, share in (("phantom", 0.9), ("CT head", 0.3), ("MR head", 0.4)):
        coherence.add(volume=volume, with_coherence=share, slice_by_slice=1.0)
    network = Table(suite_profile.NETWORK_COLUMNS)
    network.add(features="vgg19", what="extractor, layers 5 to 3", ratio=1.4)
    memory = Table(suite_scaling.MEMORY_COLUMNS)
    for slices, growth in ((50, 0.0), (800, 30.0)):
        memory.add(slices=slices, growth_mb=growth)
    tables = {"beaten": beaten, "coherence": coherence, "network": network, "memory": memory}
    rows = all_targets({"one": Suite(tables)}).where()
    assert [(row["value"], row["met"]) for row in rows] == [
        (1, False),
        (0.3, True),
        (0.4, False),
        (1.4, True),
        (30, False),
    ]


def test_a_wrong_row_of_the_new_tables_is_refused():
    with pytest.raises(InputError, match="row 0, unit: unexpected 3"):
        schema._table(
            "suite scaling", "scaling", {"columns": list(suite_scaling.COLUMNS), "rows": [["a", 1, 3, 1, 1, 1, 1]]}
        )


def test_peak_memory_is_asked_of_a_real_process(monkeypatch):
    from MedColorLib.bench import peak_memory

    monkeypatch.setattr(peak_memory.sys, "executable", str(Path("no") / "python"))
    with pytest.raises(MedColorError, match="cannot be run"):
        peak_memory.peak_of(4, 16)


class TestRealVolumes:
    def test_a_row_and_its_targets(self, small_raster):
        """On the phantom: shares add up, and every target of speed follows from the rows."""
        slab = slabs.load_slabs(None, True)[0]
        table = Table(real_volumes.COLUMNS)
        for preset in ("draft", "balanced"):
            real_volumes.measure(table, slab, "embedded", preset)
        for row in table.where():
            stages = [row[f"seconds_{stage}"] for stage in real_volumes.STAGES]
            assert row["slices"] == 8 and 0 < row["trusted"] <= 1 and row["runs"] == real_volumes.RUNS
            assert row["colour_share"] == pytest.approx(stages[2] / sum(stages), abs=1e-4)
            assert row["matching_over_features"] == pytest.approx(stages[1] / stages[0], rel=1e-4)
        whole = dict(zip(table.columns, table.rows[1])) | {"features": "vgg19", "seconds": 1.0, "colour_share": 0.2}
        table.add(**whole)
        suite = Suite({"volumes": table})
        found = {row["target"]: row for row in all_targets({"profile": suite}).where()}
        assert found["phantom: vgg19 balanced, seconds a slice"]["met"] is True
        assert found["phantom: vgg19 balanced, share of colour"]["met"] is False
        share = found["phantom: embedded balanced, time as a share of vgg19 balanced"]
        assert share["value"] == pytest.approx(table.rows[1][table.columns.index("seconds")]) and share["limit"] == 0.25
        assert "phantom: vgg19 draft, seconds a slice" not in found

    def test_without_the_volumes_it_says_so(self):
        suite = Suite({})
        real_volumes.run(suite, None, lambda _fraction: None)
        assert not suite.tables and "speed on real volumes" in suite.failures[0][0]
