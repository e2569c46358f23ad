"""Weights: every kind of file is read as what it holds, anything else is refused, downloads survive what networks do.

All files are made here, for a narrow VGG-19 of a few hundred kilobytes; the server is on the loopback interface.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import http.server
import io
import json
import os
import pickle
import random
import struct
import threading
import zipfile

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from MedColorLib.errors import Cancelled, SettingsError, WeightsError
from MedColorLib.features import checkpoints, download, network_weights, weights
from MedColorLib.features.architectures import ARCHITECTURES, Architecture

NARROW = {
    "vgg19": Architecture("vgg19", widths=(2, 3, 4, 5, 6), descriptor_width=8),
    "gray-vgg19": Architecture("gray-vgg19", widths=(2, 3, 4, 5, 6), descriptor_width=0, batch_norm=True),
}
# Where torchvision's vgg19 has its convolutions among ReLUs and poolings ("E" in its table of layouts).
TORCHVISION = (0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28, 30, 32, 34)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Narrow networks, an empty cache folder, and no setting of the developer's own."""
    for name, architecture in NARROW.items():
        monkeypatch.setitem(ARCHITECTURES, name, architecture)
    monkeypatch.delenv("MEDCOLOR_WEIGHTS", raising=False)
    monkeypatch.setenv("NO_PROXY", "*")
    monkeypatch.setattr(weights, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def random_tensors(network="vgg19", seed=0):
    generator = torch.Generator().manual_seed(seed)
    architecture = NARROW[network]
    shapes = {**architecture.required(), **architecture.optional()}
    tensors = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    return {name: value.abs() + 0.5 if name.endswith("_var") else value for name, value in tensors.items()}


def torchvision_named(tensors):
    names = {}
    for name, value in tensors.items():
        layer, part = name.split(".")
        if layer == "fc6":
            names[f"classifier.0.{part}"] = value
        else:
            names[f"features.{TORCHVISION[list(NARROW['vgg19'].convolutions()).index(layer)]}.{part}"] = value
    return names


# Writers, one for each kind of file. A minimal Protocol Buffers encoder stands in for Caffe.
def varint(number):
    out = b""
    while number > 0x7F:
        out, number = out + bytes([number & 0x7F | 0x80]), number >> 7
    return out + bytes([number])


def message(number, content):
    return varint(number << 3 | 2) + varint(len(content)) + content


def blob(array, legacy):
    array = np.asarray(array, dtype="<f4")
    if legacy:
        shape = (1,) * (4 - array.ndim) + array.shape
        header = b"".join(varint(number << 3) + varint(extent) for number, extent in zip((1, 2, 3, 4), shape))
    else:
        header = message(7, message(1, b"".join(varint(extent) for extent in array.shape)))
    return header + message(5, array.tobytes())


def write_caffe_v1(path, tensors):
    layers = b""
    for layer in dict.fromkeys(name.split(".")[0] for name in tensors):
        blobs = b"".join(message(6, blob(tensors[f"{layer}.{part}"], legacy=True)) for part in ("weight", "bias"))
        layers += message(2, message(2, b"below") + message(4, layer.encode()) + varint(5 << 3) + varint(4) + blobs)
    path.write_bytes(message(1, b"VGG_ILSVRC_19_layers") + layers)


def caffe_layer(name, kind, arrays):
    blobs = b"".join(message(7, blob(array, legacy=False)) for array in arrays)
    return message(100, message(1, name.encode()) + message(2, kind.encode()) + blobs)


def write_caffe_gray(path, tensors, factor=0.25):
    """As He et al. released it: only the input has a Scale layer; statistics are sums, times a factor."""

    def normalisation(name):
        mean, variance = (tensors[f"{name}.running_{part}"].numpy() * factor for part in ("mean", "var"))
        return caffe_layer(name.replace("_bn", "/bn"), "BatchNorm", (mean, variance, [factor]))

    content = message(1, b"CaffeNet") + caffe_layer("data", "Input", ()) + normalisation("data_bn")
    content += caffe_layer("data/scale", "Scale", (tensors["data_bn.weight"], tensors["data_bn.bias"]))
    for layer in NARROW["gray-vgg19"].convolutions():
        content += caffe_layer(layer, "Convolution", (tensors[f"{layer}.weight"], tensors[f"{layer}.bias"]))
        content += normalisation(f"{layer}_bn")
    path.write_bytes(content)


def write_quantised(path, tensors):
    stored = {}
    for name, value in tensors.items():
        low, high = value.min().double(), value.max().double()
        scale = (high - low) / 255
        stored[name] = ((value.double() - low) / scale).round().to(torch.uint8)
        stored[f"{name}.scale"], stored[f"{name}.min"] = scale.view(1), low.view(1)
    save_file(stored, path)


def write_npz_short(path, tensors):
    short = {".weight": "_w", ".bias": "_b"}
    np.savez(
        path,
        **{name.replace(part, short[part]): v.numpy() for name, v in tensors.items() for part in short if part in name},
    )


def write_legacy(path, tensors):
    torch.save(torchvision_named(tensors), path, _use_new_zipfile_serialization=False)


WRITERS = {
    "safetensors": (lambda path, tensors: save_file(tensors, path), "oxford", "vgg19"),
    "safetensors-torchvision": (lambda path, t: save_file(torchvision_named(t), path), "torchvision", "vgg19"),
    "quantised": (write_quantised, "oxford", "vgg19"),
    "pth": (lambda path, tensors: torch.save(torchvision_named(tensors), path), "torchvision", "vgg19"),
    "pth-legacy": (write_legacy, "torchvision", "vgg19"),
    "pth-caffe-names": (lambda path, tensors: torch.save(tensors, path), "oxford", "vgg19"),
    "npz-short-names": (write_npz_short, "oxford", "vgg19"),
    "npz": (lambda path, t: np.savez_compressed(path, **{n: v.numpy() for n, v in t.items()}), "oxford", "vgg19"),
    "caffemodel": (write_caffe_v1, "oxford", "vgg19"),
    "gray-pth": (lambda path, tensors: torch.save(tensors, path), "gray", "gray-vgg19"),
    "gray-caffemodel": (write_caffe_gray, "gray", "gray-vgg19"),
}


def written(kind, folder, seed=0):
    writer, preprocessing, network = WRITERS[kind]
    tensors = random_tensors(network, seed)
    path = folder / ("weights.npz" if "npz" in kind else f"{kind}.weights")  # the ending says nothing otherwise
    writer(path, tensors)
    return path, tensors, preprocessing, network


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
    with caplog.at_level("WARNING", "MedColor"):
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


# Downloads.
class Server(http.server.BaseHTTPRequestHandler):
    """One file, with the faults that a test asks for."""

    content = b""
    ranges = True
    cuts: list = []  # noqa: RUF012 - bytes after which each connection breaks, first to last
    status = None
    announced = None
    requests: list = []  # noqa: RUF012

    def do_GET(self):
        start = 0
        asked = self.headers.get("Range")
        type(self).requests.append(asked)
        if self.status:
            self.send_error(self.status)
            return
        if asked and self.ranges:
            start = int(asked[len("bytes=") : -1])
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(self.content) - 1}/{len(self.content)}")
        else:
            self.send_response(200)
        body = self.content[start:]
        self.send_header("Content-Length", str(self.announced or len(body)))
        self.end_headers()
        cut = self.cuts.pop(0) if self.cuts else None
        with contextlib.suppress(ConnectionError):
            self.wfile.write(body[:cut])

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch, tmp_path):
    """A server of the narrow network as a legacy .pth, announced in the manifest."""
    path, tensors, *_ = written("pth-legacy", tmp_path)
    handler = type("Handler", (Server,), {"content": path.read_bytes(), "cuts": [], "requests": []})
    entry = {**weights.manifest()["vgg19"], "file": "narrow.pth", "bytes": len(handler.content)}
    entry["sha256"] = hashlib.sha256(handler.content).hexdigest()
    handler.tensors = tensors
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        entry["url"] = f"http://127.0.0.1:{running.server_port}/narrow.pth"
        monkeypatch.setattr(
            weights, "manifest", lambda: {"vgg19": entry, "gray-vgg19": {**entry, "url": None, "sha256": None}}
        )
        monkeypatch.setattr(download, "_CHUNK_BYTES", 1000)
        yield handler
        running.shutdown()
        thread.join()


