"""The tissue guard: two tissues of one grey keep apart, and no colour crosses from one label group into another."""

from __future__ import annotations

import json
import logging
from dataclasses import replace

import cv2
import nrrd
import numpy as np
import pytest
import torch
from volume_samples import save_nrrd

from MedColorLib import Guard, Settings, Volume, colorize, make_plan
from MedColorLib.cli.main import main
from MedColorLib.color.difference import ciede2000
from MedColorLib.color.lab import gray_to_lightness, lab_to_srgb, srgb_to_lab
from MedColorLib.errors import Cancelled, InputError, SettingsError
from MedColorLib.matching.fields.field import average_vote, group_vote
from MedColorLib.matching.tissue_guard import MOST_GROUPS, colors_on_grid, groups_on_grid
from MedColorLib.references.photograph import on_grid, prepare_reference
from MedColorLib.run.engine import ReferenceOnGrid
from MedColorLib.run.estimate import estimate
from MedColorLib.run.prepare import prepare
from MedColorLib.run.resume import run_key
from MedColorLib.scan.grid import choose_grid

GREY = 0.55  # of both tissues
BROWN, PINK, GREEN = (20.0, 30.0), (55.0, 5.0), (-50.0, 45.0)  # a*, b*
HOST, INSERT, STRANGE = 1, 2, 3  # labels
MATRIX = np.diag([-2.0, -2.0, 4.0, 1.0])


def settings(**changes) -> Settings:
    return Settings(**{"preset": "draft", "features": "embedded", "device": "cpu", "window": (0, 1000), **changes})


def ellipse(shape, centre, radii) -> np.ndarray:
    """(h, w) bool; centre and radii in shares of the height and width."""
    rows, cols = ((np.arange(n) + 0.5) / n for n in shape)
    return ((rows[:, None] - centre[0]) / radii[0]) ** 2 + ((cols - centre[1]) / radii[1]) ** 2 < 1


def plane_of_labels(shape, inserts) -> np.ndarray:
    """(h, w) uint8: a body of HOST with inserts of other labels, 0 outside."""
    labels = np.where(ellipse(shape, (0.5, 0.5), (0.44, 0.42)), HOST, 0).astype(np.uint8)
    for label, centre in inserts:
        labels[ellipse(shape, centre, (0.12, 0.12))] = label
    return labels


def grey_of(labels, rng) -> np.ndarray:
    """Display grey 0..1 in which HOST and INSERT look the same; a dark rim of fixed place gives the eye something."""
    grey = np.where(labels > 0, GREY, 0.0) + 0.02 * rng.normal(size=labels.shape) * (labels > 0)
    inner = ellipse(labels.shape[-2:], (0.5, 0.5), (0.38, 0.36))
    return np.where((labels > 0) & ~inner, 0.35, grey)


def picture_of(labels, rng) -> np.ndarray:
    """(h, w, 3) uint8 photograph: one grey, a colour of its own for each label."""
    colors = np.array([(0, 0), BROWN, PINK, GREEN], np.float64)[labels]
    lab = np.concatenate([gray_to_lightness(np.clip(grey_of(labels, rng), 0, 1))[..., None], colors], -1)
    return np.rint(255 * np.clip(lab_to_srgb(lab), 0, 1)).astype(np.uint8)


class Scene:
    """A scan and a photograph of one body whose inserts lie elsewhere in each."""

    def __init__(self, strange: bool = False, slices: int = 4) -> None:
        rng = np.random.default_rng(7)
        self.labels = np.stack([plane_of_labels((96, 80), [(INSERT, (0.35 + 0.01 * k, 0.4))]) for k in range(slices)])
        grey = np.stack([grey_of(plane, rng) for plane in self.labels])
        self.volume = Volume(np.rint(1000 * grey).astype(np.int16), MATRIX, name="scan")
        extra = [(STRANGE, (0.38, 0.4))] if strange else []  # where the scan has its insert
        self.reference_labels = plane_of_labels((192, 160), [*extra, (INSERT, (0.62, 0.62))])
        self.picture = picture_of(self.reference_labels, rng)

    def guard(self, **changes) -> Guard:
        given = {"labels": Volume(self.labels, MATRIX, name="seg"), "reference_labels": [self.reference_labels]}
        return Guard(**{**given, **changes})

    def color(self, guard=None, given=None, **options):
        return colorize(self.volume, [self.picture], given or settings(), guard=guard, **options)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def errors(result, labels) -> dict[int, float]:
    """Mean CIEDE2000 of each tissue from its own colour, at the result's luminance; two pixels from its border on."""
    lab = srgb_to_lab(result.rgb)
    found = {}
    for label, chroma in ((HOST, BROWN), (INSERT, PINK)):
        own = np.stack([cv2.erode((plane == label).astype(np.uint8), np.ones((3, 3))) for plane in labels]) > 0
        own &= lab[..., 0] > 20
        truth = lab.copy()
        truth[..., 1:] = chroma
        found[label] = float(ciede2000(lab[own], truth[own]).mean())
    return found


