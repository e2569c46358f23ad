"""Tensors of a `.caffemodel`: the part of Protocol Buffers' wire format that Caffe's NetParameter needs, no more.

The networks of the paper's references (Simonyan and Zisserman's VGG-19, He et al.'s luminance VGG-19) were released in
this format only, and neither Caffe nor a reader of its files is still packaged. Nothing is executed and nothing is
allocated before it is known to lie inside the file. Field numbers after caffe.proto: NetParameter.layers = 2 (V1),
.layer = 100; V1LayerParameter.name = 4, .blobs = 6; LayerParameter.name = 1, .type = 2, .blobs = 7; BlobProto.num,
channels, height, width = 1 to 4 (legacy shape), .data = 5, .shape = 7; BlobShape.dim = 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import WeightsError

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MAX_LAYERS = 4096  # VGG-19 with batch normalisation has about 60
_Span = tuple[int, int]  # first byte and end of a nested message


def _varint(data: np.ndarray, at: int, end: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= end:
            raise ValueError("a number runs past the end of its message")
        byte = int(data[at])
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("a number is longer than 64 bits")


def _fields(data: np.ndarray, span: _Span) -> Iterator[tuple[int, int, int | _Span]]:
    """Yield (field number, wire type, value) of one message; a nested message or string as its (start, end)."""
    at, end = span
    while at < end:
        key, at = _varint(data, at, end)
        wire = key & 7
        if wire == _VARINT:
            value, at = _varint(data, at, end)
            yield key >> 3, wire, value
            continue
        if wire == _BYTES:
            size, at = _varint(data, at, end)
        elif wire in (_FIXED64, _FIXED32):
            size = 8 if wire == _FIXED64 else 4
        else:
            raise ValueError(f"wire type {wire} at byte {at} is not one of Protocol Buffers'")
        if size > end - at:
            raise ValueError(f"a field of {size} bytes at byte {at} runs past the end of its message")
        yield key >> 3, wire, (at, at + size)
        at += size


def _text(data: np.ndarray, span: _Span) -> str:
    return data[span[0] : span[1]].tobytes().decode("utf-8")


def _blob(data: np.ndarray, span: _Span) -> np.ndarray:
    legacy = {}
    dims: list[int] | None = None
    values: np.ndarray | None = None
    for number, wire, value in _fields(data, span):
        if number in (1, 2, 3, 4) and wire == _VARINT:
            legacy[number] = value
        elif number == 5:
            if wire != _BYTES or values is not None or (value[1] - value[0]) % 4:
                raise ValueError("a blob is not one packed list of float32")
            values = data[value[0] : value[1]].view("<f4")
        elif number == 7 and wire == _BYTES:
            dims = [dim for field in _fields(data, value) for dim in _dims(data, field)]
    if values is None:
        raise ValueError("a blob has no float32 data")
    shape = dims if dims is not None else _without_padding([legacy.get(number, 1) for number in (1, 2, 3, 4)])
    if int(np.prod(shape, dtype=object)) != values.size:
        raise ValueError(f"a blob of shape {tuple(shape)} has {values.size} values")
    return values.reshape(shape)


def _without_padding(shape: list[int]) -> list[int]:
    """Drop the leading ones by which old files made everything four-dimensional, also a bias or a matrix."""
    while len(shape) > 1 and shape[0] == 1:
        shape = shape[1:]
    return shape


def _dims(data: np.ndarray, field: tuple[int, int, int | _Span]) -> list[int]:
    number, wire, value = field
    if number != 1:
        return []
    if wire == _VARINT:
        return [value]
    dims, (at, end) = [], value
    while at < end:
        dim, at = _varint(data, at, end)
        dims.append(dim)
    return dims


def _layer(data: np.ndarray, span: _Span, numbers: tuple[int, int | None, int]) -> tuple[str, str, list[np.ndarray]]:
    name, kind, blobs = "", "", []
    for number, wire, value in _fields(data, span):
        if wire == _BYTES and number == numbers[0]:
            name = _text(data, value)
        elif wire == _BYTES and number == numbers[1]:
            kind = _text(data, value)
        elif wire == _BYTES and number == numbers[2]:
            blobs.append(_blob(data, value))
    return name, kind, blobs


def _named(name: str, kind: str, blobs: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Tensors by the names MedColor uses: conv1_1.weight, conv1_1_bn.running_mean, data_bn.weight (from data/scale)."""
    if kind == "BatchNorm" and len(blobs) == 3:
        # Caffe stores sums and the number they are to be divided by; 0 means "never trained" and stands for zeros.
        total = float(blobs[2].reshape(-1)[0])
        factor = 0.0 if total == 0 else 1.0 / total
        prefix = name.replace("/", "_")
        return {f"{prefix}.running_mean": blobs[0] * factor, f"{prefix}.running_var": blobs[1] * factor}
    if kind == "Scale":
        name = name.replace("/scale", "_bn")
    return {f"{name}.{part}": blob for part, blob in zip(("weight", "bias"), blobs)}


def read_caffemodel(path: Path) -> dict[str, np.ndarray]:
    """Return the tensors of a Caffe network, mapped from the file (float32, read-only until copied).

    Batch normalisation comes as `LAYER_bn.running_mean` and `.running_var` (already divided by Caffe's moving-average
    factor), its `Scale` layer as `LAYER_bn.weight` and `.bias`; other layers as `LAYER.weight` and `.bias`.

    Raises:
        WeightsError: the file is not a whole Caffe network; the message says at which byte it stops making sense.
    """
    data = np.memmap(path, dtype=np.uint8, mode="r")
    tensors: dict[str, np.ndarray] = {}
    try:
        layers = 0
        for number, wire, value in _fields(data, (0, data.size)):
            if wire != _BYTES or number not in (2, 100):
                continue
            layers += 1
            if layers > _MAX_LAYERS:
                raise ValueError(f"more than {_MAX_LAYERS} layers")
            tensors.update(_named(*_layer(data, value, (4, None, 6) if number == 2 else (1, 2, 7))))
    except ValueError as error:  # UnicodeDecodeError is one
        raise WeightsError(
            f"{path.name}: not a whole Caffe network: {error}. Download the file again, or point MEDCOLOR_WEIGHTS "
            "elsewhere."
        ) from error
    return tensors
