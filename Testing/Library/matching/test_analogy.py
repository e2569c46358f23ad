"""Deep image analogy: what must come out when the answer is known, what is left out, and that slices do not mix."""

from __future__ import annotations

import math

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from MedColorLib.device import fast_dtype
from MedColorLib.matching import analogy, reconstruction
from MedColorLib.matching.analogy import BLEND_ALPHA, Context, deep_image_analogy, response_weight, unit
from MedColorLib.matching.confidence import consistency
from MedColorLib.matching.fields.field import identity
from MedColorLib.matching.reconstruction import deconvolve, make_reconstruction
from MedColorLib.matching.vote import matched_colors

SHAPE = (48, 64)


def side(layer):
    return 2 ** (layer - 1)


def maps(count=1, shape=SHAPE, channels=8, seed=0, stop=1):
    """Random features of all layers: every position is like no other."""
    generator = torch.Generator().manual_seed(seed)
    return {
        layer: torch.randn(count, channels, shape[0] // side(layer), shape[1] // side(layer), generator=generator)
        for layer in range(5, stop - 1, -1)
    }


def everywhere(*shape):
    return torch.ones(*shape, dtype=torch.bool)


def match(target, reference, stop, **options):
    count, _, height, width = target[5].shape
    masks = everywhere(count, 16 * height, 16 * width), everywhere(*(16 * n for n in reference[5].shape[2:]))
    masks = options.pop("target_mask", masks[0]), options.pop("reference_mask", masks[1])
    return deep_image_analogy(target, reference, *masks, stop, **options)


def grey_context(position, luminance, target, reference):
    return Context(position, luminance, target, reference)


@pytest.fixture
def no_exact_below_layer_5(monkeypatch):
    monkeypatch.setattr(analogy, "EXACT_LIMIT", 1)


class TestKnownAnswers:
    @pytest.mark.parametrize("stop", [5, 4, 3, 2, 1])
    def test_reference_like_the_target_gives_the_identity_at_every_layer(self, stop):
        features = maps(stop=stop)
        found = match(features, features, stop, keep_reverse=True)
        expected = identity(1, SHAPE[0] // side(stop), SHAPE[1] // side(stop))
        assert found.layer == stop and found.searched == dict.fromkeys(range(5, stop - 1, -1), "exact")
        torch.testing.assert_close(found.field, expected)
        torch.testing.assert_close(found.reverse, expected)
        inner = found.similarity[:, 2:-2, 2:-2]
        half_digit = 2.0**-8 if fast_dtype(inner.device) == torch.bfloat16 else 1e-3  # of products near 2
        torch.testing.assert_close(inner, torch.full_like(inner, 2.0), atol=half_digit, rtol=0)

    @pytest.mark.parametrize("search", ["windowed", "patchmatch"])
    def test_identity_by_the_local_searches(self, search, no_exact_below_layer_5):
        features = maps()
        found = match(features, features, 1, fine_search=search)
        assert found.searched == {5: "exact", 4: search, 3: search, 2: search, 1: search}
        torch.testing.assert_close(found.field, identity(1, *SHAPE).contiguous())

    def test_identity_with_context(self):
        features, grey = maps(stop=3), torch.rand(1, 1, *SHAPE)
        found = match(features, features, 3, context=grey_context(1.0, 1.0, grey, grey))
        torch.testing.assert_close(found.field, identity(1, 12, 16))

    @pytest.mark.parametrize("stop", [4, 3])
    def test_moved_reference_is_found_moved(self, stop):
        features = maps(shape=(80, 96), stop=stop)
        moved = {
            layer: values.roll((16 // side(layer), -16 // side(layer)), (2, 3)) for layer, values in features.items()
        }
        found = match(features, moved, stop).field[0]
        step, (rows, cols) = 16 // side(stop), features[stop].shape[2:]
        expected = identity(1, rows, cols)[0] + step * cols - step
        inside = slice(1, rows - step - 1), slice(step + 1, cols - 1)
        torch.testing.assert_close(found[inside], expected[inside])

    def test_position_alone_decides_where_features_say_nothing(self):
        nothing = {layer: torch.zeros_like(values) for layer, values in maps(stop=3).items()}
        found = match(nothing, nothing, 3, context=Context(1.0, 0.0, None, None))
        torch.testing.assert_close(found.field[:, 1:-1, 1:-1], identity(1, 12, 16)[:, 1:-1, 1:-1])

    def test_grey_alone_decides_where_features_say_nothing(self):
        nothing = {5: torch.zeros(1, 2, 3, 12)}
        grey = torch.linspace(0, 1, 192).expand(1, 1, 48, 192).contiguous()
        found = match(nothing, nothing, 5, context=Context(0.0, 1.0, grey, grey.flip(3)))
        torch.testing.assert_close(found.field[0, 1, 1:-1] % 12, torch.arange(10, 0, -1))

    def test_context_of_no_weight_is_none(self):
        target, reference = maps(stop=3), maps(seed=1, stop=3)
        torch.testing.assert_close(
            match(target, reference, 3, context=Context(0.0, 0.0, None, None)).field, match(target, reference, 3).field
        )


class TestShapesAndMasks:
    @pytest.mark.parametrize("exact", [True, False])
    def test_reference_of_another_size(self, exact, request):
        if not exact:
            request.getfixturevalue("no_exact_below_layer_5")
        target, reference = maps(2, (48, 64)), maps(1, (80, 48), seed=1)
        found = match(target, reference, 1, keep_reverse=True)
        assert found.field.shape == (2, 48, 64) and found.reverse.shape == (2, 80, 48)
        assert found.field.min() >= 0 and found.field.max() < 80 * 48
        assert found.reverse.min() >= 0 and found.reverse.max() < 48 * 64

    @pytest.mark.parametrize("exact", [True, False])
    def test_target_cut_out_of_a_larger_reference(self, exact, request):
        if not exact:
            request.getfixturevalue("no_exact_below_layer_5")
        reference = maps(1, (96, 112), stop=2)
        cut = {k: v[:, :, 16 // side(k) : 64 // side(k), 32 // side(k) : 96 // side(k)] for k, v in reference.items()}
        found = match(cut, reference, 2, keep_reverse=True)
        rows, cols = torch.meshgrid(torch.arange(24) + 8, torch.arange(32) + 16, indexing="ij")
        torch.testing.assert_close(found.field[0], rows * 56 + cols)
        torch.testing.assert_close(found.reverse[0, 8:32, 16:48], identity(1, 24, 32)[0])

    @pytest.mark.parametrize("stop", [5, 3, 1])
    def test_matches_lie_inside_the_reference(self, stop):
        reference_mask = torch.zeros(SHAPE, dtype=torch.bool)
        reference_mask[16:32, 16:48] = True
        found = match(maps(), maps(seed=1), stop, reference_mask=reference_mask)
        small = reference_mask[:: side(stop), :: side(stop)]
        assert small.reshape(-1)[found.field].all()

    def test_bodies_smaller_than_a_coarse_position_are_still_matched(self):
        tiny = torch.zeros(SHAPE, dtype=torch.bool)
        tiny[20, 21] = True
        found = match(maps(), maps(seed=1), 5, reference_mask=tiny, target_mask=tiny[None])
        assert (found.field == 1 * 4 + 1).all()

    def test_an_empty_slice_among_others_does_no_harm(self):
        masks = torch.stack([everywhere(*SHAPE), ~everywhere(*SHAPE)])
        together = match(maps(2), maps(seed=1), 3, target_mask=masks)
        alone = match({k: v[:1] for k, v in maps(2).items()}, maps(seed=1), 3)
        torch.testing.assert_close(together.field[:1], alone.field)


class TestSlicesDoNotMix:
    @pytest.mark.parametrize("stop", [3, 2])
    @pytest.mark.parametrize("exact", [True, False])
    def test_together_as_alone(self, stop, exact, request):
        if not exact:
            request.getfixturevalue("no_exact_below_layer_5")
        target, reference = maps(3, stop=stop), maps(seed=1, stop=stop)
        grey = torch.rand(3, 1, *SHAPE), torch.rand(1, 1, *SHAPE)
        together = match(target, reference, stop, context=grey_context(0.5, 0.5, *grey))
        for n in range(3):
            one = {layer: values[n : n + 1] for layer, values in target.items()}
            alone = match(one, reference, stop, context=grey_context(0.5, 0.5, grey[0][n : n + 1], grey[1]))
            torch.testing.assert_close(together.field[n : n + 1], alone.field)
            torch.testing.assert_close(together.similarity[n : n + 1], alone.similarity)

    def test_arguments_are_not_altered(self):
        target, reference = maps(2), maps(seed=1)
        before = {k: v.clone() for k, v in target.items()}, {k: v.clone() for k, v in reference.items()}
        match(target, reference, 1)
        for now, then in zip((target, reference), before):
            for layer, values in now.items():
                torch.testing.assert_close(values, then[layer], rtol=0, atol=0)

    def test_same_seed_same_field(self, no_exact_below_layer_5):
        target, reference = maps(), maps(seed=1)
        fields = [match(target, reference, 2, fine_search="patchmatch", seed=seed).field for seed in (3, 3, 4)]
        assert torch.equal(fields[0], fields[1]) and not torch.equal(fields[0], fields[2])


class TestLeftOut:
    @pytest.mark.parametrize(("stop", "keep"), [(5, False), (3, False), (3, True), (1, False)])
    def test_reverse_search_of_the_last_layer(self, stop, keep, monkeypatch):
        asked = []
        search = analogy.exact.search

        def counted(*arguments):
            asked.append(arguments[-1])
            return search(*arguments)

        monkeypatch.setattr(analogy.exact, "search", counted)
        found = match(maps(), maps(seed=1), stop, keep_reverse=keep)
        assert asked == [True] * (5 - stop) + [keep]
        assert (found.reverse is not None) == keep

    def test_reverse_local_search_of_the_last_layer(self, monkeypatch, no_exact_below_layer_5):
        calls = []
        refine = analogy.windowed.refine
        monkeypatch.setattr(analogy.windowed, "refine", lambda *a: calls.append(a[0].shape[2]) or refine(*a))
        match(maps(), maps(seed=1), 3)
        assert calls == [6, 6, 12]  # layer 4 in both directions, layer 3 in one

    def test_last_reverse_field_changes_nothing(self):
        target, reference = maps(), maps(seed=1)
        kept = match(target, reference, 2, keep_reverse=True)
        torch.testing.assert_close(kept.field, match(target, reference, 2).field)


class TestWeights:
    def test_formula(self):
        features = torch.randn(2, 5, 4, 6, generator=torch.Generator().manual_seed(0))
        got = response_weight(features, 0.8)
        for n in range(2):
            magnitude = (features[n] ** 2).sum(0)
            scaled = (magnitude - magnitude.min()) / (magnitude.max() - magnitude.min())
            torch.testing.assert_close(got[n, 0], 0.8 / (1 + torch.exp(-300 * (scaled - 0.05))))

    @pytest.mark.parametrize("value", [0.0, 1.0, 1e-12, 1e15])
    def test_constant_maps_are_strong_everywhere(self, value):
        got = response_weight(torch.full((1, 4, 5, 5), value), 0.7)
        torch.testing.assert_close(got, torch.full((1, 1, 5, 5), 0.7))

    @pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
    def test_features_of_unit_length_are_strong_everywhere(self, dtype):
        """Their lengths differ by rounding only, which the formula would stretch to 0..1: weights by chance."""
        features = unit(torch.randn(1, 512, 16, 16, generator=torch.Generator().manual_seed(2))).to(dtype)
        lengths = features.float().square().sum(1)
        assert lengths.max() > lengths.min()
        torch.testing.assert_close(response_weight(features, 0.8), torch.full((1, 1, 16, 16), 0.8))

    def test_scale_does_not_matter(self):
        features = torch.rand(1, 4, 6, 6)
        torch.testing.assert_close(response_weight(1000 * features, 0.6), response_weight(features, 0.6))

    def test_papers_alphas(self):
        assert BLEND_ALPHA == {4: 0.8, 3: 0.7, 2: 0.6, 1: 0.1}


class TestUnit:
    def test_length_one_and_zero_stays_zero(self):
        features = torch.randn(1, 6, 3, 3)
        features[0, :, 1, 1] = 0
        length = unit(features).norm(dim=1)
        assert length[0, 1, 1] == 0
        length[0, 1, 1] = 1
        torch.testing.assert_close(length, torch.ones(1, 3, 3))

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
    @pytest.mark.parametrize("value", [3e-5, 6e4])
    def test_half_precision_neither_overflows_nor_underflows(self, dtype, value):
        got = unit(torch.full((1, 100, 1, 1), value, dtype=dtype))
        torch.testing.assert_close(got, torch.full((1, 100, 1, 1), 0.1))

    @pytest.mark.parametrize("stop", [3, 1])
    def test_features_of_zero_length_everywhere(self, stop):
        nothing = {layer: torch.zeros_like(values) for layer, values in maps().items()}
        found = match(nothing, nothing, stop)
        assert torch.isfinite(found.similarity).all() and not found.similarity.any()


class Pooling:
    """A network small enough to check: two by two means, a mix of channels, ReLU."""

    def __init__(self, channels=6):
        self.mix = torch.randn(channels, channels, 1, 1, generator=torch.Generator().manual_seed(5)) / channels**0.5

    def layer_forward(self, layer, x):
        pooled = torch.nn.functional.avg_pool2d(x, 2)
        return torch.relu(torch.nn.functional.conv2d(pooled, self.mix))


class TestReconstruction:
    def setup_method(self):
        self.network = Pooling()
        generator = torch.Generator().manual_seed(9)
        truth = torch.rand(3, 6, 8, 8, generator=generator)
        self.coarse = self.network.layer_forward(2, truth)
        self.start = torch.rand(3, 6, 8, 8, generator=generator)

    def residual(self, features):
        """|CNN(R) - warped|^2 / |warped|^2 of each slice, written out."""
        missed = (self.network.layer_forward(2, features) - self.coarse).square().sum((1, 2, 3))
        return missed / self.coarse.square().sum((1, 2, 3))

    def solve(self, coarse=None, start=None, **options):
        coarse, start = self.coarse if coarse is None else coarse, self.start if start is None else start
        return deconvolve(self.network, 2, coarse, start, **options)

    def test_residual_becomes_small(self):
        solved, _ = self.solve()
        assert (self.residual(solved) < 0.05 * self.residual(self.start)).all()

    @pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
    def test_it_moves_at_any_scale_of_the_features(self, scale):
        """Absolute tolerances once stopped it at its start; the loss was a mean over a million values."""
        start, coarse = (values.repeat(1, 1, 16, 16) * scale for values in (self.start, self.coarse))
        solved, found = self.solve(coarse, start, iterations=8)
        for before, after, evaluations, _ in found:
            assert after < 0.2 * before and evaluations > 8
        assert (solved - start).norm() > 0.05 * start.norm()

    def test_what_is_said_of_a_solution_is_so(self):
        solved, found = self.solve()
        for n, (before, after, evaluations, converged) in enumerate(found):
            assert before == pytest.approx(float(self.residual(self.start)[n]), rel=1e-4)
            assert after == pytest.approx(float(self.residual(solved)[n]), rel=1e-3, abs=1e-9)
            assert after < 0.05 * before and converged and evaluations <= 2 * reconstruction.MOST_ITERATIONS

    def test_a_short_run_says_that_it_has_not_converged(self):
        _, found = self.solve(iterations=8)
        assert [converged for *_, converged in found] == [False] * 3

    def test_it_stops_where_nothing_is_gained(self):
        unreachable = -self.coarse - 1  # below 0, which no ReLU gives
        _, found = self.solve(unreachable)
        for before, after, evaluations, converged in found:
            assert converged and after <= before and evaluations < reconstruction.MOST_ITERATIONS

    def test_a_solution_is_left_alone(self):
        solved, _ = self.solve()
        coarse = self.network.layer_forward(2, solved)
        again, found = self.solve(coarse, solved)
        torch.testing.assert_close(again, solved)
        assert all(after <= before and converged for before, after, _, converged in found)

    def test_slices_together_as_alone_and_start_untouched(self):
        before = self.start.clone()
        together, found = self.solve()
        for n in range(3):
            one = slice(n, n + 1)
            alone, found_alone = self.solve(self.coarse[one], self.start[one])
            torch.testing.assert_close(together[one], alone, rtol=0, atol=0)
            assert found_alone == found[one]
        torch.testing.assert_close(self.start, before, rtol=0, atol=0)
        assert not together.requires_grad

    def test_works_where_gradients_are_off(self):
        with torch.no_grad():
            solved, _ = self.solve()
        assert (self.residual(solved) < self.residual(self.start)).all()

    def test_zero_target_gives_no_nan(self):
        solved, found = self.solve(torch.zeros_like(self.coarse))
        assert torch.isfinite(solved).all() and all(math.isfinite(number) for one in found for number in one)

    def test_warp_computes_nothing(self):
        assert make_reconstruction("warp", None) is None

    def test_called_once_a_layer_and_direction(self):
        seen = []

        def reconstruct(layer, direction, coarse, fine):
            seen.append((layer, direction, tuple(coarse.shape[2:]), tuple(fine.shape[2:])))
            return fine

        target, reference = maps(stop=3), maps(1, (80, 48), seed=1, stop=3)
        found = match(target, reference, 3, reconstruct=reconstruct)
        to_target, to_reference = reconstruction.DIRECTIONS
        assert seen == [
            (4, to_target, (3, 4), (6, 8)),
            (4, to_reference, (5, 3), (10, 6)),
            (3, to_target, (6, 8), (12, 16)),
            (3, to_reference, (10, 6), (20, 12)),
        ]
        torch.testing.assert_close(found.field, match(target, reference, 3).field)

    def test_the_report_sums_up_by_layer_and_direction(self):
        rebuild = make_reconstruction("lbfgs", self.network)
        for layer, direction in ((1, "b"), (2, "b"), (2, "a"), (2, "a")):
            solved = rebuild(layer, direction, self.coarse, self.start)
        assert (self.residual(solved) < 0.05 * self.residual(self.start)).all()
        entries = rebuild.report()
        assert [(e["layer"], e["direction"], e["slices"]) for e in entries] == [(2, "a", 6), (2, "b", 3), (1, "b", 3)]
        assert entries[0]["evaluations"] == 2 * entries[1]["evaluations"]
        for entry in entries:
            assert entry["loss_before"] == pytest.approx(float(self.residual(self.start).mean()), rel=1e-3)
            assert entry["loss_after"] < 0.05 * entry["loss_before"] and entry["converged_slices"] == entry["slices"]


class Asked(TorchDispatchMode):
    """Counts torch's operations, and those whose result the program must wait for on a GPU."""

    WAITS = ("nonzero", "_local_scalar_dense", "masked_select", "_unique", "equal")

    def __init__(self):
        super().__init__()
        self.count, self.waits = 0, []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.__name__.split(".")[0]
        self.count += 1
        if name in self.WAITS:
            self.waits.append(name)
        return function(*args, **(kwargs or {}))


class TestOnADevice:
    """As on a GPU: the similarity in one block."""

    @pytest.mark.parametrize(("stop_layer", "most"), [(3, 1500), (1, 12000)])
    def test_no_slice_waits_for_the_device(self, stop_layer, most, monkeypatch):
        monkeypatch.setattr(analogy.exact, "_BLOCK_ENTRIES", 1 << 40)
        monkeypatch.setattr(analogy.windowed, "_CHUNK_BYTES", analogy.windowed._DEVICE_CHUNK_BYTES)
        monkeypatch.setattr(analogy, "EXACT_LIMIT", 16**4 + 1)  # layers 2 and 1 in windows
        sides = {layer: 64 // 2 ** (layer - 1) for layer in range(1, 6)}
        target, reference = ({n: torch.rand(count, 12, s, s) for n, s in sides.items()} for count in (2, 1))
        masks = torch.ones(2, 64, 64, dtype=torch.bool), torch.ones(64, 64, dtype=torch.bool)
        with Asked() as asked:
            found = analogy.deep_image_analogy(target, reference, *masks, stop_layer, keep_reverse=True)
            matched_colors(found.field, found.layer, torch.rand(1, 3, 64, 64))
            consistency(found.field, found.reverse)
        assert not asked.waits and asked.count < most