class TestColors:
    @pytest.mark.parametrize("preset", ["draft", "balanced"])
    def test_each_tissue_of_one_grey_gets_its_own_color(self, scene, preset):
        """Measured: 0.2 and 0.1 with the guard (both presets), 2.6 to 3.3 and 24 to 25 without."""
        guarded = errors(scene.color(scene.guard(), settings(preset=preset)), scene.labels)
        assert max(guarded.values()) < 1
        free = errors(scene.color(None, settings(preset=preset)), scene.labels)
        assert free[INSERT] > 15

    @pytest.mark.parametrize("smoother", ["fgs", "domain-transform", "wls"])
    def test_every_smoother_that_weighs_matches(self, scene, smoother):
        guarded = errors(scene.color(scene.guard(), settings(smoother=smoother)), scene.labels)
        assert max(guarded.values()) < 1

    def test_full_with_regression(self, small_raster):
        few = Scene(slices=2)
        result = few.color(few.guard(), settings(preset="full", smoother="regression"))
        assert max(errors(result, few.labels).values()) < 4 < errors(few.color(None), few.labels)[INSERT]

    def test_a_hue_of_a_group_that_the_scan_lacks_appears_nowhere(self):
        """The green insert lies, in the photograph, where the scan has its own insert."""
        scene = Scene(strange=True)
        guarded, free = (scene.color(guard).rgb for guard in (scene.guard(), None))
        assert srgb_to_lab(free)[..., 1].min() < -30
        hue = srgb_to_lab(guarded)[..., 1]
        assert hue[guarded.any(-1) & (scene.labels > 0)].min() > 0.8 * BROWN[0] and hue.min() > -1

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
    chroma = np.array([(0, 0), BROWN, PINK, GREEN])

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
        np.testing.assert_array_equal(part.rgb, expected)
        assert expected.any()

    def test_a_reference_upside_down(self, ct):
        """Labels are turned with their picture. The phantom's anatomy tells up from down."""
        from MedColorLib.phantom import labels as anatomy

        tissues = np.pad(anatomy((41, 256, 224))[11], ((4, 4), (12, 12)))
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
        answers = iter([False] * 3 + [True])
        with pytest.raises(Cancelled):
            scene.color(scene.guard(), settings(batch=1), cancelled=lambda: next(answers), resume=tmp_path)
        again = scene.color(scene.guard(), settings(batch=1), resume=tmp_path)
        assert again.report["resumed_slices"] > 0
        assert again.rgb.tobytes() == scene.color(scene.guard(), settings(batch=1)).rgb.tobytes()

    def test_estimate_and_confidence(self, scene):
        assert estimate(scene.volume, [scene.picture], settings(), scene.guard()).slices == 4
        confidence = scene.color(scene.guard(), settings(confidence=True)).confidence
        assert confidence[scene.labels > 0].mean() > 5 and not confidence[scene.labels == 0].all()


class TestGroups:
    def test_labels_of_one_group_belong_together(self, scene):
        """The insert under two labels, joined again."""
        split = scene.labels.copy()
        split[:, :, ::2][split[:, :, ::2] == INSERT] = 40
        guard = scene.guard(labels=Volume(split, MATRIX), groups={INSERT: 7, 40: 7})
        assert guard.present == (0, HOST, 7) and guard.name_of(2) == "2+40"
        assert scene.color(guard).rgb.tobytes() == scene.color(scene.guard()).rgb.tobytes()

    def test_swapped_numbers(self, scene):
        guard = scene.guard(groups={HOST: INSERT, INSERT: HOST})
        assert guard.table[[0, HOST, INSERT, 9]].tolist() == [0, 2, 1, 255]

    def test_group_without_counterpart_is_matched_freely_and_said(self, scene, caplog):
        labels = np.where(scene.reference_labels == INSERT, HOST, scene.reference_labels)
        guard = scene.guard(reference_labels=[labels])
        with caplog.at_level(logging.WARNING, "MedColor"):
            result = scene.color(guard)
        assert "reference 1 lacks 0 (no label), 2: matched freely" in caplog.text
        assert "lacks 0 (no label), 2: matched freely" in result.report["plan"]["steps"]["tissue guard"]
        assert result.report["guard"]["without_counterpart"] == {"reference 1": [0, INSERT]}
        lab = srgb_to_lab(result.rgb)[scene.labels == INSERT]
        assert np.hypot(lab[:, 1], lab[:, 2]).mean() > 15  # coloured all the same

    def test_report_is_plain_data(self, scene):
        report = scene.color(scene.guard()).report["guard"]
        assert json.loads(json.dumps(report)) == report
        assert report["groups"] == {"0": [0], "1": [1], "2": [2]} and len(report["reference_labels_sha256"][0]) == 64
        assert max(report["without_own_match"].values()) < 0.02 and report["grey_voxels"] == 0


