"""The tissue guard: two tissues of one grey keep apart, and no colour crosses from one label group into another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tissue_guard_samples import (
    BROWN,
    HOST,
    INSERT,
    MATRIX,
    PINK,
    YELLOW,
    Scene,
    errors,
    settings,
)

from MedColorLib import Guard, Volume, colorize, make_plan
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.lab import gray_to_lightness, srgb_to_lab
from MedColorLib.errors import Cancelled
from MedColorLib.matching.orientation import WAYS, Lie
from MedColorLib.parameters import PRESETS
from MedColorLib.run.estimate import estimate
from MedColorLib.run.prepare import prepare
from MedColorLib.run.resume import run_key


class TestColors:
    @pytest.mark.parametrize("preset", ["draft", "balanced"])
    def test_each_tissue_of_one_grey_gets_its_own_color(self, scene, preset):
        """Measured: 0.2 and 0.1 with the guard (both presets), 2.0 to 2.6 and 25 without."""
        guarded = errors(scene.color(scene.guard(), settings(preset=preset)), scene.labels)
        assert max(guarded.values()) < 0.5
        free = errors(scene.color(None, settings(preset=preset)), scene.labels)
        assert free[INSERT] > 15

    @pytest.mark.parametrize("smoother", ["fgs", "domain-transform", "wls"])
    def test_every_smoother_that_weighs_matches(self, scene, smoother):
        guarded = errors(scene.color(scene.guard(), settings(smoother=smoother)), scene.labels)
        assert max(guarded.values()) < 0.5

    def test_full_with_regression(self, monkeypatch):
        monkeypatch.setitem(PRESETS, "full", replace(PRESETS["full"], grid_px=64))
        few = Scene(slices=2)
        result = few.color(few.guard(), settings(preset="full", smoother="regression"))
        assert max(errors(result, few.labels).values()) < 4 < errors(few.color(None), few.labels)[INSERT]

    def test_a_hue_of_a_group_that_the_scan_lacks_appears_nowhere(self, monkeypatch):
        """The yellow insert lies, in the photograph, where the scan has its own insert."""
        upright = Lie("as it is", 1.0, dict.fromkeys(WAYS, 0.0))  # a round body tells no way up
        monkeypatch.setattr("MedColorLib.run.orient.find_way", lambda *_: upright)
        scene = Scene(strange=True)
        guarded, free = (srgb_to_lab(scene.color(guard).rgb)[..., 2] for guard in (scene.guard(), None))
        assert free.max() > 55 and guarded.max() < BROWN[1] + 5

    def test_luminance_of_the_reference_does_not_cross_either(self, scene):
        """With the paper's luminance, too, each tissue keeps its hue."""
        rgb = scene.color(scene.guard(), settings(luminance="paper")).rgb
        for label, chroma in ((HOST, BROWN), (INSERT, PINK)):
            mean = srgb_to_lab(rgb)[rgb.any(-1) & (scene.labels == label)].mean(0)
            assert np.hypot(*(mean[1:] - chroma)) < 6

    def test_a_pixel_of_each_border_keeps_its_side(self, scene):
        """Neighbours across the border differ as their tissues do; nothing lies between the two hues."""
        result = scene.color(scene.guard(), settings(preset="balanced"))
        hue = srgb_to_lab(result.rgb)[..., 1]
        assert hue[scene.labels == INSERT].min() > 50 and hue[scene.labels == HOST].max() < 25

    def test_without_reference_labels_evidence_is_still_apart(self, scene, monkeypatch):
        """A scan of two halves whose matches are right at full trust: no mixed colour at the border."""
        guard = scene.guard(reference_labels=None)
        plan = make_plan(scene.volume, [scene.picture], settings(), guard=guard)
        assert "no reference has labels, so matching may still cross" in plan.steps["tissue guard"]
        monkeypatch.setattr("MedColorLib.run.engine.Engine.match", matches_by_label(scene))
        sharp, blurred = (srgb_to_lab(scene.color(given).rgb)[..., 1] for given in (guard, None))
        assert sharp[scene.labels == INSERT].min() > 50 and sharp[scene.labels == HOST].max() < 25
        assert blurred[scene.labels == INSERT].min() < 45

    def test_several_references_one_without_labels(self, scene):
        guard = scene.guard(reference_labels=[scene.reference_labels, None])
        with_both = colorize(scene.volume, [scene.picture, np.flipud(scene.picture)], settings(), guard=guard)
        assert list(with_both.report["guard"]["without_counterpart"]) == ["reference 1"]
        assert "with 1 of 2 references" in with_both.report["plan"]["steps"]["tissue guard"]


