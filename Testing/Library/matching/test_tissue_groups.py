"""Tissue guard: groups, labels that are refused, the command line."""

from __future__ import annotations

import json
import logging

import cv2
import nrrd
import numpy as np
import pytest
import torch
from tissue_guard_samples import (
    BROWN,
    HOST,
    INSERT,
    MATRIX,
    PINK,
    errors,
    settings,
)
from volume_samples import save_nrrd

from MedColorLib import Guard, Volume
from MedColorLib.cli.main import main
from MedColorLib.color.lab import srgb_to_lab
from MedColorLib.errors import InputError, SettingsError
from MedColorLib.matching.fields.field import average_vote, group_vote
from MedColorLib.matching.tissue_guard import MOST_GROUPS, colors_on_grid, groups_on_grid
from MedColorLib.references.photograph import on_grid, prepare_reference
from MedColorLib.run.engine import ReferenceOnGrid
from MedColorLib.run.prepare import prepare
from MedColorLib.scan.grid import choose_grid


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
        with caplog.at_level(logging.WARNING, "MedColorLib"):
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
        given += [
            "--features",
            "embedded",
            "--window",
            "0",
            "1000",
            "--device",
            "cpu",
            "--report",
            files / "r.json",
            "--exposure",
            "off",
        ]
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
        header.update(dict.fromkeys(("space", "space directions", "space origin")))
        save_nrrd(files / "layers.seg.nrrd", np.zeros((*scene.labels.shape, 2), np.uint8), **header)
        assert self.run(files, *more, labels=labels) == 2
        error = capsys.readouterr().err.strip().splitlines()
        assert words in error[-1] and not (files / "out.nrrd").exists()

    @pytest.mark.parametrize("text", ["a", "1,,2", "-5", "3-1", "70000", "1-"])
    def test_label_group_that_is_none(self, files, capsys, text):
        with pytest.raises(SystemExit) as stop:
            self.run(files, f"--label-group={text}")
        assert stop.value.code == 2 and "--label-group" in capsys.readouterr().err
