"""Weights: every kind of file is read as what it holds, anything else is refused, downloads survive what networks do.

All files are made here, for a narrow VGG-19 of a few hundred kilobytes; the server is on the loopback interface.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import pickle
import random
import struct
import zipfile

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from weights_samples import (
    WRITERS,
    random_tensors,
    write_quantised,
    written,
)

from MedColorLib.errors import SettingsError, WeightsError
from MedColorLib.features import checkpoints, network_weights, weights
from MedColorLib.features.architectures import ARCHITECTURES, Architecture

pytestmark = pytest.mark.usefixtures("cache")


@pytest.mark.parametrize("kind", WRITERS)
def test_every_kind_of_file_gives_the_tensors_it_was_made_of(kind, tmp_path):
    path, tensors, preprocessing, network = written(kind, tmp_path)
    found = weights.inspect_weights(path)
    assert (found.network, found.preprocessing, found.has_descriptor) == (network, preprocessing, network == "vgg19")
    loaded = weights.load_weights(path)
    assert (loaded.network, loaded.preprocessing) == (network, preprocessing)
    assert loaded.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    for name, expected in tensors.items():
        if kind == "gray-caffemodel" and name not in loaded:
            assert name.startswith("conv")  # Caffe's normalisations have neither gain nor shift of their own
            continue
        value = loaded.tensor(name)
        quantum = (expected.max() - expected.min()).item() / 255 if kind == "quantised" else 0
        half = 2**-11 if name == "fc6.weight" and "safetensors" not in kind else 1e-6
        assert value.dtype == torch.float32
        torch.testing.assert_close(value, expected, rtol=half, atol=0.5 * quantum * (1 + 1e-5) + 1e-7)
        torch.testing.assert_close(torch.cat([rows for _, rows in loaded.row_blocks(name, 3)]), value, rtol=0, atol=0)


@pytest.mark.parametrize("kind", WRITERS)
def test_a_conversion_is_made_once_and_leaves_nothing_else(kind, tmp_path, cache, monkeypatch):
    path, *_ = written(kind, tmp_path)
    weights.load_weights(path)
    before = {file: file.stat().st_mtime_ns for file in cache.rglob("*") if file.is_file()}
    assert len(before) == (0 if kind in ("safetensors", "safetensors-torchvision", "quantised") else 1)
    assert all(file.suffix == ".safetensors" for file in before)
    monkeypatch.setattr(network_weights, "_save", None)  # would fail if called
    weights.load_weights(path)
    assert {file: file.stat().st_mtime_ns for file in cache.rglob("*") if file.is_file()} == before


def test_a_spoilt_conversion_is_made_again(tmp_path, cache):
    path, tensors, *_ = written("pth", tmp_path)
    converted = weights.load_weights(path).path
    size = converted.stat().st_size
    converted.write_bytes(converted.read_bytes()[:-1])
    assert weights.find_weights() is None  # conversions are looked up by their source alone
    torch.testing.assert_close(weights.load_weights(path).tensor("conv2_2.bias"), tensors["conv2_2.bias"])
    assert converted.stat().st_size == size


def test_full_size_tables_are_vgg19():
    full = Architecture("vgg19")
    required = full.required()
    # Known figures of configuration E: 16 convolutions, 20 024 384 weights; with fc6, 122 788 928.
    assert sum(int(np.prod(shape)) for shape in required.values()) == 20_024_384
    assert sum(int(np.prod(shape)) for shape in full.optional().values()) == 25088 * 4096 + 4096
    assert required["conv5_1.weight"] == (512, 512, 3, 3)


def assert_refused(path, *words):
    with pytest.raises(WeightsError) as caught:
        weights.load_weights(path)
    text = str(caught.value)
    assert path.name in text
    assert "MEDCOLOR_WEIGHTS" in text or "fetch" in text
    for word in words:
        assert word in text


@pytest.mark.parametrize("kind", WRITERS)
def test_truncated_anywhere_is_refused(kind, tmp_path, cache):
    path, *_ = written(kind, tmp_path)
    content = path.read_bytes()
    lengths = {0, 1, 8, 9, 31, 40, 200, len(content) // 3, len(content) // 2, len(content) - 100, len(content) - 1}
    for length in sorted(lengths):
        path.write_bytes(content[:length])
        assert_refused(path)
    assert not [file for file in cache.rglob("*") if file.is_file()]


@pytest.mark.parametrize("kind", WRITERS)
def test_damaged_bytes_are_refused_or_harmless(kind, tmp_path):
    """A flipped byte may change a weight, or be refused with the one error meant for it: nothing else may come out."""
    path, tensors, *_ = written(kind, tmp_path)
    content, dice = path.read_bytes(), random.Random(7)
    outcomes = {"refused": 0, "read": 0}
    for _ in range(60):
        # Headers are where a flip is dangerous: at the start, and in zip files at the end.
        at = dice.choice([dice.randrange(64), dice.randrange(2000), len(content) - 1 - dice.randrange(800)])
        flipped = bytearray(content)
        flipped[at] ^= 1 << dice.randrange(8)
        path.write_bytes(flipped)
        try:
            loaded = weights.load_weights(path)
            assert {name for name in tensors if name in loaded}
            outcomes["read"] += 1
        except WeightsError:
            outcomes["refused"] += 1
    assert outcomes["refused"] > 0


class Intruder:
    """Touches a file when unpickled by a careless reader."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_pickle_that_runs_a_program_is_refused_and_not_run(zipped, tmp_path):
    path, trace = tmp_path / "evil.pth", tmp_path / "ran"
    torch.save({"features.0.weight": Intruder(trace)}, path, _use_new_zipfile_serialization=zipped)
    assert_refused(path, "refused")
    assert not trace.exists()
    pickle.loads(pickle.dumps(Intruder(trace)))  # the trap does work
    assert trace.exists()


