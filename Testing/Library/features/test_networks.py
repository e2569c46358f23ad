"""VGG-19 and the gray VGG-19 against plain torch.nn networks in float64 that are built here, layer by layer."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from networks_samples import picture, planes, reference, relative_error
from torch import nn

from MedColorLib.features.gray_vgg19 import GrayVGG19, lightness
from MedColorLib.features.vgg19 import VGG19, fold_luminance

SIZES = [(16, 16), (48, 32), (33, 47), (7, 1), (1, 1)]


def cielab_lightness(grey):
    """L* of sRGB grey in float64, by the formulas of CIE 15 and IEC 61966-2-1."""
    linear = np.where(grey > 0.04045, ((grey + 0.055) / 1.055) ** 2.4, grey / 12.92)
    f = np.where(linear > (6 / 29) ** 3, np.cbrt(linear), linear / (3 * (6 / 29) ** 2) + 4 / 29)
    return 116 * f - 16


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
