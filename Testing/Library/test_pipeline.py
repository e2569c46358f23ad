"""The pipeline end to end on the phantom: what `colorize` promises about colours, geometry, memory and its report."""

from __future__ import annotations

import hashlib
import json
import logging
import sys
from collections import Counter
from itertools import permutations, product

import cv2
import numpy as np
import pytest
import torch
from pipeline_samples import DRAFT, MIDDLE, part, settings, with_spacing
from scipy.ndimage import binary_dilation, binary_erosion

from MedColorLib import Settings, Volume, colorize
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.lab import gray_to_lightness, srgb_to_lab
from MedColorLib.errors import Cancelled, DeviceError, InputError, MemoryTooSmall, OutputError
from MedColorLib.phantom import section
from MedColorLib.report import write_report
from MedColorLib.run.engine import Engine
from MedColorLib.run.prepare import load_references, prepare

pytestmark = pytest.mark.usefixtures("small_raster")


def with_rim(inside):
    """The body and the three voxels around it in which its colour fades; a little more, for the outline is found coarsely."""
    return binary_dilation(inside, np.ones((3, 3, 3)), iterations=5)


@pytest.fixture(scope="module")
def kept(ct, small_raster):
    """As `colored`, with the scan's own luminance: what is black in the scan is black."""
    return colorize(part(ct), [ct.reference], settings(luminance="keep"))


class TestColors:
    @pytest.mark.parametrize("preset", ["draft", "full"])
    @pytest.mark.parametrize("modality", ["ct", "mr"])
    def test_close_to_the_true_colors(self, modality, preset, request):
        """Mean CIEDE2000 with the scan's own luminance: grey 16.9, the reference's mean colour 7.8.

        Measured 7.6 (CT, draft) on this coarse raster, on which a fold is two pixels wide; the bounds leave a tenth.
        """
        phantom = request.getfixturevalue(modality)
        result = colorize(part(phantom), [phantom.reference], settings(preset=preset))
        tissue = phantom.labels[MIDDLE] > 0
        lab = srgb_to_lab(result.rgb)
        truth = lab.copy()
        truth[..., 1:] = srgb_to_lab(phantom.colors[MIDDLE])[..., 1:]
        assert ciede2000(lab, truth)[tissue].mean() < 8.4

    @pytest.mark.parametrize(("luminance", "paler"), [("keep", 20), ("natural", 6)])
    def test_bone_is_paler_than_brain_and_nothing_is_blue(self, ct, colored, kept, luminance, paler):
        """L* of bone and grey matter: 31 apart in the photograph and the scan, 8 by natural luminance on this coarse raster."""
        colored = kept if luminance == "keep" else colored
        names = ("air", "skin", "fat", "muscle", "bone", "grey matter", "white matter")
        means = {n: srgb_to_lab(colored.rgb)[ct.labels[MIDDLE] == i].mean(0) for i, n in enumerate(names) if i}
        assert means["bone"][0] > means["grey matter"][0] + paler
        assert means["muscle"][1] > means["fat"][1] and all(lab[2] > 2 for lab in means.values())
        assert (colored.rgb[..., 2] <= colored.rgb[..., 0]).mean() > 0.999

    def test_black_outside_and_in_air_inside(self, ct, colored, kept):
        assert not colored.rgb[~with_rim(ct.inside)[MIDDLE]].any() and not kept.rgb[~with_rim(ct.inside)[MIDDLE]].any()
        sinus = binary_erosion((ct.labels[MIDDLE] == 0) & ct.inside[MIDDLE], np.ones((1, 5, 5)))
        assert sinus.any() and kept.rgb[sinus].max() < 12  # walls between sinuses are seen in voxels beside them
        assert (
            srgb_to_lab(colored.rgb[sinus])[..., 0].max() < 12
        )  # beside tissue natural luminance fades over some pixels

    def test_luminance_kept_is_the_scans_where_srgb_holds_the_colour(self, ct, kept):
        prepared = prepare(part(ct), [ct.reference], DRAFT)
        window, body = prepared.window, np.stack([prepared.body.painted(k, prepared.view[k]) for k in range(5)])
        grey = np.clip((ct.volume.array[MIDDLE].astype(float) - window.low) / (window.high - window.low), 0, 1)
        change = srgb_to_lab(kept.rgb)[..., 0] - gray_to_lightness(grey)
        inner = binary_erosion(body, np.ones((1, 11, 11)))  # its border fades as the scan does: `coloring.rim`
        lower = np.count_nonzero(change[inner] < -0.9)  # L* that gave way to chroma; between it and 0.4 lies rounding
        assert inner.mean() > 0.2 and change[inner].max() < 0.4 and np.percentile(change[inner], 10) > -0.4
        assert 0 < lower <= kept.report["lightness_bent_pixels"] < 0.2 * body.sum()

    def test_luminance_natural_or_of_the_paper_is_nearer_to_the_references(self, ct, colored):
        paper, keep = (colorize(part(ct), [ct.reference], settings(luminance=one)) for one in ("paper", "keep"))
        tissue = ct.labels[MIDDLE] > 0
        truth = srgb_to_lab(ct.colors[MIDDLE])[tissue]
        errors = [ciede2000(srgb_to_lab(result.rgb)[tissue], truth).mean() for result in (paper, colored, keep)]
        assert max(errors[:2]) < errors[2]

    @pytest.mark.parametrize("smoother", ["fgs", "guided", "domain-transform", "wls"])
    def test_every_smoother(self, ct, smoother):
        result = colorize(part(ct, np.s_[4:5]), [ct.reference], settings(smoother=smoother))
        lab = srgb_to_lab(result.rgb)[ct.labels[4:5] > 0]
        assert 5 < np.hypot(lab[:, 1], lab[:, 2]).mean() < 40 and result.report["plan"]["smoother"] == smoother