def part_of(cache):
    return cache / "narrow.pth.part"


def only_files(cache):
    return sorted(file.name for file in cache.rglob("*") if file.is_file())


def test_fetched_weights_are_found_and_right(server, cache):
    seen = []
    path = weights.fetch_weights(progress=lambda present, size: seen.append((present, size)))
    assert seen[-1] == (len(server.content),) * 2
    assert [present for present, _ in seen] == sorted(present for present, _ in seen)
    assert only_files(cache) == [path.name]  # neither the download nor its .part stays
    found = weights.find_weights()
    assert (found.path, found.preprocessing) == (path, "torchvision")
    torch.testing.assert_close(weights.load_weights(path).tensor("conv5_4.weight"), server.tensors["conv5_4.weight"])
    assert weights.fetch_weights() == path and len(server.requests) == 1  # nothing to do the second time
    path.write_bytes(path.read_bytes()[:-5])
    weights.load_weights(weights.fetch_weights())  # fetching cures a spoilt file
    assert len(server.requests) == 2


@pytest.mark.parametrize("ranges", [True, False])
def test_broken_connections_are_taken_up_again(server, cache, ranges):
    server.ranges, server.cuts = ranges, [5000, 7000]
    weights.fetch_weights()
    assert server.requests == [None, "bytes=5000-", f"bytes={12000 if ranges else 7000}-"]


