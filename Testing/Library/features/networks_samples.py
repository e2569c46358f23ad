"""What the tests of networks share: samples and small helpers."""

from __future__ import annotations

import torch
from torch import nn

from MedColorLib.features.architectures import Architecture

DEPTHS = (2, 2, 4, 4, 4)


NARROW = {
    "vgg19": Architecture("vgg19", widths=(4, 6, 8, 10, 12), descriptor_width=600),
    "gray-vgg19": Architecture("gray-vgg19", widths=(4, 6, 8, 10, 12), descriptor_width=0, batch_norm=True),
}


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


def relative_error(found, expected):
    return ((found.double() - expected).abs().max() / expected.abs().max().clamp(min=1e-30)).item()
