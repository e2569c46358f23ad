"""Pipeline: neighbouring slices, confidence, and what is matched."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pipeline_samples import DRAFT, part, settings, with_spacing
from scipy.ndimage import maximum_filter

from MedColorLib import Settings, Volume, colorize
from MedColorLib.color.lab import lightness_to_gray, srgb_to_lab
from MedColorLib.coloring.coherence import GUIDE_SIGMA, MOST_SLICES, SliceAverage, frames
from MedColorLib.features import CONTEXT_WEIGHTS
from MedColorLib.features.contrast_net import Contrast
from MedColorLib.matching import analogy
from MedColorLib.references.photograph import on_grid
from MedColorLib.run.prepare import load_references
from MedColorLib.scan.grid import choose_grid

pytestmark = pytest.mark.usefixtures("small_raster")


class TestCoherence:
    @pytest.mark.parametrize("sigma_mm", [0, 0.4, 1, 2.5, 100])
    @pytest.mark.parametrize("slices", [(0,), (3, 4, 5, 6, 7, 8), (0, 1, 5, 6, 30), (2, 9)])
    def test_gaussian_mean_over_the_neighbours_in_reach(self, slices, sigma_mm):
        average, got = SliceAverage(slices, 0.8, sigma_mm), {}
        values = {k: np.array([1.0, k, k * k]) for k in slices}
        for k in slices:
            ready = list(average.push(k, values[k]))
            assert [r for r, _ in ready] == sorted(r for r, _ in ready)
            got.update(ready)
        assert list(got) == list(slices)
        for k in slices:
            sigma = min(sigma_mm / 0.8, MOST_SLICES)
            near = [n for n in slices if n == k or abs(n - k) <= 2 * sigma]
            weights = [1 if n == k else np.exp(-0.5 * ((n - k) / sigma) ** 2) for n in near]
            expected = sum(w * values[n] for w, n in zip(weights, near)) / sum(weights)
            np.testing.assert_allclose(got[k], expected)

    def test_mean_over_pixels_of_like_grey(self, rng):
        """With guides: the weighted mean of every pixel over its neighbours along the stack, by its own words."""
        values, guides = rng.random((5, 3, 4, 2)), 255 * rng.random((5, 3, 4))
        average, got = SliceAverage(range(5), 1.0, 1.2), {}
        for k in range(5):
            got.update(average.push(k, values[k], guides[k]))
        for k in range(5):
            for row, col in np.ndindex(3, 4):
                near = [n for n in range(5) if abs(n - k) <= 2]
                affinity = [abs(guides[n, row, col] - guides[k, row, col]) / GUIDE_SIGMA for n in near]
                weights = np.exp([-0.5 * ((n - k) / 1.2) ** 2 - a for n, a in zip(near, affinity)])
                expected = (weights[:, None] * values[near, row, col]).sum(0) / weights.sum()
                np.testing.assert_allclose(got[k][row, col], expected)

    def test_boxes_lie_whole_in_themselves_when_nothing_moves(self):
        boxes = np.array([[10, 60, 20, 90]] * 7)
        np.testing.assert_allclose(frames(boxes, 1.0, 5.0), [[0, 1, 0, 1]] * 7, atol=1e-12)
        np.testing.assert_allclose(frames(boxes + np.arange(7)[:, None], 1.0, 0.0), [[0, 1, 0, 1]] * 7, atol=1e-12)

    def test_a_voxel_keeps_its_cell_when_its_box_jumps(self):
        """The middle of a box whose upper edge jumps by 10 of 100 pixels moves by less than 2 in its frame, not by 5."""
        boxes = np.array([[0, 100, 0, 100]] * 21)
        boxes[10, 0] = 10
        places = []
        for box, (top, bottom, _, _) in zip(boxes, frames(boxes, 1.0, 3.0)):
            places.append(top + (50 - box[0]) / (box[1] - box[0]) * (bottom - top))
        assert np.abs(np.array(places) - 0.5).max() < 0.02

    def test_memory_is_that_of_the_neighbours(self):
        average = SliceAverage(range(100), 1.0, 1.5)
        for k in range(100):
            list(average.push(k, np.ones(1)))
            assert len(average._waiting) <= 2 * 3 + 1

    def test_neighbours_share_their_evidence(self, ct, rng):
        """The same slice with other noise each time: what differs from slice to slice is chance."""
        array = np.repeat(ct.volume.array[4:5], 6, 0) + np.rint(rng.normal(0, 200, (6, 64, 56))).astype(np.int16)
        flicker = []
        for mm in (Settings.coherence_mm, 0.0):
            result = colorize(with_spacing(array, 3, 3, 1), [ct.reference], settings(coherence_mm=mm))
            blocks = srgb_to_lab(result.rgb)[..., 1:].reshape(6, 8, 8, 7, 8, 2).mean((2, 4))
            flicker.append(np.abs(np.diff(blocks, axis=0)).mean())
        assert flicker[0] < 0.95 * flicker[1]  # the scan's own noise remains

    def test_distant_slices_do_not(self, ct, colored):
        volume = with_spacing(part(ct).array, 3, 3, 16)
        alone, default = (colorize(volume, [ct.reference], settings(coherence_mm=mm)) for mm in (0.0, 7.9))
        assert alone.rgb.tobytes() == default.rgb.tobytes()  # 16 mm apart, beyond two sigma

    @pytest.mark.parametrize(
        ("changes", "shares"),
        [({"smoother": "guided"}, False), ({"smoother": "fgs"}, True), ({"smoother": "fgs", "preset": "full"}, False)],
    )
    def test_which_smoothers_share(self, ct, changes, shares):
        volume = with_spacing(ct.volume.array[4:7], 3, 3, 1)
        results = [
            colorize(volume, [ct.reference], settings(**{**changes, "coherence_mm": mm})).rgb for mm in (3.0, 0.0)
        ]
        assert (results[0] != results[1]).any() == shares


class TestConfidence:
    def test_volume_of_per_cents_on_the_same_grid(self, ct):
        result = colorize(part(ct), [ct.reference], settings(confidence=True))
        confidence = result.confidence
        assert confidence.shape == result.rgb.shape[:3] and confidence.dtype == np.uint8 and confidence.max() <= 100
        assert not confidence[:, 0].any() and not confidence[:, :, 0].any()
        trusted = {k: (confidence[int(k)] > 55).sum() for k in result.report["trusted_fraction"]}
        assert all(trusted.values())

    def test_asking_for_it_changes_no_colour(self, ct):
        with_it, without = (colorize(part(ct), [ct.reference], settings(confidence=c)).rgb for c in (True, False))
        np.testing.assert_array_equal(with_it, without)

    def test_what_looks_like_nothing_in_the_reference_stays_grey_and_says_so(self, ct, monkeypatch, caplog):
        from MedColorLib.matching import confidence

        monkeypatch.setitem(confidence.LIKENESS_RANGE, "embedded", (2.0, 3.0))  # nothing is ever so alike
        result = colorize(part(ct), [ct.reference], settings())
        assert np.ptp(result.rgb, axis=-1).max() == 0 and result.rgb.any()
        kept = colorize(part(ct), [ct.reference], settings(luminance="keep"))
        np.testing.assert_array_equal(result.rgb, kept.rgb)  # nor is a lightness that nothing vouches for
        assert set(result.report["greyed_slices"].values()) == {0.0}
        assert "choose a reference of the same part of the body" in caplog.text


@pytest.mark.parametrize("luminance", ["keep", "natural"])
def test_vgg19_on_a_real_slice(shared_data, shared_weights, monkeypatch, luminance):
    """CT through eyes and cerebellum after the cryosection: warm colours, cream bone, no blue, black air."""
    from MedColorLib import read_volume

    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(shared_weights))
    volume = read_volume(shared_data / "vhf_head_ct.nrrd")
    one = Volume(volume.array[122:123], volume.ijk_to_ras, name="slice")
    result = colorize(one, [shared_data / "vhf_head_cryosection.png"], settings(features="vgg19", luminance=luminance))
    assert result.report["plan"]["features"] == "vgg19"
    grey, rgb = one.array[0], result.rgb[0].astype(int)
    lab = srgb_to_lab(result.rgb[0])
    soft, bone = (grey > 60) & (grey < 85) & rgb.any(-1), grey > 150
    assert lab[soft, 1].mean() > 4 and lab[soft, 2].mean() > 8  # towards red and yellow
    assert lab[bone, 0].mean() > 55 and 3 < np.hypot(lab[bone, 1], lab[bone, 2]).mean() < 30
    assert (rgb[..., 2] > rgb[..., 0] + 8).mean() < 1e-3
    air = maximum_filter(grey, 5) < 5 if luminance == "natural" else grey < 5  # natural luminance fades beside tissue
    assert air.mean() > 0.3 and rgb[air].max() < 12


class TestWhatIsMatched:
    """A scan of the reference's own section in inverted contrast: the right curve and context are known.

    Of the paper's network, which sees contrast; which channels it has does not matter here.
    """

    @pytest.fixture(autouse=True)
    def network(self, narrow_vgg19):
        pass

    def inverted(self, ct) -> Volume:
        own = load_references([ct.reference])[0]
        grey = 255 * lightness_to_gray(srgb_to_lab(own.rgb / 255)[..., 0])
        array = np.pad(np.where(own.mask, 300 - grey, -1000), 20, constant_values=-1000)
        return with_spacing(array[None].astype(np.float32), 1, 1, 1)

    def run(self, volume, ct, monkeypatch, **changes):
        """Luminance whose features were matched, and the context that joined them."""
        from MedColorLib.features.vgg19 import VGG19

        luminance, contexts = [], []
        extract, match = VGG19.extract, analogy.deep_image_analogy

        def spied_extract(self, planes, layers):
            luminance.append((tuple(layers), planes))
            return extract(self, planes, layers)

        def spied_match(*arguments, **options):
            contexts.append(arguments[5] if len(arguments) > 5 else options.get("context"))
            return match(*arguments, **options)

        monkeypatch.setattr(VGG19, "extract", spied_extract)
        monkeypatch.setattr(analogy, "deep_image_analogy", spied_match)
        result = colorize(volume, [ct.reference], settings(features="vgg19", **changes))
        return result, luminance[-1][1][0, 0].numpy(), contexts[-1]

    def test_scan_in_the_contrast_of_the_photograph(self, ct, monkeypatch):
        grey, _, mask = on_grid(load_references([ct.reference])[0], choose_grid(64))
        result, seen, context = self.run(self.inverted(ct), ct, monkeypatch)
        inside = mask & (seen > 0)
        assert np.corrcoef(seen[inside], grey[inside])[0, 1] > 0.9
        assert "learned" in result.report["contrast"]["reference 1"]
        assert (context.position_weight, context.luminance_weight) == CONTEXT_WEIGHTS["vgg19"]
        np.testing.assert_array_equal(context.target[0, 0].numpy(), seen)
        np.testing.assert_allclose(context.reference[0, 0].numpy(), grey, atol=1e-6)

    def test_grey_that_tells_nothing_does_not_join(self, ct, monkeypatch, rng):
        noise = np.where(ct.inside[4:5], rng.uniform(100, 300, (1, 64, 56)), -1000).astype(np.float32)
        result, _, context = self.run(with_spacing(noise, 1, 1, 1), ct, monkeypatch)
        assert context.luminance_weight < 0.2 * CONTEXT_WEIGHTS["vgg19"][1]
        assert "histogram match" in result.report["contrast"]["reference 1"]

    def test_full_is_the_paper_without_context(self, ct, monkeypatch):
        assert self.run(part(ct, np.s_[4:5]), ct, monkeypatch, preset="full")[2] is None


class TestOwnFeatures:
    """They see no contrast: the scan is matched as it is, and what grey means is read off the matches."""

    def test_the_scans_own_grey_is_matched_whatever_the_photographs(self, ct, monkeypatch):
        seen, extract = [], Contrast.extract

        def spied(self, luminance, layers):
            seen.append(luminance.clone())
            return extract(self, luminance, layers)

        volume = TestWhatIsMatched().inverted(ct)
        monkeypatch.setattr(Contrast, "extract", spied)
        result = colorize(volume, [ct.reference], DRAFT)
        photograph, scan = seen[0][0, 0].numpy(), seen[-1][0, 0].numpy()
        inside = (photograph > 0) & (scan > 0)
        assert np.corrcoef(photograph[inside], scan[inside])[0, 1] < -0.9
        assert result.report["contrast"]["reference 1"].startswith("as the matches show it")

    def test_what_grey_means_falls_where_the_contrast_is_inverted(self, ct):
        from MedColorLib.progress import Run
        from MedColorLib.run.engine import Engine
        from MedColorLib.run.prepare import prepare

        prepared = prepare(TestWhatIsMatched().inverted(ct), [ct.reference], DRAFT)
        contrast = Engine(prepared, Run(None, None)).references[0].contrast
        assert contrast.curve[40] > contrast.curve[200] + 0.3 and contrast.explained > 0.5


def test_extractor_sees_grey_of_the_grid_only(ct, monkeypatch):
    """No colour and nothing outside the body reaches the features."""
    seen = []
    extract = Contrast.extract

    def spied(self, luminance, layers):
        seen.append(luminance.clone())
        return extract(self, luminance, layers)

    monkeypatch.setattr(Contrast, "extract", spied)
    colorize(part(ct), [ct.reference], DRAFT)
    for luminance in seen:
        assert luminance.shape[1:] == (1, 64, 64) and luminance.dtype == torch.float32
        assert luminance.min() >= 0 and luminance.max() <= 1
        assert not luminance[..., :8, :].any() and not luminance[..., -8:].any()