def test_compressed_or_swollen_archives_are_refused_before_unpacking(tmp_path, monkeypatch):
    path, *_ = written("pth", tmp_path)
    squeezed = tmp_path / "squeezed.pth"
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(squeezed, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.infolist():
            new.writestr(entry.filename, old.read(entry))
    assert_refused(squeezed, "compressed")
    np.savez_compressed(tmp_path / "bomb.npz", zeros=np.zeros(200_000))
    monkeypatch.setattr(checkpoints, "MAX_FILE_BYTES", 100_000)
    assert_refused(tmp_path / "bomb.npz", "unpacks to more")


def test_numpy_files_with_objects_or_lying_headers_are_refused(tmp_path, tmp_path_factory):
    np.savez(tmp_path / "objects.npz", conv1_1_w=np.array([{}], dtype=object))
    assert_refused(tmp_path / "objects.npz", "bytes for object")
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f4", "fortran_order": False, "shape": (1 << 40,)})
    with zipfile.ZipFile(tmp_path / "lying.npz", "w") as archive:
        archive.writestr("conv1_1_w.npy", buffer.getvalue())
    assert_refused(tmp_path / "lying.npz", "1099511627776")


def safetensors_bytes(header, body=b"", length=None):
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + body


@pytest.mark.parametrize(
    "content",
    [
        safetensors_bytes({}, length=1 << 62),
        safetensors_bytes({}, length=1 << 30),
        safetensors_bytes({"a": {"dtype": "F32", "shape": [1 << 40], "data_offsets": [0, 1 << 42]}}),
        safetensors_bytes({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 4]}}, bytes(4)),
        safetensors_bytes({"a": {"dtype": "F99", "shape": [1], "data_offsets": [0, 4]}}, bytes(4)),
        safetensors_bytes({"a": {"dtype": "F32", "shape": "x", "data_offsets": [0, 4]}}, bytes(4)),
        safetensors_bytes({"a": [1, 2, 3, 4, 5, 6, 7, 8, 9]}),
        safetensors_bytes({"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}, bytes(5)),
        struct.pack("<Q", 40) + b"{" * 40,
    ],
)
def test_lying_safetensors_headers_are_refused(content, tmp_path):
    path = tmp_path / "lying.safetensors"
    path.write_bytes(content.ljust(40, b" ") if len(content) < 40 else content)
    assert_refused(path)


def test_other_files_are_refused_with_what_was_found(tmp_path):
    page = tmp_path / "vgg19.pth"
    page.write_bytes(b"<!DOCTYPE html><html><body>404 not found</body></html>")
    assert_refused(page, "not a file of weights", "<!DOCTYPE")
    with pytest.raises(WeightsError, match="directory"):
        weights.load_weights(tmp_path)
    with pytest.raises(WeightsError):
        weights.load_weights(tmp_path / "absent.pth")


def test_other_networks_are_named_in_the_refusal(tmp_path):
    resnet = tmp_path / "resnet.pth"
    torch.save({"layer1.0.conv1.weight": torch.zeros(64, 3, 7, 7), "fc.bias": torch.zeros(1000)}, resnet)
    assert_refused(resnet, "layer1.0.conv1.weight (64, 3, 7, 7)")
    torch.save([torch.zeros(100)], resnet)
    assert_refused(resnet, "list")
    # VGG-16 is VGG-19 without three of its convolutions.
    vgg16 = {name: v for name, v in random_tensors().items() if name[:7] not in ("conv3_4", "conv4_4", "conv5_4")}
    save_file(vgg16, tmp_path / "vgg16.safetensors")
    assert_refused(tmp_path / "vgg16.safetensors", "resembles vgg19", "conv3_4.weight", "is missing", "3 more")


@pytest.mark.parametrize("name", ["conv1_1.weight", "conv3_2.bias", "fc6.weight", "fc6.bias"])
def test_missing_or_misshapen_tensors_are_named(name, tmp_path):
    tensors = random_tensors()
    path = tmp_path / "vgg.safetensors"
    save_file({**tensors, name: torch.zeros(7, 7)}, path)
    assert_refused(path, f"{name} has shape (7, 7) instead of")
    save_file({key: value for key, value in tensors.items() if key != name}, path)
    assert_refused(path, "fc6 lacks" if "fc6" in name else f"{name} {tuple(tensors[name].shape)} is missing")


def test_batch_normalisation_is_never_dropped_silently(tmp_path):
    """Half of a gray VGG-19 must not pass for a plain one, whose names it holds."""
    tensors = random_tensors("gray-vgg19")
    del tensors["data_bn.running_mean"]
    save_file(tensors, tmp_path / "half.safetensors")
    assert_refused(tmp_path / "half.safetensors", "gray-vgg19", "data_bn.running_mean")


@pytest.mark.parametrize("kind", ["safetensors", "pth-caffe-names"])
@pytest.mark.parametrize("name", ["conv4_4.bias", "fc6.weight"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_refused(kind, name, bad, tmp_path):
    tensors = random_tensors()
    tensors[name].view(-1)[-1] = bad
    path = tmp_path / "bad.weights"
    WRITERS[kind][0](path, tensors)
    with pytest.raises(WeightsError, match=name):
        loaded = weights.load_weights(path)
        [rows for _, rows in loaded.row_blocks(name)]


def test_types_are_checked(tmp_path):
    tensors = random_tensors()
    path = tmp_path / "typed.safetensors"
    save_file({**tensors, "conv1_1.bias": torch.zeros(2, dtype=torch.int32)}, path)
    with pytest.raises(WeightsError, match="int32 instead of floating point"):
        weights.load_weights(path).tensor("conv1_1.bias")
    write_quantised(path, tensors)
    stored = {name: value.clone() for name, value in open_all(path).items()}
    del stored["conv2_1.bias.min"]
    save_file(stored, path)
    assert_refused(path, "conv2_1.bias is quantised, but lacks")


def open_all(path):
    checkpoint = checkpoints.open_checkpoint(path)
    return {name: checkpoint.read(name) for name in checkpoint.shapes}


def test_an_unwritable_cache_is_told_and_leaves_nothing(tmp_path, cache, monkeypatch):
    path, *_ = written("pth", tmp_path)
    cache.write_text("a file where a folder is needed")
    with pytest.raises(WeightsError, match="cannot be written"):
        weights.load_weights(path)
    cache.unlink()
    monkeypatch.setattr(
        os, "replace", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space left on device"))
    )
    with pytest.raises(WeightsError, match="No space left"):
        weights.load_weights(path)
    assert not [file for file in cache.rglob("*") if file.is_file()]


# Where weights are looked for.
def test_nothing_is_found_where_nothing_is():
    assert weights.find_weights() is None
    assert [row["present"] for row in weights.weights_status()] == [False, False]
    with pytest.raises(SettingsError, match="resnet"):
        weights.find_weights("resnet")


def test_the_setting_comes_before_the_cache(tmp_path, cache, monkeypatch):
    cache.mkdir()
    in_cache, *_ = written("quantised", cache)
    in_cache = in_cache.rename(cache / "any name.safetensors")
    assert weights.find_weights().path == in_cache
    assert weights.find_weights("gray-vgg19") is None
    named, *_ = written("pth", tmp_path)
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(named))
    assert weights.find_weights().path == named
    weights.load_weights(named)
    assert weights.find_weights().path == named  # also when a conversion exists
    gray, *_ = written("gray-pth", tmp_path)
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(gray))
    assert weights.find_weights("gray-vgg19").path == gray
    assert weights.find_weights("vgg19").path == in_cache


def test_a_wrong_setting_is_an_error_not_a_silence(tmp_path, monkeypatch):
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(tmp_path / "gone.pth"))
    with pytest.raises(WeightsError, match=r"gone\.pth, which does not exist"):
        weights.find_weights()
    assert all("does not exist" in row["problem"] for row in weights.weights_status())
    (tmp_path / "broken.pth").write_bytes(b"x" * 100)
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(tmp_path / "broken.pth"))
    with pytest.raises(WeightsError, match="not a file of weights"):
        weights.find_weights()


