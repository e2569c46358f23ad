"""Networks: half precision, provenance, what is refused, and the real VGG-19."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from networks_samples import picture, planes, reference, relative_error
from safetensors import safe_open
from safetensors.torch import save_file

from MedColorLib.errors import DeviceError, InputError, SettingsError, WeightsError
from MedColorLib.features import vgg19, weights
from MedColorLib.features.gray_vgg19 import GrayVGG19
from MedColorLib.features.vgg19 import VGG19

REAL = Path(__file__).resolve().parents[4] / "shared" / "weights" / "vgg19_oxford_uint8.safetensors"


needs_real = pytest.mark.skipif(not REAL.exists(), reason="the VGG-19 weights in ../shared/weights are not here")


def test_a_file_that_ends_before_fc6_gives_features_but_no_descriptor(narrow, tmp_path):
    tensors, _ = narrow()
    save_file({name: value for name, value in tensors.items() if "fc6" not in name}, tmp_path / "short.safetensors")
    network = VGG19(weights.load_weights(tmp_path / "short.safetensors"))
    assert network.extract(picture(16, 16), (5,))[5].shape == (2, 12, 1, 1)
    with pytest.raises(WeightsError, match=r"short\.safetensors: has no fc6"):
        network.descriptor(picture(16, 16))


def test_bfloat16_is_close_to_float32(narrow):
    _, loaded = narrow()
    luminance = picture(64, 64)
    exact = VGG19(loaded, dtype="float32").extract(luminance, range(1, 6))
    coarse = VGG19(loaded, dtype="bfloat16").extract(luminance, range(1, 6))
    assert torch.equal(exact[1], coarse[1])  # the first layer is always float32
    for layer in range(2, 6):
        assert coarse[layer].dtype == torch.float32
        assert torch.cosine_similarity(exact[layer].flatten(), coarse[layer].flatten(), 0) > 0.9995


def test_the_type_follows_the_hardware(narrow, monkeypatch):
    _, loaded = narrow()
    questions = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    for answer, dtype in ((True, "bfloat16"), (False, "float32")):
        for question in questions:
            monkeypatch.setattr(torch.cpu, question, lambda answer=answer: answer, raising=False)
        assert VGG19(loaded).provenance()["dtype"] == dtype
    for question in questions:
        monkeypatch.delattr(torch.cpu, question)
    assert VGG19(loaded).dtype == torch.float32


def test_provenance_is_plain_and_whole(narrow):
    _, loaded = narrow(preprocessing="torchvision")
    row = json.loads(json.dumps(VGG19(loaded, dtype="float32").provenance()))
    assert (row["name"], row["preprocessing"], row["device"], row["dtype"]) == (
        "vgg19",
        "torchvision",
        "cpu",
        "float32",
    )
    assert len(row["sha256"]) == 64


@pytest.mark.parametrize("layers", [(0,), (6,), (1, -1)])
def test_wrong_layers_are_refused(narrow, layers):
    network = VGG19(narrow()[1])
    with pytest.raises(SettingsError, match="1 to 5"):
        network.extract(picture(16, 16), layers)
    with pytest.raises(SettingsError, match="1 to 4"):
        network.layer_forward(5, torch.zeros(1, 12, 1, 1))


@pytest.mark.parametrize(
    "luminance",
    [
        torch.zeros(16, 16),
        torch.zeros(1, 3, 16, 16),
        torch.zeros(0, 1, 16, 16),
        torch.zeros(1, 1, 0, 16),
        torch.zeros(1, 1, 16, 16, dtype=torch.uint8),
        torch.full((1, 1, 16, 16), float("nan")),
        torch.full((1, 1, 16, 16), float("inf")),
    ],
)
def test_wrong_pictures_are_refused(narrow, luminance):
    network = VGG19(narrow()[1])
    with pytest.raises(InputError, match="luminance"):
        network.extract(luminance, (1,))
    with pytest.raises(InputError, match="luminance"):
        network.descriptor(luminance)


def test_wrong_devices_and_types_are_refused(narrow, monkeypatch):
    _, loaded = narrow()
    with pytest.raises(DeviceError, match="gpu7"):
        VGG19(loaded, device="gpu7")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceError, match="cuda"):
        VGG19(loaded, device="cuda")
    with pytest.raises(SettingsError, match="float16"):
        VGG19(loaded, dtype="float16")
    with pytest.raises(WeightsError, match="gray-vgg19 is needed"):
        GrayVGG19(loaded)


def test_a_full_device_is_told(narrow, monkeypatch):
    network = VGG19(narrow()[1])

    def full(*_, **__):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(vgg19.F, "conv2d", full)
    with pytest.raises(DeviceError, match="fewer slices"):
        network.extract(picture(16, 16), (1,))


# The real network.
def real_tensors():
    """Dequantised by the formula in the data's README, in float64, independent of MedColor's reader."""
    with safe_open(str(REAL), framework="np") as file:
        names = [name for name in file.keys() if name.startswith("conv") and not name.endswith((".scale", ".min"))]  # noqa: SIM118
        return {
            name: torch.from_numpy(
                file.get_tensor(f"{name}.min")
                + file.get_tensor(f"{name}.scale") * file.get_tensor(name).astype(np.float64)
            )
            for name in names
        }


def phantom(side=64):
    """A bright ellipse with darker organs on black, and some texture: 0..1."""
    y, x = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    image = (
        0.6 * (x**2 / 0.6 + y**2 / 0.9 < 1)
        - 0.3 * ((x - 0.3) ** 2 + y**2 < 0.06)
        + 0.3 * ((x + 0.3) ** 2 + y**2 < 0.04)
    )
    image = image + 0.05 * np.random.default_rng(0).standard_normal(image.shape) * (image > 0)
    return torch.from_numpy(image.clip(0, 1).astype(np.float32))[None, None]


@needs_real
def test_the_real_network_equals_the_plain_one():
    luminance = phantom()
    expected, _ = reference(real_tensors(), planes(luminance, "oxford"))
    loaded = weights.load_weights(REAL)
    assert (loaded.network, loaded.preprocessing) == ("vgg19", "oxford")
    exact = VGG19(loaded, dtype="float32").extract(luminance, range(1, 6))
    coarse = VGG19(loaded, dtype="bfloat16").extract(luminance, range(1, 6))
    for layer, values in expected.items():
        assert relative_error(exact[layer], values) < 1e-5
        per_pixel = torch.cosine_similarity(coarse[layer].double(), values, dim=1)
        assert per_pixel.min() > 0.999, layer


@needs_real
def test_the_real_descriptor_equals_rows_computed_by_hand():
    network = VGG19(weights.load_weights(REAL), dtype="float32")
    luminance = phantom(96)
    described = network.descriptor(luminance)
    assert described.shape == (1, 4096) and (described >= 0).all()
    pool5 = network._pool5(luminance).flatten().double().numpy()
    with safe_open(str(REAL), framework="np") as file:
        rows = file.get_tensor("fc6.weight")[::97]
        matrix = file.get_tensor("fc6.weight.min") + file.get_tensor("fc6.weight.scale") * rows.astype(np.float64)
        bias = file.get_tensor("fc6.bias.min") + file.get_tensor("fc6.bias.scale") * file.get_tensor("fc6.bias")[::97]
    expected = np.maximum(matrix @ pool5 + bias, 0)
    assert 0.1 < (expected > 0).mean() < 0.9
    np.testing.assert_allclose(described[0, ::97].numpy(), expected, rtol=1e-4, atol=1e-4 * expected.max())


@needs_real
def test_the_real_file_truncated_is_refused(tmp_path):
    path = tmp_path / "vgg19_oxford_uint8.safetensors"
    with REAL.open("rb") as file:
        head = file.read(8)
        path.write_bytes(head + file.read(struct.unpack("<Q", head)[0] + 100_000))
    with pytest.raises(WeightsError, match="the header announces 122797512 bytes"):
        weights.load_weights(path)
