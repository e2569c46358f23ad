"""The plan is kept: what it calls left out is not done (calls are counted), and the result is the same with it done."""

from __future__ import annotations

import json

import numpy as np
import pytest

from MedColorLib import Settings, Volume, colorize, make_plan
from MedColorLib.coloring import transfer
from MedColorLib.errors import InputError, SettingsError
from MedColorLib.features.contrast_net import Contrast
from MedColorLib.filters import FILTERS
from MedColorLib.matching import analogy, contrast_match
from MedColorLib.parameters import PRESETS
from MedColorLib.phantom import section
from MedColorLib.plan import LeftOut, Plan
from MedColorLib.run import prepare
from MedColorLib.run.engine import Engine
from MedColorLib.scan.slices import sample_slices

pytestmark = pytest.mark.usefixtures("small_raster")


def settings(**changes) -> Settings:
    return Settings(**{"preset": "draft", "features": "embedded", "device": "cpu", **changes})


def scan(array, spacing_mm=3.0) -> Volume:
    return Volume(array, np.diag([-3.0, -3.0, spacing_mm, 1.0]), name="scan")


def middle(ct) -> Volume:
    return scan(ct.volume.array[3:8])


def entry(plan: Plan, what: str) -> LeftOut | None:
    return next((e for e in plan.left_out if e.what == what), None)


@pytest.fixture
def calls(monkeypatch):
    """Arguments of every call of `owner.name`, which still does its work."""

    def watch(owner, name: str) -> list:
        seen = []
        original = getattr(owner, name)

        def spied(*arguments, **options):
            seen.append((arguments, options))
            return original(*arguments, **options)

        monkeypatch.setattr(owner, name, spied)
        return seen

    return watch


@pytest.fixture
def extracted(calls):
    """Slices of every extraction: the reference, slices from which its contrast is learned, then others that are coloured."""
    seen = calls(Contrast, "extract")
    return lambda: [len(a[1]) for a, _ in seen]


class TestNothingHeavyIsDone:
    def test_no_features_no_matching_no_smoothing(self, ct, monkeypatch):
        def refuse(*_):
            raise AssertionError("the plan computed something")

        for owner, name in (
            (Contrast, "extract"),
            (Contrast, "descriptor"),
            (analogy, "deep_image_analogy"),
            (contrast_match, "match"),
        ):
            monkeypatch.setattr(owner, name, refuse)
        plan = make_plan(ct.volume, [ct.reference, section(0.3)], settings())
        assert plan.features == "embedded" and plan.device == "cpu" and plan.smoother == "regression"

    def test_the_run_follows_it(self, ct):
        plan = make_plan(middle(ct), [ct.reference], settings())
        result = colorize(middle(ct), [ct.reference], settings())
        assert result.report["plan"] == plan.to_dict()