class TestRefused:
    def test_another_grid(self, scene):
        short = Volume(scene.labels[:3], MATRIX, name="seg")
        with pytest.raises(InputError, match=r"seg has 3 x 96 x 80 voxels.*scan has 4 x 96 x 80; resample"):
            scene.color(scene.guard(labels=short))
        moved = MATRIX.copy()
        moved[0, 3] = 1.0
        with pytest.raises(InputError, match="up to 1 mm from those of scan; resample"):
            scene.color(scene.guard(labels=Volume(scene.labels, moved, name="seg")))
        moved[0, 3] = 1e-5  # what a file format rounds
        prepare(scene.volume, [scene.picture], settings(), guard=scene.guard(labels=Volume(scene.labels, moved)))

    @pytest.mark.parametrize("value", [0.5, np.nan, np.inf, -1, 65536])
    def test_values_that_are_no_labels(self, value):
        labels = np.zeros((2, 4, 4), np.float64)
        labels[1, 2, 3] = value
        with pytest.raises(InputError, match="whole numbers from 0 to 65535"):
            Guard(Volume(labels, name="seg"))

    def test_whole_numbers_as_float_are_labels(self, scene):
        assert Guard(Volume(scene.labels.astype(np.float32), MATRIX)).present == (0, 1, 2)

    def test_too_many_groups(self):
        many = np.arange(MOST_GROUPS + 4, dtype=np.uint16).reshape(1, 4, -1)
        with pytest.raises(InputError, match=r"20 label groups, at most 16.*--label-group"):
            Guard(Volume(many))
        joined = Guard(Volume(many), groups=dict.fromkeys(range(5, 20), 5))
        assert joined.present == (0, 1, 2, 3, 4, 5)

    @pytest.mark.parametrize("groups", [{1: -1}, {1: 2.5}, {"a": 1}, {True: 1}, {70000: 1}])
    def test_wrong_groups(self, scene, groups):
        with pytest.raises(SettingsError, match="groups: expected whole numbers"):
            scene.guard(groups=groups)

    def test_label_picture_of_another_size(self, scene):
        with pytest.raises(InputError, match="80 x 96 pixels, but the picture of reference 1 has 160 x 192"):
            scene.color(scene.guard(reference_labels=[scene.reference_labels[::2, ::2]]))

    @pytest.mark.parametrize("labels", [np.zeros((192, 160)), np.zeros((192, 160, 3), np.uint8)])
    def test_label_picture_of_another_kind(self, scene, labels):
        with pytest.raises(InputError, match="expected \\(h, w\\) whole numbers"):
            scene.color(scene.guard(reference_labels=[labels]))

    def test_another_number_of_label_pictures(self, scene):
        with pytest.raises(InputError, match="2 label pictures for 1 references"):
            scene.color(scene.guard(reference_labels=[None, None]))

    @pytest.mark.parametrize("changes", [{"smoother": "guided"}, {"preset": "full"}])
    def test_smoothers_that_do_not_weigh_matches(self, scene, changes):
        with pytest.raises(SettingsError, match="use smoother regression, or fgs, domain-transform or wls"):
            scene.color(scene.guard(), settings(**changes))


