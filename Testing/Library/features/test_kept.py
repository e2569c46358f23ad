"""Features of references on disk: read instead of made, and only for the very same picture, network and layers."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch

from MedColorLib import Settings, colorize, make_plan
from MedColorLib.features import kept
from MedColorLib.features.contrast_net import Contrast
from MedColorLib.features.kept import reference_features

LAYERS = (5, 4, 3)


class Counted:
    """A network by name that counts what it is asked."""

    name = "vgg19"

    def __init__(self, weights="a", dtype=torch.bfloat16) -> None:
        self.weights, self.dtype, self.calls = weights, dtype, 0

    def provenance(self) -> dict:
        return {"sha256": self.weights, "dtype": str(self.dtype)}

    def extract(self, luminance, layers):
        self.calls += 1
        made = {}
        for layer in layers:
            pooled = torch.nn.functional.avg_pool2d(luminance, 2 ** (layer - 1))
            made[layer] = torch.cat([pooled, pooled.square()], 1).to(self.dtype, memory_format=torch.channels_last)
        return made


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(kept, "kept_folder", lambda: tmp_path / "features")
    return tmp_path / "features"


def picture(seed=0):
    return torch.rand(1, 1, 64, 48, generator=torch.Generator().manual_seed(seed))


def test_read_with_the_same_bytes_instead_of_made(folder):
    network = Counted()
    made, was_kept = reference_features(network, picture(), LAYERS)
    read, is_kept = reference_features(network, picture(), LAYERS)
    assert (was_kept, is_kept, network.calls) == (False, True, 1) and list(read) == list(LAYERS)
    for layer in LAYERS:
        assert read[layer].dtype == torch.bfloat16 and read[layer].stride() == made[layer].stride()
        assert torch.equal(read[layer], made[layer])
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize(
    "other",
    [
        lambda: (Counted(), picture(1), LAYERS),
        lambda: (Counted(weights="b"), picture(), LAYERS),
        lambda: (Counted(dtype=torch.float32), picture(), LAYERS),
        lambda: (Counted(), picture(), (5, 4)),
    ],
)
def test_nothing_else_is_taken_for_it(folder, other):
    reference_features(Counted(), picture(), LAYERS)
    network, luminance, layers = other()
    assert reference_features(network, luminance, layers)[1] is False and network.calls == 1


@pytest.mark.parametrize("damage", [b"", b"nonsense" * 100, None])
def test_damaged_files_are_made_anew_and_said(folder, caplog, damage):
    network = Counted()
    made = reference_features(network, picture(), LAYERS)[0]
    (file,) = folder.iterdir()
    file.write_bytes(file.read_bytes()[:-7] if damage is None else damage)
    again, was_kept = reference_features(network, picture(), LAYERS)
    assert not was_kept and network.calls == 2 and torch.equal(again[3], made[3])
    assert "what was kept is damaged" in caplog.text
    assert reference_features(network, picture(), LAYERS)[1]


def test_a_folder_that_cannot_be_written_costs_no_error(tmp_path, monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(kept, "kept_folder", lambda: tmp_path / "file" / "features")
    assert reference_features(Counted(), picture(), LAYERS)[1] is False
    assert "not kept" in caplog.text and len(list(tmp_path.iterdir())) == 1


def test_the_limit_deletes_what_was_not_read_for_the_longest_time(folder, monkeypatch):
    import os

    for seed in (0, 1):
        reference_features(Counted(), picture(seed), LAYERS)
    size = next(folder.iterdir()).stat().st_size
    for age, file in enumerate(sorted(folder.iterdir(), key=lambda f: f.stat().st_mtime_ns)):
        os.utime(file, (1000 + age, 1000 + age))
    assert reference_features(Counted(), picture(0), LAYERS)[1]  # read: younger than the other now
    monkeypatch.setattr(kept, "MOST_BYTES", 2 * size + 1)
    reference_features(Counted(), picture(2), LAYERS)
    assert len(list(folder.iterdir())) == 2
    assert [reference_features(Counted(), picture(seed), LAYERS)[1] for seed in (0, 2, 1)] == [True, True, False]


def test_what_is_no_kept_feature_is_never_deleted(folder, monkeypatch):
    monkeypatch.setattr(kept, "MOST_BYTES", 1)
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("mine.safetensors", f"{'x' * 64}.safetensors", "notes.txt"):
        (folder / name).write_bytes(bytes(100))
    (folder / f"{'a' * 64}.safetensors").symlink_to(folder / "mine.safetensors")
    (folder / f"{'b' * 64}.safetensors").write_bytes(bytes(100))
    kept._make_room(folder, 50)
    assert not (folder / f"{'b' * 64}.safetensors").exists() and len(list(folder.iterdir())) == 4


def test_own_features_are_not_kept(folder):
    assert reference_features(Contrast(), picture(), LAYERS)[1] is False
    assert not folder.exists()


def test_plan_and_report_of_a_real_network(ct, small_raster, shared_weights, monkeypatch, folder):
    from MedColorLib import Volume
    from MedColorLib.features.vgg19 import VGG19

    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(shared_weights))
    settings = Settings(preset="draft", features="vgg19")
    volume = Volume(ct.volume.array[4:7], ct.volume.ijk_to_ras, name="scan")
    (left_out,) = [e for e in make_plan(volume, [ct.reference], settings).left_out if "reference features" in e.what]
    assert left_out.why == "computed once for all slices and kept on disk by content for the next run"
    seen = []
    extract = VGG19.extract
    monkeypatch.setattr(VGG19, "extract", lambda self, x, layers: seen.append(len(x)) or extract(self, x, layers))
    first = colorize(volume, [ct.reference], settings)
    made = len(seen)
    second = colorize(volume, [ct.reference], settings)
    assert len(seen) == 2 * made - 1
    assert [list(r.report["reference_features"].values()) for r in (first, second)] == [["made"], ["read"]]
    np.testing.assert_array_equal(first.rgb, second.rgb)