class TestText:
    def test_one_line_for_each_step_and_each_thing_left_out(self, ct):
        plan = make_plan(ct.volume, [ct.reference], settings())
        lines = plan.text().splitlines()
        assert len(lines) == 2 + len(plan.steps) + len(plan.left_out)
        for left_out in plan.left_out:
            line = next(line for line in lines if left_out.what in line)
            assert left_out.why in line and left_out.saving in line
            assert ("(error: " in line) == (left_out.error != "none")

    def test_json(self, ct):
        plan = make_plan(ct.volume, [ct.reference], settings())
        back = json.loads(json.dumps(plan.to_dict()))
        assert back["slices"] == list(plan.slices) and back["steps"] == plan.steps
        assert [e["what"] for e in back["left_out"]] == [e.what for e in plan.left_out]

    def test_says_what_was_decided(self, ct):
        steps = make_plan(ct.volume, [ct.reference], settings(features="embedded", window=(-100, 300))).steps
        assert steps["window"] == "-100 to 300 (given)"
        assert "phantom CT, 12 x 64 x 56 (k, j, i) int16; slices run along array axis k" in steps["volume"]
        assert "MedColor's own network (no download), one layer, raster 64 x 64, on cpu" in steps["features"]
        assert steps["body"].startswith("12 of 12 slices") or steps["body"].startswith("11 of 12 slices")
        assert (
            "regression, cell_px 8, bins 64, support_px 4, levels 3 (support up to 64 where the matches ask for it); "
            "luminance of the reference's tissues with the scan's detail (85 % of the way); gamma off"
        ) in steps["colour"]

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"luminance": "keep"}, "luminance of the scan;"),
            ({"luminance": "paper"}, "luminance of the reference (paper);"),
            ({"lightness": 0.25}, "luminance of the reference's tissues with the scan's detail (25 % of the way);"),
        ],
    )
    def test_says_whose_luminance(self, ct, changes, words):
        assert words in make_plan(ct.volume, [ct.reference], settings(**changes)).steps["colour"]

    def test_auto_says_which(self, ct, monkeypatch, tmp_path):
        monkeypatch.delenv("MEDCOLOR_WEIGHTS", raising=False)
        monkeypatch.setattr("MedColorLib.features.weights.cache_folder", lambda: tmp_path)
        for preset in PRESETS:
            steps = make_plan(ct.volume, [ct.reference], settings(features="auto", preset=preset)).steps
            assert "MedColor's own network (no download) (auto)" in steps["features"]

    @pytest.mark.parametrize("preset", PRESETS)
    def test_auto_where_the_papers_network_is(self, ct, narrow_vgg19, preset):
        plan = make_plan(ct.volume, [ct.reference], settings(features="auto", preset=preset))
        assert plan.features == ("vgg19" if preset == "full" else "embedded")
        assert (" VGG-19 (auto), layers 5 to 1," in f" {plan.steps['features']}") == (preset == "full")

    def test_vgg19(self, ct, narrow_vgg19):
        plan = make_plan(ct.volume, [ct.reference], settings(features="vgg19"))
        assert any("all but 96 components" in entry.what for entry in plan.left_out)
        assert plan.features == "vgg19" and "VGG-19, layers 5 to 3," in plan.steps["features"]
        assert entry(plan, "L-BFGS deconvolution") and "411 MB" in entry(plan, "recommendation (fc6)").saving
        lbfgs = make_plan(ct.volume, [ct.reference], settings(features="vgg19", reconstruction="lbfgs"))
        assert entry(lbfgs, "L-BFGS deconvolution") is None


class TestSlices:
    def with_air(self, ct):
        array = np.full((7, 64, 56), -1000, np.int16)
        array[[1, 2, 4]] = ct.volume.array[[3, 4, 5]]
        array += np.random.default_rng(0).integers(-20, 20, array.shape, dtype=np.int16)
        return scan(array)

    def test_empty_slices(self, ct, extracted):
        volume = self.with_air(ct)
        result = colorize(volume, [ct.reference], settings(batch=1))
        plan = make_plan(volume, [ct.reference], settings())
        assert plan.slices == (1, 2, 4) and entry(plan, "empty slices").saving == "4 of 7 slices"
        assert extracted() == [1] + [1] * 3  # the reference, three slices for its contrast and to be coloured
        assert not result.rgb[[0, 3, 5, 6]].any() and result.rgb[[1, 2, 4]].any((1, 2, 3)).all()

    def test_slices_outside_the_range(self, ct, extracted):
        result = colorize(ct.volume, [ct.reference], settings(slices=(4, 7), batch=8))
        plan = make_plan(ct.volume, [ct.reference], settings(slices=(4, 7)))
        assert plan.slices == (4, 5, 6)
        left = entry(plan, "slices outside the range")
        assert left.saving == f"{len(make_plan(ct.volume, [ct.reference], settings()).slices) - 3} slices"
        # contrast from the three; then all twelve are asked what grey means, and nothing is matched again
        assert extracted() == [1] + [1] * 3 + [1] * 9 and "up to 16 of the body's slices" in left.why
        guided = make_plan(ct.volume, [ct.reference], settings(slices=(4, 7), smoother="guided"))
        assert entry(guided, "slices outside the range").why == "not asked for; they stay black"
        assert not result.rgb[:4].any() and not result.rgb[7:].any() and result.rgb[4:7].any((1, 2, 3)).all()

    def test_colors_of_a_range_do_not_depend_on_the_order_of_the_rest(self, ct):
        """Outside the range only the body is looked for, over the whole volume."""
        other = ct.volume.array[[1, 0, 3, 2, 4, 5, 6, 8, 7, 10, 9, 11]]
        results = [colorize(scan(array), [ct.reference], settings(slices=(4, 7))) for array in (ct.volume.array, other)]
        np.testing.assert_array_equal(results[0].rgb, results[1].rgb)

    @pytest.mark.parametrize(("slices", "error"), [((12, 13), SettingsError), ((900, 901), SettingsError)])
    def test_a_range_beyond_the_volume(self, ct, slices, error):
        with pytest.raises(error, match=r"slices .*: the volume has 12 slices \(0:12\)"):
            make_plan(ct.volume, [ct.reference], settings(slices=slices))

    def test_a_range_without_body(self, ct):
        with pytest.raises(InputError, match="slices 5:7: no body in this range; body was found in 1:5"):
            make_plan(self.with_air(ct), [ct.reference], settings(slices=(5, 7)))

    def test_stop_beyond_the_end_is_the_end(self, ct):
        assert make_plan(middle(ct), [ct.reference], settings(slices=(2, 99))).slices == (2, 3, 4)

    @pytest.mark.parametrize("count", [1, 3, 7, 8, 20, 100])
    def test_samples_are_spread_evenly(self, count):
        slices = list(range(10, 10 + count))
        sample = sample_slices(slices)
        assert len(sample) == min(7, count) and sample == sorted(set(sample)) and set(sample) <= set(slices)
        if count > 7:
            assert np.ptp(np.diff(sample)) <= 1 and sample[0] - 10 <= count / 7 and 9 + count - sample[-1] <= count / 7


