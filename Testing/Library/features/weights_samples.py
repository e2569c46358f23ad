"""What the tests of weights share: samples and small helpers."""

from __future__ import annotations

import numpy as np
import torch
from safetensors.torch import save_file

from MedColorLib.features.architectures import Architecture

NARROW = {
    "vgg19": Architecture("vgg19", widths=(2, 3, 4, 5, 6), descriptor_width=8),
    "gray-vgg19": Architecture("gray-vgg19", widths=(2, 3, 4, 5, 6), descriptor_width=0, batch_norm=True),
}


# Where torchvision's vgg19 has its convolutions among ReLUs and poolings ("E" in its table of layouts).
TORCHVISION = (0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28, 30, 32, 34)


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