def test_a_dead_connection_ends_in_a_message_and_a_later_call_goes_on(server, cache):
    server.cuts = [5000, 0, 0, 0]
    with pytest.raises(WeightsError, match=r"after 5000 of \d+ bytes"):
        weights.fetch_weights()
    assert only_files(cache) == ["narrow.pth.part"] and part_of(cache).stat().st_size == 5000
    assert weights.find_weights() is None
    weights.fetch_weights()
    assert server.requests[-1] == "bytes=5000-"


def test_cancelling_keeps_what_came(server, cache):
    calls = []
    with pytest.raises(Cancelled):
        weights.fetch_weights(cancelled=lambda: calls.append(1) or len(calls) > 4)
    assert 0 < part_of(cache).stat().st_size < len(server.content)
    assert only_files(cache) == ["narrow.pth.part"]
    weights.fetch_weights()
    assert only_files(cache)[0].startswith("vgg19-")


def test_another_file_of_the_same_size_is_deleted(server, cache):
    server.content = bytes(len(server.content))
    with pytest.raises(WeightsError, match="not the expected file"):
        weights.fetch_weights()
    assert only_files(cache) == []


def test_a_spoilt_part_is_deleted_and_the_next_call_starts_anew(server, cache):
    cache.mkdir()
    part_of(cache).write_bytes(b"?" * 3000)
    with pytest.raises(WeightsError, match="was deleted"):
        weights.fetch_weights()
    weights.fetch_weights()
    assert server.requests == ["bytes=3000-", None]
    part_of(cache).write_bytes(b"?" * (len(server.content) + 1))
    (cache / weights.find_weights().path.name).unlink()
    with pytest.raises(WeightsError, match="was deleted"):
        weights.fetch_weights()
    assert only_files(cache) == []


def test_another_size_is_refused_before_the_download(server, cache):
    server.content += b"more"
    with pytest.raises(WeightsError, match="instead of"):
        weights.fetch_weights()
    assert only_files(cache) == []


@pytest.mark.parametrize("status", [404, 403, 500, 503])
def test_server_errors_are_told(server, cache, status):
    server.status = status
    with pytest.raises(WeightsError, match=str(status)):
        weights.fetch_weights()
    assert only_files(cache) == []


def test_offline_is_told(server, cache):
    import socket

    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # bound, not listening: refused at once
        port = unused.getsockname()[1]
        with pytest.raises(WeightsError, match=r"no connection.*copy the file from another machine"):
            weights.fetch_weights(url=f"http://127.0.0.1:{port}/x.pth")


def test_other_kinds_of_url_are_refused(server, tmp_path):
    (tmp_path / "x").write_bytes(server.content)
    with pytest.raises(SettingsError, match="only http and https"):
        weights.fetch_weights(url=(tmp_path / "x").as_uri())


def test_a_full_disk_is_told_before_and_during(server, cache, monkeypatch):
    usage = type("Usage", (), {"free": 10})
    with monkeypatch.context() as patch:
        patch.setattr(download.shutil, "disk_usage", lambda _: usage)
        with pytest.raises(WeightsError, match="make room"):
            weights.fetch_weights()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(download, "_copy", full)
        with pytest.raises(WeightsError, match="No space left"):
            weights.fetch_weights()
    assert weights.find_weights() is None


def test_a_verified_download_survives_a_failed_conversion(server, cache, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(network_weights, "_save", lambda *_: (_ for _ in ()).throw(WeightsError("no room")))
        with pytest.raises(WeightsError, match="no room"):
            weights.fetch_weights()
    assert only_files(cache) == ["narrow.pth"]
    weights.fetch_weights()
    assert len(server.requests) == 1


def test_what_has_no_checksum_is_not_fetched(server):
    with pytest.raises(WeightsError, match="gray-vgg19"):
        weights.fetch_weights("gray-vgg19")
    with pytest.raises(SettingsError):
        weights.fetch_weights("alexnet")