class TestRegion:
    @pytest.mark.parametrize("smoother", ["regression", "guided"])
    def test_colors_inside_are_those_of_the_whole_and_the_rest_is_black(self, ct, smoother):
        whole = colorize(middle(ct), [ct.reference], settings(smoother=smoother))
        region = ((0, 5), (20, 45), (10, 99))
        part = colorize(middle(ct), [ct.reference], settings(smoother=smoother, region=region))
        inside = np.zeros(part.rgb.shape[:3], bool)
        inside[:, 20:45, 10:] = True
        differs = (part.rgb != whole.rgb).any(axis=-1) & inside
        face = (
            inside.copy()
        )  # the border of the body looks some voxels around itself, and nothing is seen beyond a face
        face[:, 26:39, 16:] = False
        assert not differs[~face].any() and differs.mean() < 0.02
        assert part.rgb[inside].any() and not part.rgb[~inside].any()

    def test_slices_outside_are_not_matched(self, ct, extracted):
        region = ((1, 3), (0, 64), (0, 56))
        plan = make_plan(middle(ct), [ct.reference], settings(region=region))
        assert plan.slices == (1, 2) and entry(plan, "outside the region of interest")
        result = colorize(middle(ct), [ct.reference], settings(region=region, batch=8))
        assert extracted() == [1] + [1] * 2 and result.rgb.any((1, 2, 3)).tolist() == [
            False,
            True,
            True,
            False,
            False,
        ]

    def test_no_entry_without_a_region(self, ct):
        assert entry(make_plan(middle(ct), [ct.reference], settings()), "outside the region of interest") is None

    def test_with_a_range_of_slices_both_hold(self, ct):
        region = ((1, 4), (0, 64), (0, 56))
        assert make_plan(middle(ct), [ct.reference], settings(region=region, slices=(2, 5))).slices == (2, 3)

    def test_outside_the_volume(self, ct):
        with pytest.raises(SettingsError, match=r"region .* lies outside the volume of \(5, 64, 56\) voxels"):
            make_plan(middle(ct), [ct.reference], settings(region=((0, 5), (64, 70), (0, 5))))


class TestRepeats:
    def repeating(self, ct):
        return scan(ct.volume.array[[3, 4, 4, 4, 5, 4, 4]])

    @pytest.mark.parametrize("changes", [{}, {"coherence_mm": 0.0}, {"smoother": "guided"}, {"batch": 1}])
    def test_matched_once_and_colored_the_same(self, ct, calls, extracted, monkeypatch, changes):
        volume, matched = self.repeating(ct), calls(Engine, "match")
        plan = make_plan(volume, [ct.reference], settings(**changes))
        assert entry(plan, "repeated slices").saving == "3 slices" and entry(plan, "repeated slices").error == "none"
        result = colorize(volume, [ct.reference], settings(**changes))
        assert sum(extracted()) == 1 + 7 and sum(len(a[1]) for a, _ in matched) == 4
        monkeypatch.setattr(prepare, "_repeats", lambda *_: {})
        every = colorize(volume, [ct.reference], settings(**changes))
        assert sum(extracted()) == 2 * (1 + 7) and sum(len(a[1]) for a, _ in matched) == 4 + 7
        np.testing.assert_array_equal(result.rgb, every.rgb)

    def test_slices_that_differ_in_one_voxel_are_no_repeats(self, ct):
        array = ct.volume.array[[4, 4]].copy()
        array[1, 30, 30] += 1
        assert entry(make_plan(scan(array), [ct.reference], settings()), "repeated slices") is None

    def test_nan_is_no_repeat(self, ct):
        array = ct.volume.array[[4, 4]].astype(np.float32)
        array[:, 0, 0] = np.nan
        assert colorize(scan(array), [ct.reference], settings()).rgb.any((1, 2, 3)).all()