class TestGeometryAndInput:
    def test_geometry_is_kept_to_the_last_bit(self, ct, rng):
        matrix = np.eye(4)
        matrix[:3] = rng.normal(0, 1, (3, 4)) + 3 * np.eye(3, 4)
        result = colorize(Volume(ct.volume.array[4:6], matrix), [ct.reference], settings(plane="acquired"))
        assert result.ijk_to_ras.tobytes() == matrix.tobytes()
        assert result.rgb.shape == (2, 64, 56, 3) and result.rgb.dtype == np.uint8

    def test_input_is_not_altered(self, ct):
        array, reference = ct.volume.array[4:6].copy(), ct.reference.copy()
        before = array.tobytes(), reference.tobytes()
        colorize(with_spacing(array, 1, 1, 1), [reference], DRAFT)
        assert (array.tobytes(), reference.tobytes()) == before

    @pytest.mark.parametrize(
        ("axes", "signs"), list(product(permutations((0, 1, 2)), product((1, -1), repeat=3)))[1::6]
    )
    def test_any_orientation_gives_the_same_colors(self, ct, colored, axes, signs):
        """Sagittal, coronal, reversed, left-handed: the same voxels in the body get the same bytes."""
        back = tuple(slice(None, None, sign) for sign in signs)
        array = ct.volume.array[MIDDLE].transpose(axes)[back]
        ways = np.array([[0, 0, 16], [0, -3.2, 0], [-3.2, 0, 0]], float)  # up, back, left with the phantom's spacing
        matrix = np.eye(4)
        matrix[:3, :3] = np.array([ways[axis] * sign for axis, sign in zip(axes, signs)])[::-1].T
        result = colorize(Volume(array, matrix), [ct.reference], DRAFT)
        np.testing.assert_array_equal(result.rgb, colored.rgb.transpose(*axes, 3)[back])

    @pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8", ">i2", ">f4"])
    def test_every_type_gives_the_same_colors(self, ct, dtype):
        small = np.clip(ct.volume.array[4:5] // 16 + 64, 0, 127).astype(np.int16)
        expected = colorize(with_spacing(small, 1, 1, 1), [ct.reference], DRAFT)
        result = colorize(with_spacing(small.astype(dtype), 1, 1, 1), [ct.reference], DRAFT)
        np.testing.assert_array_equal(result.rgb, expected.rgb)

    def test_a_mask_is_no_picture(self, ct):
        with pytest.raises(InputError, match=r"window: the body holds the single value 1; give a window \(LO HI\)"):
            colorize(with_spacing(ct.inside[4:6], 1, 1, 1), [ct.reference], DRAFT)
        shown = settings(window=(0, 1), luminance="keep")
        white = colorize(with_spacing(ct.inside[4:6], 1, 1, 1), [ct.reference], shown)
        assert white.rgb[ct.inside[4:6]].max(-1).min() > 250 and not white.rgb[~ct.inside[4:6]].any()

    @pytest.mark.parametrize(("luminance", "most"), [("keep", 2), ("natural", 10)])
    def test_units_do_not_matter(self, ct, luminance, most):
        """But for the rounding of the window's ends, which may move a match that another equals: that shows in lightness.

        Of units that are not known: in Hounsfield units soft tissue is known.
        """
        base, *others = (
            colorize(
                Volume(ct.volume.array[MIDDLE] * scale, ct.volume.ijk_to_ras),
                [ct.reference],
                settings(luminance=luminance),
            )
            for scale in (7.0, 1e-30, 1e30, 1e300)
        )
        assert len(others) == 3
        for other in others:
            self.near(other, base, most)

    def near(self, result, base, most):
        difference = np.abs(result.rgb.astype(int) - base.rgb)
        assert np.percentile(difference, 99) <= most and difference.mean() < 0.8

    @pytest.mark.parametrize("luminance", ["keep", "natural"])
    def test_nan_infinities_padding_and_metal(self, ct, colored, kept, rng, luminance):
        values = ct.volume.array[MIDDLE].astype(np.float32)
        bad = rng.random(values.shape) < 0.01
        values[bad] = rng.choice([np.nan, -np.inf], bad.sum())
        values[:, :3, :3] = -32768
        values[2, 30:33, 25:28] = 30000
        result = colorize(Volume(values, ct.volume.ijk_to_ras), [ct.reference], settings(luminance=luminance))
        assert "are not finite and are treated as air" in result.report["plan"]["steps"]["volume"]
        assert luminance == "natural" or not result.rgb[bad].any()
        assert np.abs(result.rgb.astype(int) - (kept if luminance == "keep" else colored).rgb)[~bad].mean() < 8

    @pytest.mark.parametrize(
        "shape", [(1, 64, 56), (12, 1, 56), (12, 64, 1), (1, 1, 56), (1, 64, 1), (2, 17, 31), (3, 100, 23), (2, 3, 5)]
    )
    def test_any_size(self, ct, shape):
        index = [np.linspace(0, n - 1, m).astype(int) if m > 1 else [n // 2] for n, m in zip((12, 64, 56), shape)]
        result = colorize(with_spacing(ct.volume.array[np.ix_(*index)], 2, 2, 5), [ct.reference], DRAFT)
        assert result.rgb.shape == (*shape, 3) and result.rgb.any()

    @pytest.mark.parametrize("spacing", [(0.01, 0.01, 0.01), (50, 50, 50), (0.01, 50, 1), (1, 1, 1000)])
    def test_extreme_spacing(self, ct, spacing):
        result = colorize(with_spacing(ct.volume.array[4:6], *spacing), [ct.reference], DRAFT)
        assert not result.rgb[~with_rim(ct.inside[4:6])].any() and result.rgb[ct.labels[4:6] > 0].any(-1).mean() > 0.99


class TestRepeatable:
    def test_same_bytes_twice_and_with_any_batch(self, ct, colored):
        np.random.seed(3)  # noqa: NPY002 - chance from elsewhere must not matter
        torch.manual_seed(3)
        again = colorize(part(ct), [ct.reference], DRAFT)
        assert again.rgb.tobytes() == colored.rgb.tobytes()
        for batch in (1, 3):
            result = colorize(part(ct), [ct.reference], settings(batch=batch))
            assert result.rgb.tobytes() == colored.rgb.tobytes()

    def test_references_as_arrays_files_and_folders_are_the_same(self, ct, colored, tmp_path):
        cv2.imwrite(str(tmp_path / "section.png"), ct.reference[..., ::-1])
        for given in (ct.reference, tmp_path / "section.png", [str(tmp_path / "section.png")], str(tmp_path)):
            assert colorize(part(ct), given, DRAFT).rgb.tobytes() == colored.rgb.tobytes()


class TestSeveralReferences:
    def test_each_slice_takes_the_section_of_its_level(self, ct):
        low, high = section(-0.45), section(0.55)
        for references, names in (([low, high], ("1", "2")), ([high, low], ("2", "1"))):
            report = colorize(ct.volume, references, DRAFT).report
            chosen = report["reference_of_slice"]
            assert chosen["4"] == f"reference {names[0]}" and chosen["8"] == f"reference {names[1]}"
            assert set(report["contrast"]) == {"reference 1", "reference 2"}

    def test_a_reference_that_no_slice_takes_changes_nothing(self, ct, colored):
        other = np.full((80, 90, 3), (28, 74, 120), np.uint8)
        other[20:60, 30:60] = np.random.default_rng(0).integers(0, 60, (40, 30, 1)) + np.array([150, 60, 50])
        result = colorize(part(ct), [ct.reference, other], DRAFT)
        assert set(result.report["reference_of_slice"].values()) == {"reference 1"}
        assert result.rgb.tobytes() == colored.rgb.tobytes()

    @pytest.mark.parametrize("none", [[], ()])
    def test_none(self, ct, none):
        with pytest.raises(InputError, match="references: none given; name at least one colour picture"):
            colorize(part(ct), none, DRAFT)

    def test_folder_without_pictures(self, tmp_path):
        (tmp_path / "notes.txt").write_text("no picture")
        with pytest.raises(InputError, match="holds no picture"):
            load_references([tmp_path])


class TestProgressAndCancel:
    def test_progress_rises_from_0_to_1(self, ct):
        seen = []
        colorize(part(ct), [ct.reference], settings(batch=1), progress=lambda f, text: seen.append((f, text)))
        fractions = [f for f, _ in seen]
        assert fractions[0] == 0 and fractions[-1] == 1 and fractions == sorted(fractions)
        assert [t for _, t in seen if t.startswith("slice")] == [f"slice {n} of 5" for n in range(1, 6)]

    @pytest.mark.parametrize("after", [0, 1, 2, 4])
    def test_cancelled_between_any_two_steps(self, ct, after):
        seen = []
        with pytest.raises(Cancelled):
            colorize(
                part(ct),
                [ct.reference],
                settings(batch=1),
                progress=lambda f, _: seen.append(f),
                cancelled=lambda: len(seen) >= after,
            )
        assert len(seen) == after

    def test_whatever_goes_slice_by_slice_can_be_cancelled_at_each(self, ct):
        """Asked by each of these for every slice: the whole stack of 512 x 512 x 200 takes some of them seconds."""
        asking = Counter()

        def cancelled():
            frame = sys._getframe()
            while frame := frame.f_back:
                asking[frame.f_code.co_name] += 1
                if "function" in frame.f_locals:  # on a thread of its own: what `taken_along` is about to call
                    asking[frame.f_locals["function"].__qualname__] += 1
            return False

        result = colorize(part(ct), [ct.reference], settings(), cancelled=cancelled)
        count = len(result.report["plan"]["slices"])
        stages = ("check_values", "_flags", "mark_plates", "_find_parts", "_select", "_fill")
        apart = ("Evidence._sums", "Evidence._relation", "Evidence._remainder", "Painter._color")
        assert {stage: asking[stage] for stage in (*stages, *apart) if asking[stage] < count} == {}
        assert asking["_repeats"] == count - 1
        assert asking["Engine._learn_from_own_matches.<locals>.matched"]
        assert asking["_scores.<locals>.<lambda>"], "which way up the reference lies"


class TestMemory:
    def short_of_memory(self, monkeypatch, limit, error=None):
        matched = Engine.match

        def limited(engine, ks, index):
            if len(ks) > limit:
                raise error or torch.cuda.OutOfMemoryError("CUDA out of memory")
            return matched(engine, ks, index)

        monkeypatch.setattr(Engine, "match", limited)

    def test_smaller_batches_where_memory_is_short(self, ct, colored, monkeypatch, caplog):
        self.short_of_memory(monkeypatch, 1)
        with caplog.at_level(logging.WARNING, "MedColorLib"):
            result = colorize(part(ct), [ct.reference], settings(batch=4))
        assert result.rgb.tobytes() == colored.rgb.tobytes()
        assert [r.getMessage().split(":")[1].strip() for r in caplog.records] == [
            "batches of 2 slices from here on",
            "batches of 1 slices from here on",
        ]

    @pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
    def test_smaller_batches_on_a_cpu_too(self, ct, colored, error, monkeypatch):
        self.short_of_memory(monkeypatch, 2, error)
        assert colorize(part(ct), [ct.reference], settings(batch=4)).rgb.tobytes() == colored.rgb.tobytes()

    def test_memory_that_ends_elsewhere(self, ct, monkeypatch):
        def ended(*_, **__):
            raise MemoryError("Unable to allocate 9 TiB")

        monkeypatch.setattr("MedColorLib.run.paint.Painter.add", ended)
        with pytest.raises(MemoryTooSmall, match="device cpu: its memory is too small"):
            colorize(part(ct), [ct.reference], DRAFT)

    def test_not_even_one_slice_fits(self, ct, monkeypatch):
        self.short_of_memory(monkeypatch, 0)
        with pytest.raises(
            DeviceError, match=r"device cpu: its memory is too small; .* --preset draft or --device cpu"
        ):
            colorize(part(ct), [ct.reference], DRAFT)


class TestReport:
    def test_what_it_holds(self, ct, colored):
        report = colored.report
        array = part(ct).array
        assert report["input"]["sha256"] == hashlib.sha256(array.tobytes()).hexdigest()
        assert report["input"]["shape_kji"] == [5, 64, 56] and report["input"]["dtype"] == "int16"
        assert np.array_equal(report["input"]["ijk_to_ras"], ct.volume.ijk_to_ras)
        assert Settings.from_dict(report["settings"]) == DRAFT
        assert report["settings"]["seed"] == 0
        assert report["plan"]["slices"] == tuple(range(5)) and report["plan"]["left_out"]
        assert report["plan"]["features"] == "embedded" and report["plan"]["device"] == "cpu"
        assert {"prepare", "network", "features", "matching", "colour", "total"} <= set(report["seconds"])
        assert all(value >= 0 for value in report["seconds"].values())
        assert 10 < report["peak_memory_mb"] < 1e5
        assert {"python", "torch", "numpy", "medcolor"} <= set(report["environment"]["versions"])
        assert report["environment"]["device"] == "cpu"
        assert report["out_of_gamut_pixels"] >= 0
        assert report["searched"] == {"3": "exact"}
        assert "not a measurement" in report["notice"]
        assert report["reference_of_slice"] == {str(k): "reference 1" for k in range(5)}
        assert set(report["references"][0]) >= {"name", "sha256", "removed_fraction"}

    def test_hash_is_of_the_voxels_whatever_their_order_in_memory(self, ct, colored):
        fortran = Volume(np.asfortranarray(part(ct).array), ct.volume.ijk_to_ras)
        assert colorize(fortran, [ct.reference], DRAFT).report["input"]["sha256"] == colored.report["input"]["sha256"]

    def test_comes_back_from_json(self, colored, tmp_path):
        write_report(colored.report, tmp_path / "report.json")
        back = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
        assert back == json.loads(json.dumps(colored.report, allow_nan=False))
        assert Settings.from_dict(back["settings"]) == DRAFT
        assert [p.name for p in tmp_path.iterdir()] == ["report.json"]

    def test_no_folder_in_it(self, ct, tmp_path):
        folder = tmp_path / "Doe^Jane 1970"
        folder.mkdir()
        cv2.imwrite(str(folder / "section.png"), ct.reference[..., ::-1])
        report = colorize(part(ct, np.s_[4:5]), [folder / "section.png"], DRAFT).report
        text = json.dumps(report)
        assert "Doe" not in text and str(tmp_path) not in text and report["references"][0]["name"] == "section"

    @pytest.mark.parametrize("name", ["missing/report.json", "folder"])
    def test_where_it_cannot_be_written(self, tmp_path, name):
        (tmp_path / "folder").mkdir()
        with pytest.raises(OutputError, match=rf"{name}: (cannot be written|is a folder)"):
            write_report({"a": 1}, tmp_path / name)
        assert [p.name for p in tmp_path.iterdir()] == ["folder"]

    def test_an_unfinished_report_leaves_the_former_one(self, tmp_path):
        write_report({"a": 1}, tmp_path / "report.json")
        with pytest.raises(TypeError):
            write_report({"a": object()}, tmp_path / "report.json")
        assert json.loads((tmp_path / "report.json").read_text()) == {"a": 1}
        assert [p.name for p in tmp_path.iterdir()] == ["report.json"]