def test_in_a_folder_damaged_files_are_passed_over_with_a_warning(tmp_path, monkeypatch, caplog):
    folder = tmp_path / "models"
    folder.mkdir()
    (folder / "a.safetensors").write_bytes(b"x" * 100)
    (folder / "readme.txt").write_text("not looked at")
    good = written("caffemodel", folder)[0].rename(folder / "b.caffemodel")
    monkeypatch.setenv("MEDCOLOR_WEIGHTS", str(folder))
    with caplog.at_level("WARNING", "MedColorLib"):
        assert weights.find_weights().path == good
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "a.safetensors" in caplog.text


def test_status_is_plain_data_for_both_networks(cache):
    cache.mkdir()
    path = written("safetensors", cache)[0].rename(cache / "x.safetensors")
    rows = json.loads(json.dumps(weights.weights_status()))
    assert [(row["network"], row["present"]) for row in rows] == [("vgg19", True), ("gray-vgg19", False)]
    assert rows[0]["path"] == str(path) and rows[0]["preprocessing"] == "oxford"


def test_the_manifest_is_complete_and_honest():
    entries = weights.manifest()
    assert set(entries) == set(ARCHITECTURES)
    for entry in entries.values():
        assert entry["citation"] and entry["licence"] and entry["note"]
        assert (entry["url"] is None) == (entry["sha256"] is None)  # nothing is downloaded that cannot be checked
    vgg = entries["vgg19"]
    assert len(bytes.fromhex(vgg["sha256"])) == 32
    assert vgg["url"].endswith(f"-{vgg['sha256'][:8]}.pth")  # torch.hub's convention
    # The published size: all 143 667 240 weights in float32, and a legacy pickle around them.
    assert 0 < vgg["bytes"] - 4 * 143_667_240 < 10_000