class TestReferences:
    def test_features_of_the_reference_are_made_once(self, ct, extracted):
        plan = make_plan(middle(ct), [ct.reference], settings())
        assert entry(plan, "reference features for every slice").saving == "4 of 5 extractions"
        colorize(middle(ct), [ct.reference], settings(batch=2))
        assert extracted() == [1] + [1] * 5

    def test_one_slice_has_nothing_to_share(self, ct):
        plan = make_plan(scan(ct.volume.array[4:5]), [ct.reference], settings())
        assert entry(plan, "reference features for every slice") is None

    def test_no_descriptor_where_the_reference_is_given(self, ct, calls):
        described = calls(Contrast, "descriptor")
        assert entry(make_plan(middle(ct), [ct.reference], settings()), "recommendation (fc6)")
        colorize(middle(ct), [ct.reference], settings())
        assert not described
        two = [ct.reference, section(0.55)]
        assert entry(make_plan(middle(ct), two, settings()), "recommendation (fc6)") is None
        colorize(middle(ct), two, settings())
        assert sum(len(a[1]) for a, _ in described) == 2 + 5

    def test_the_same_reference_twice_gives_the_same_colors(self, ct):
        """What choosing would have cost brings nothing: the result is that of one reference."""
        once, twice = (colorize(middle(ct), [ct.reference] * n, settings()) for n in (1, 2))
        np.testing.assert_array_equal(once.rgb, twice.rgb)


class TestMatching:
    @pytest.mark.parametrize(("smoother", "left_out"), [("guided", True), ("fgs", False), ("regression", False)])
    def test_reverse_map_of_the_last_layer(self, ct, calls, smoother, left_out):
        plan = make_plan(middle(ct), [ct.reference], settings(smoother=smoother))
        assert (entry(plan, "reverse map of the last layer") is not None) == left_out
        by_sums, by_patches = calls(contrast_match.exact, "search"), calls(contrast_match.patches, "search")
        colorize(middle(ct), [ct.reference], settings(smoother=smoother))
        finest = [a[-1] for a, _ in by_sums + by_patches if a[0].shape[2] == 16]
        assert finest and set(finest) == {not left_out}

    def test_reverse_map_of_the_last_layer_changes_nothing(self, ct, monkeypatch):
        without = colorize(middle(ct), [ct.reference], settings(smoother="guided"))
        matched, seen = contrast_match.match, []
        with_reverse = lambda *a, **o: seen.append(o["keep_reverse"]) or matched(*a, **{**o, "keep_reverse": True})  # noqa: E731
        monkeypatch.setattr(contrast_match, "match", with_reverse)
        kept = colorize(middle(ct), [ct.reference], settings(smoother="guided"))
        assert seen and not any(seen)
        np.testing.assert_array_equal(without.rgb, kept.rgb)

    @pytest.mark.parametrize("preset", ["draft", "full"])
    def test_own_features_have_one_layer_and_one_search_a_slice(self, ct, calls, preset):
        plan = make_plan(middle(ct), [ct.reference], settings(preset=preset))
        assert entry(plan, "latent pictures, contrast curve, layers 5, 4, 2, 1")
        seen, by_sums, by_patches = (
            calls(Contrast, "extract"),
            calls(contrast_match.exact, "search"),
            calls(contrast_match.patches, "search"),
        )
        result = colorize(middle(ct), [ct.reference], settings(preset=preset, batch=1))
        assert {tuple(a[2]) for a, _ in seen} == {(3,)} and result.report["searched"] == {"3": "exact"}
        own = [a for a, _ in by_sums + by_patches if a[0].shape[2:] == (16, 16)]
        assert [len(a[0]) for a in own] == [1] * 5  # for the contrast and for the colours

    @pytest.mark.parametrize(
        ("preset", "below"), [("draft", "layers 2, 1"), ("balanced", "layers 2, 1"), ("full", None)]
    )
    def test_layers_below_the_last(self, ct, calls, preset, below, narrow_vgg19):
        from MedColorLib.features.vgg19 import VGG19

        chosen = settings(preset=preset, features="vgg19")
        plan = make_plan(scan(ct.volume.array[4:5]), [ct.reference], chosen)
        assert [e.what for e in plan.left_out if e.what.startswith("layers")] == ([below] if below else [])
        seen = calls(VGG19, "extract")
        result = colorize(scan(ct.volume.array[4:5]), [ct.reference], chosen)
        finest = min(min(a[2]) for a, _ in seen)
        assert finest == PRESETS[preset].stop_layer == min(map(int, result.report["searched"]))

    def test_no_deconvolution_unless_asked_for(self, ct):
        with pytest.raises(SettingsError, match="lbfgs inverts a network of several layers; the own features have one"):
            make_plan(middle(ct), [ct.reference], settings(reconstruction="lbfgs"))
        assert entry(make_plan(middle(ct), [ct.reference], settings()), "L-BFGS deconvolution") is None


