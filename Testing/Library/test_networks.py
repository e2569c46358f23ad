"""VGG-19 and the gray VGG-19 against plain torch.nn networks in float64 that are built here, layer by layer."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from MedColorLib.errors import DeviceError, InputError, SettingsError, WeightsError
from MedColorLib.features import vgg19, weights
from MedColorLib.features.architectures import ARCHITECTURES, Architecture
from MedColorLib.features.gray_vgg19 import GrayVGG19, lightness
from MedColorLib.features.vgg19 import VGG19, fold_luminance

REAL = Path(__file__).resolve().parents[3] / "shared" / "weights" / "vgg19_oxford_uint8.safetensors"
needs_real = pytest.mark.skipif(not REAL.exists(), reason="the VGG-19 weights in ../shared/weights are not here")
DEPTHS = (2, 2, 4, 4, 4)
NARROW = {
    "vgg19": Architecture("vgg19", widths=(4, 6, 8, 10, 12), descriptor_width=600),
    "gray-vgg19": Architecture("gray-vgg19", widths=(4, 6, 8, 10, 12), descriptor_width=0, batch_norm=True),
}
SIZES = [(16, 16), (48, 32), (33, 47), (7, 1), (1, 1)]


@pytest.fixture
def narrow(monkeypatch, tmp_path):
    """A function that makes the weights of a narrow network: tensors in float32, and the file opened by MedColor."""
    for name, architecture in NARROW.items():
        monkeypatch.setitem(ARCHITECTURES, name, architecture)
    monkeypatch.setattr(weights, "cache_folder", lambda: tmp_path / "cache")

    def make(network="vgg19", preprocessing="oxford", seed=0):
        generator = torch.Generator().manual_seed(seed)
        architecture = NARROW[network]
        tensors = {}
        for name, shape in {**architecture.required(), **architecture.optional()}.items():
            values = torch.randn(shape, generator=generator)
            if len(shape) > 1:
                values *= (2 / np.prod(shape[1:])) ** 0.5  # activations keep their size through the layers
            tensors[name] = values.abs() + 0.3 if name.endswith("_var") else values
        save_file(tensors, tmp_path / "narrow.safetensors", {"medcolor_preprocessing": preprocessing})
        return tensors, weights.load_weights(tmp_path / "narrow.safetensors")

    return make


def reference(tensors, picture, batch_norm=False):
    """Run the plain float64 network on (N, 3, H, W) planes; return its relu{l}_1 by layer, and pool5."""
    found, x = {}, picture.double()
    with torch.no_grad():
        if batch_norm:
            x = normalisation(tensors, "data_bn")(x)
        for block, depth in enumerate(DEPTHS, start=1):
            for index in range(1, depth + 1):
                name = f"conv{block}_{index}"
                outputs, inputs = tensors[f"{name}.weight"].shape[:2]
                convolution = nn.Conv2d(inputs, outputs, 3, padding=1).double()
                convolution.weight.copy_(tensors[f"{name}.weight"])
                convolution.bias.copy_(tensors[f"{name}.bias"])
                x = convolution(x)
                if batch_norm:
                    x = normalisation(tensors, f"{name}_bn")(x)
                x = nn.ReLU()(x)
                if index == 1:
                    found[block] = x
            x = nn.MaxPool2d(2, ceil_mode=True)(x)
    return found, x


def normalisation(tensors, name):
    layer = nn.BatchNorm2d(len(tensors[f"{name}.weight"])).double().eval()
    for part in ("weight", "bias", "running_mean", "running_var"):
        getattr(layer, part).data.copy_(tensors[f"{name}.{part}"])
    return layer


def planes(luminance, preprocessing):
    picture = luminance.double().repeat(1, 3, 1, 1)
    if preprocessing == "oxford":  # B, G, R
        return picture * 255 - torch.tensor([103.939, 116.779, 123.68]).double().view(1, 3, 1, 1)
    mean, deviation = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]]).double().view(2, 1, 3, 1, 1)
    return (picture - mean) / deviation


def picture(*size, seed=1, batch=2):
    return torch.rand(batch, 1, *size, generator=torch.Generator().manual_seed(seed))


def cielab_lightness(grey):
    """L* of sRGB grey in float64, by the formulas of CIE 15 and IEC 61966-2-1."""
    linear = np.where(grey > 0.04045, ((grey + 0.055) / 1.055) ** 2.4, grey / 12.92)
    f = np.where(linear > (6 / 29) ** 3, np.cbrt(linear), linear / (3 * (6 / 29) ** 2) + 4 / 29)
    return 116 * f - 16


def relative_error(found, expected):
    return ((found.double() - expected).abs().max() / expected.abs().max().clamp(min=1e-30)).item()


@given(
    st.lists(st.floats(-300, 300), min_size=3, max_size=3),
    st.lists(st.floats(-300, 300), min_size=3, max_size=3),
    st.integers(1, 5),
    st.integers(0, 2**31),
)
@settings(max_examples=50, deadline=None)
def test_two_planes_equal_three_also_at_the_border(gains, offsets, side, seed):
    generator = torch.Generator().manual_seed(seed)
    kernel = torch.randn(4, 3, 3, 3, generator=generator, dtype=torch.float64)
    x = torch.rand(1, 1, side, side, generator=generator, dtype=torch.float64)
    three = torch.cat([gain * x + offset for gain, offset in zip(gains, offsets)], dim=1)
    two = torch.cat((x - 0.45, torch.ones_like(x)), dim=1)
    expected = nn.functional.conv2d(three, kernel, padding=1)
    found = nn.functional.conv2d(two, fold_luminance(kernel, gains, offsets), padding=1)
    torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-10)


@pytest.mark.parametrize("preprocessing", ["oxford", "torchvision"])
@pytest.mark.parametrize("size", SIZES)
def test_activations_equal_the_plain_network(narrow, preprocessing, size):
    tensors, loaded = narrow(preprocessing=preprocessing)
    luminance = picture(*size)
    expected, _ = reference(tensors, planes(luminance, preprocessing))
    found = VGG19(loaded, dtype="float32").extract(luminance, range(1, 6))
    for layer, values in expected.items():
        assert found[layer].shape == values.shape and found[layer].dtype == torch.float32
        assert found[layer].shape[2:] == tuple(-(-extent // VGG19.strides[layer - 1]) for extent in size)
        assert relative_error(found[layer], values) < 2e-6


@pytest.mark.parametrize("size", SIZES)
def test_gray_activations_equal_the_network_before_folding(narrow, size):
    tensors, loaded = narrow("gray-vgg19", "gray")
    luminance = picture(*size)
    lightness_255 = 2.55 * cielab_lightness(luminance.double().numpy())  # He et al.: OpenCV's L, three times
    lightness_255 = torch.from_numpy(lightness_255)
    expected, _ = reference(tensors, lightness_255.repeat(1, 3, 1, 1), batch_norm=True)
    for layer, values in GrayVGG19(loaded, dtype="float32").extract(luminance, range(1, 6)).items():
        assert relative_error(values, expected[layer]) < 1e-5


def test_the_gray_descriptor_is_pool5(narrow):
    tensors, loaded = narrow("gray-vgg19", "gray")
    luminance = picture(224, 224)
    planes_255 = torch.from_numpy(2.55 * cielab_lightness(luminance.double().numpy())).repeat(1, 3, 1, 1)
    _, pool5 = reference(tensors, planes_255, batch_norm=True)
    found = GrayVGG19(loaded, dtype="float32").descriptor(luminance)
    assert found.shape == (2, 12 * 49)
    assert relative_error(found, pool5.flatten(1)) < 1e-5


def test_lightness_equals_cielab():
    grey = np.linspace(0, 1, 4001)
    expected = cielab_lightness(grey)
    np.testing.assert_allclose(lightness(torch.from_numpy(grey)).numpy() * 100, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(lightness(torch.from_numpy(grey).float()).numpy() * 100, expected, atol=1e-4)
    # What He et al. fed the network is OpenCV's 8-bit L: ours lies within its rounding and its table's step.
    bytes_in = np.arange(256, dtype=np.uint8).reshape(-1, 1, 1).repeat(3, axis=2)
    bytes_out = cv2.cvtColor(bytes_in, cv2.COLOR_BGR2Lab)[:, 0, 0]
    np.testing.assert_allclose(lightness(torch.arange(256) / 255).numpy() * 255, bytes_out, atol=1)


def test_pictures_of_a_batch_are_as_by_themselves(narrow):
    _, loaded = narrow()
    network, pictures = VGG19(loaded), torch.cat([picture(16, 32), picture(16, 32).flip(-1)])
    together = network.extract(pictures, (3, 1))
    for n, one in enumerate(pictures):
        alone = network.extract(one[None], (3, 1))
        assert all(torch.equal(together[layer][n], alone[layer][0]) for layer in (3, 1))


def test_only_what_is_asked_for_is_computed(narrow, monkeypatch):
    _, loaded = narrow()
    network = VGG19(loaded)
    computed = []
    plain = VGG19._convolve
    monkeypatch.setattr(VGG19, "_convolve", lambda self, name, x: computed.append(name) or plain(self, name, x))
    assert list(network.extract(picture(16, 16)[:1], [3, 2, 3])) == [2, 3]
    assert computed == ["conv1_2", "conv2_1", "conv2_2", "conv3_1"]
    computed.clear()
    assert list(network.extract(picture(16, 16)[:1], (1,))) == [1]
    assert computed == []
    assert network.extract(picture(16, 16)[:1], ()) == {}


def test_batches_equal_single_pictures_and_runs_repeat(narrow):
    _, loaded = narrow()
    network, luminance = VGG19(loaded, dtype="float32"), picture(32, 48, batch=3)
    kept = luminance.clone()
    together = network.extract(luminance, (1, 5))
    for layer in (1, 5):
        single = torch.cat([network.extract(one[None], (layer,))[layer] for one in luminance])
        torch.testing.assert_close(together[layer], single, rtol=1e-5, atol=1e-4)
        torch.testing.assert_close(network.extract(luminance, (1, 5))[layer], together[layer], rtol=0, atol=0)
    assert torch.equal(luminance, kept)


@pytest.mark.parametrize("size", [(32, 32), (33, 18)])
def test_layer_forward_continues_the_extraction(narrow, size):
    tensors, loaded = narrow()
    luminance = picture(*size)
    expected, _ = reference(tensors, planes(luminance, "oxford"))
    network = VGG19(loaded)
    for layer in range(1, 5):
        for dtype, limit in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
            found = network.layer_forward(layer, expected[layer].to(dtype))
            assert found.dtype == dtype
            assert relative_error(found, expected[layer + 1]) < limit


def test_layer_forward_has_the_right_gradient(narrow):
    _, loaded = narrow()
    network = VGG19(loaded)
    start = torch.rand(1, 4, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3), requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: network.layer_forward(1, x), (start,))


def test_extracted_features_can_be_deconvolved(narrow):
    """What the analogy does with them: start and target of an optimisation by gradient."""
    _, loaded = narrow()
    network = VGG19(loaded)
    features = network.extract(picture(16, 16, batch=1), (2, 3))
    unknown = features[2].mul(0.5).contiguous().requires_grad_()  # torch's L-BFGS wants this memory order
    optimiser = torch.optim.LBFGS([unknown], max_iter=30, line_search_fn="strong_wolfe")

    def loss():
        optimiser.zero_grad()
        value = (network.layer_forward(2, unknown) - features[3]).square().sum()
        value.backward()
        return value

    before = loss().item()
    optimiser.step(loss)
    assert loss().item() < 1e-3 * before


def test_descriptor_by_blocks_equals_the_whole_product(narrow):
    tensors, loaded = narrow()
    luminance = picture(64, 80)
    resized = nn.functional.interpolate(luminance, (224, 224), mode="bilinear", antialias=True)
    _, pool5 = reference(tensors, planes(resized, "oxford"))
    expected = (pool5.flatten(1) @ tensors["fc6.weight"].double().T + tensors["fc6.bias"]).relu()
    found = VGG19(loaded, dtype="float32").descriptor(luminance)  # 600 rows: two blocks of 256 and a rest
    assert found.shape == (2, 600)
    assert relative_error(found, expected) < 2e-6


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