class TestParts:
    def test_group_vote_counts_only_its_own(self, rng):
        """One-hot reference values: the vote of a pixel is its own group's channel alone, or nothing."""
        reference_groups = torch.from_numpy(rng.integers(0, 3, (9, 10)))
        values = torch.nn.functional.one_hot(reference_groups, 3).permute(2, 0, 1)[None].float()
        field = torch.from_numpy(rng.integers(0, 90, (2, 7, 8)))
        groups = torch.from_numpy(rng.integers(0, 4, (2, 7, 8)))
        mean, voted = group_vote(values, field, groups, reference_groups)
        assert not voted[groups == 3].any() and voted[groups < 3].float().mean() > 0.9
        for n in range(3):
            own = mean.permute(0, 2, 3, 1)[voted & (groups == n)]
            torch.testing.assert_close(own, torch.eye(3)[n].expand_as(own))
        assert not mean.permute(0, 2, 3, 1)[~voted].any()
        free, voted = group_vote(values, field, torch.full_like(groups, -1), reference_groups)
        assert voted.all() and torch.equal(free, average_vote(values, field))

    def test_raster_colors_are_not_mixed(self, scene):
        """Averaged without groups there are colours between brown and pink; within groups there are none."""
        reference, grid = prepare_reference(scene.picture), choose_grid(64)
        labels = reference.frame.cut(scene.reference_labels)
        _, mixed, mask = on_grid(reference, grid)
        lab, groups = colors_on_grid(labels, reference, grid, mask)
        between = (lab[..., 1] > BROWN[0] + 5) & (lab[..., 1] < PINK[0] - 5)
        assert not between.any() and ((mixed[..., 1] > BROWN[0] + 5) & (mixed[..., 1] < PINK[0] - 5)).any()
        assert set(np.unique(groups)) == {HOST, INSERT} or set(np.unique(groups)) == {0, HOST, INSERT}
        np.testing.assert_array_equal(groups_on_grid(labels, reference, grid)[mask], groups[mask])
        np.testing.assert_array_equal(ReferenceOnGrid(reference, grid, labels).lab, lab)
        np.testing.assert_array_equal(ReferenceOnGrid(reference, grid).lab, mixed)

    def test_without_any_vote_the_mean_color_of_the_own_group(self, scene, monkeypatch):
        """As if no match of the insert led to the insert: its own colour all the same, trusted by nobody."""

        def none_for_the_insert(values, field, groups, *rest, **options):
            mean, voted = group_vote(values, field, groups, *rest, **options)
            voted &= groups != 2  # the third group
            return mean * voted[:, None], voted

        monkeypatch.setattr("MedColorLib.matching.vote.group_vote", none_for_the_insert)
        result = scene.color(scene.guard(), settings(confidence=True))
        assert errors(result, scene.labels)[INSERT] < 1.5
        inside = np.stack([cv2.erode((p == INSERT).astype(np.uint8), np.ones((5, 5))) for p in scene.labels]) > 0
        assert inside.any() and not result.confidence[inside].any()
        assert min(result.report["guard"]["without_own_match"].values()) > 0.03


class TestCommandLine:
    @pytest.fixture
    def files(self, scene, tmp_path):
        save_nrrd(tmp_path / "scan.nrrd", scene.volume.array, MATRIX)
        save_nrrd(tmp_path / "seg.seg.nrrd", scene.labels, MATRIX)
        cv2.imwrite(str(tmp_path / "ref.png"), scene.picture[..., ::-1])
        cv2.imwrite(str(tmp_path / "ref-labels.png"), scene.reference_labels)
        return tmp_path

    def run(self, files, *more, labels="seg.seg.nrrd"):
        given = [
            "colorize",
            files / "scan.nrrd",
            "-r",
            files / "ref.png",
            "-o",
            files / "out.nrrd",
            "--preset",
            "draft",
        ]
        given += ["--features", "embedded", "--window", "0", "1000", "--device", "cpu", "--report", files / "r.json"]
        return main([str(a) for a in [*given, *(["--labels", files / labels] if labels else []), *more]])

    def test_same_as_the_library(self, scene, files):
        assert self.run(files, "--reference-labels", files / "ref-labels.png") == 0
        written = nrrd.read(str(files / "out.nrrd"), index_order="C")[0]
        np.testing.assert_array_equal(written, scene.color(scene.guard()).rgb)
        assert json.loads((files / "r.json").read_text())["guard"]["groups"] == {"0": [0], "1": [1], "2": [2]}

    def test_groups_and_a_reference_without_labels(self, files):
        assert self.run(files, "--reference-labels", "-", "--label-group", "1,2", "--label-group", "5-9") == 0
        report = json.loads((files / "r.json").read_text())["guard"]
        assert report["groups"] == {"0": [0], "1": [1, 2]} and report["reference_labels_sha256"] == [None]

    def test_plan(self, files, capsys):
        assert self.run(files, "--plan") == 0
        assert "3 label groups of seg" in capsys.readouterr().out

    @pytest.mark.parametrize(
        ("more", "labels", "words"),
        [
            (["--label-group", "1,2"], None, "name it with --labels"),
            (["--label-group", "1,2", "--label-group", "2,3"], "seg.seg.nrrd", "label 2 is in two groups"),
            ([], "layers.seg.nrrd", "several layers"),
            ([], "none.nrrd", "none.nrrd"),
        ],
    )
    def test_refused_in_one_line(self, scene, files, capsys, more, labels, words):
        header = {"kinds": ["list", "domain", "domain", "domain"], "encoding": "raw"}
        nrrd.write(str(files / "layers.seg.nrrd"), np.zeros((2, *scene.labels.shape[::-1]), np.uint8), header)
        assert self.run(files, *more, labels=labels) == 2
        error = capsys.readouterr().err.strip().splitlines()
        assert words in error[-1] and not (files / "out.nrrd").exists()

    @pytest.mark.parametrize("text", ["a", "1,,2", "-5", "3-1", "70000", "1-"])
    def test_label_group_that_is_none(self, files, capsys, text):
        with pytest.raises(SystemExit) as stop:
            self.run(files, f"--label-group={text}")
        assert stop.value.code == 2 and "--label-group" in capsys.readouterr().err