class TestColor:
    @pytest.mark.parametrize(("luminance", "channels"), [("keep", 2), ("natural", 3), ("paper", 3)])
    def test_one_solve_of_the_channels_that_are_needed(self, ct, monkeypatch, luminance, channels):
        sources = []
        smooth = FILTERS["fgs"]
        monkeypatch.setitem(FILTERS, "fgs", lambda source, *more: sources.append(source.shape) or smooth(source, *more))
        changes = {"smoother": "fgs", "luminance": luminance}
        plan = make_plan(middle(ct), [ct.reference], settings(**changes))
        assert (entry(plan, "smoothing of L*") is not None) == (luminance == "keep")
        assert entry(plan, "second smoothing solve").error == "none"
        assert entry(plan, "smoothing at full resolution") is None
        colorize(middle(ct), [ct.reference], settings(**changes))
        assert [shape[2] for shape in sources] == [channels + 1] * 5  # and the weights

    def test_smoothing_of_lightness_would_change_nothing(self, ct, monkeypatch):
        kept = colorize(middle(ct), [ct.reference], settings(smoother="fgs", gamma=False, luminance="keep"))
        smooth = FILTERS["fgs"]

        def with_lightness(source, guide, *more):
            return smooth(np.concatenate([np.float32(guide[..., None]), source], -1), guide, *more)[..., 1:]

        monkeypatch.setitem(FILTERS, "fgs", with_lightness)
        every = colorize(middle(ct), [ct.reference], settings(smoother="fgs", gamma=False, luminance="keep"))
        assert np.abs(kept.rgb.astype(int) - every.rgb).max() <= 1

    @pytest.mark.parametrize(("luminance", "channels"), [("keep", 2), ("natural", 3)])
    def test_remainder_of_the_regression_is_smoothed_on_half_the_raster(self, ct, monkeypatch, luminance, channels):
        sources = []
        smooth = FILTERS["fgs"]
        monkeypatch.setitem(FILTERS, "fgs", lambda source, *more: sources.append(source.shape) or smooth(source, *more))
        plan = make_plan(middle(ct), [ct.reference], settings(luminance=luminance))
        assert entry(plan, "smoothing at full resolution")
        colorize(middle(ct), [ct.reference], settings(luminance=luminance))
        assert sources == [(24, 24, channels + 1)] * 5  # raster 64 without its margin, halved; colour and the weight

    def test_no_confidence_volume_unless_asked_for(self, ct):
        for wanted in (False, True):
            changes = settings(confidence=wanted)
            assert (entry(make_plan(middle(ct), [ct.reference], changes), "confidence volume") is None) == wanted
            assert (colorize(middle(ct), [ct.reference], changes).confidence is not None) == wanted

    def test_air_around_the_body_is_not_colored(self, ct, calls):
        colored = calls(transfer, "combine")
        volume = scan(np.pad(ct.volume.array[3:8], ((0, 0), (20, 20), (20, 20)), constant_values=-1000))
        plan = make_plan(volume, [ct.reference], settings())
        result = colorize(volume, [ct.reference], settings())
        done = sum(a[0].size for a, _ in colored)
        assert (
            entry(plan, "air around the body").saving == f"{100 * (1 - done / volume.array.size):.0f} % of the pixels"
        )
        assert done < 0.5 * volume.array.size
        rows, cols = (np.flatnonzero(result.rgb[0].any(axis)) for axis in ((1, 2), (0, 2)))
        assert (np.ptp(rows) + 1) * (np.ptp(cols) + 1) >= 0.85 * colored[0][0][0].size

    def test_no_alpha(self, ct):
        assert entry(make_plan(middle(ct), [ct.reference], settings()), "alpha volume")
        assert colorize(middle(ct), [ct.reference], settings()).rgb.shape[-1] == 3