def matches_by_label(scene):
    """In place of the matching: the true colour of every raster pixel, by its label."""
    chroma = np.array([(0, 0), BROWN, PINK, YELLOW])

    def match(engine, ks, _index):
        from MedColorLib.matching.confidence import Trust

        engine.searched = {}
        greys, masks = engine.slices_on_grid(ks)
        labs, trusts = [], []
        for k, grey, mask in zip(ks, greys, masks):
            j0, j1, i0, i1 = engine.prepared.body.boxes[k]
            view = engine.prepared.order.view(scene.labels)[k, j0:j1, i0:i1]
            rows, cols = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(engine.grid.inner, view.shape))
            own = np.pad(view[np.ix_(rows, cols)], 8)
            labs.append(np.concatenate([gray_to_lightness(grey)[..., None], chroma[own]], -1))
            trusts.append(Trust(mask.astype(np.float32), 0.0, None))
        return greys, masks, np.stack(labs).astype(np.float32), trusts

    return match


class TestTogetherWith:
    def test_no_guard_no_change(self, scene):
        """The engine and the painter have nothing of a guard, and the report says so."""
        prepared = prepare(scene.volume, [scene.picture], settings())
        assert prepared.groups is None and "tissue guard" not in prepared.plan.steps
        result = scene.color(None)
        assert result.report["guard"] is None

    def test_one_group_everywhere_changes_nothing(self, scene):
        """A guard that separates nothing gives the same bytes as none."""
        one = scene.guard(labels=Volume(np.ones_like(scene.labels), MATRIX), reference_labels=None)
        assert scene.color(one).rgb.tobytes() == scene.color(None).rgb.tobytes()

    def test_region_and_slices(self, scene):
        region = ((1, 4), (20, 60), (10, 70))
        whole = scene.color(scene.guard(), settings(slices=(1, 3), coherence_mm=0))
        part = scene.color(scene.guard(), settings(slices=(1, 3), coherence_mm=0, region=region))
        expected = np.zeros_like(whole.rgb)
        expected[1:3, 20:60, 10:70] = whole.rgb[1:3, 20:60, 10:70]
        inner = np.s_[
            :, 26:54, 16:64
        ]  # the border of the body looks some voxels around itself, and sees nothing beyond a face
        np.testing.assert_array_equal(part.rgb[inner], expected[inner])
        outside = np.ones(part.rgb.shape[:3], bool)
        outside[1:3, 20:60, 10:70] = False
        assert expected[inner].any() and not part.rgb[outside].any()

    def test_a_reference_upside_down(self, ct):
        """Labels are turned with their picture. The phantom's anatomy tells up from down."""
        from MedColorLib.phantom import section_labels

        tissues = section_labels()
        volume = Volume(ct.volume.array[4:6], ct.volume.ijk_to_ras, name="ct")
        guard = Guard(Volume(ct.labels[4:6], ct.volume.ijk_to_ras), [tissues])
        straight = colorize(volume, [ct.reference], settings(window=None), guard=guard)
        turned = replace(guard, reference_labels=[np.ascontiguousarray(tissues[::-1])])
        result = colorize(volume, [np.ascontiguousarray(ct.reference[::-1])], settings(window=None), guard=turned)
        assert next(iter(result.report["reference_lies"].values())) in ("upside down", "turned by half")
        apart = ciede2000(srgb_to_lab(result.rgb), srgb_to_lab(straight.rgb))[ct.labels[4:6] > 0]
        assert np.median(apart) < 1 and apart.mean() < 2
        wrong = replace(guard, reference_labels=[tissues])
        crossed = colorize(volume, [np.ascontiguousarray(ct.reference[::-1])], settings(window=None), guard=wrong)
        assert ciede2000(srgb_to_lab(crossed.rgb), srgb_to_lab(straight.rgb))[ct.labels[4:6] > 0].mean() > 3

    def test_slices_along_another_axis(self, scene):
        """Sagittal storage of scan and labels: the same colours, in the same storage."""
        guard = scene.guard()
        straight = scene.color(guard).rgb
        order = (2, 0, 1)
        matrix = MATRIX[:, [1, 2, 0, 3]]  # array axes i, k, j: the columns for i', j', k' are those of j, k, i
        volume = Volume(scene.volume.array.transpose(order), matrix, name="scan")
        moved = scene.guard(labels=Volume(scene.labels.transpose(order), matrix))
        result = colorize(volume, [scene.picture], settings(), guard=moved)
        np.testing.assert_array_equal(result.rgb, straight.transpose(*order, 3))

    def test_slices_of_one_grey_and_other_labels_are_no_repeats(self, scene):
        same = Volume(np.repeat(scene.volume.array[:1], 3, axis=0), MATRIX)
        labels = np.stack(
            [scene.labels[0], scene.labels[0], np.where(scene.labels[0] == INSERT, HOST, scene.labels[0])]
        )
        guard = scene.guard(labels=Volume(labels.astype(np.uint8), MATRIX))
        assert prepare(same, [scene.picture], settings()).repeats == {1: 0, 2: 0}
        assert prepare(same, [scene.picture], settings(), guard=guard).repeats == {1: 0}
        result = colorize(same, [scene.picture], settings(coherence_mm=0), guard=guard)
        hue = srgb_to_lab(result.rgb)[..., 1]
        where = labels[0] == INSERT
        assert hue[:2, where].min() > 50 and hue[2, where].max() < 25

    def test_cancel(self, scene):
        answers = iter([False, False, True])
        with pytest.raises(Cancelled):
            scene.color(scene.guard(), settings(batch=1), cancelled=lambda: next(answers))

    def test_resume_and_its_key(self, scene, tmp_path):
        guards = [None, scene.guard(), scene.guard(reference_labels=None), scene.guard(groups={INSERT: HOST})]
        other = scene.reference_labels.copy()
        other[100, 100] = INSERT if other[100, 100] == HOST else HOST
        guards.append(scene.guard(reference_labels=[other]))
        keys = [run_key(prepare(scene.volume, [scene.picture], settings(), guard=g)) for g in guards]
        assert len(set(keys)) == len(keys)
        assert run_key(prepare(scene.volume, [scene.picture], settings(), guard=scene.guard())) == keys[1]

        def broken_off(_fraction, text):
            if text.startswith("slice 2"):
                raise Cancelled

        with pytest.raises(Cancelled):
            scene.color(scene.guard(), settings(batch=1), progress=broken_off, resume=tmp_path)
        again = scene.color(scene.guard(), settings(batch=1), resume=tmp_path)
        assert again.report["resumed_slices"] > 0
        assert again.rgb.tobytes() == scene.color(scene.guard(), settings(batch=1)).rgb.tobytes()

    def test_estimate_and_confidence(self, scene):
        assert estimate(scene.volume, [scene.picture], settings(), scene.guard()).slices == 4
        confidence = scene.color(scene.guard(), settings(confidence=True)).confidence
        assert confidence[scene.labels > 0].mean() > 5 and not confidence[scene.labels == 0].all()
