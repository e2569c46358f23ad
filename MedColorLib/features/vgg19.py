"""VGG-19 features of a luminance picture: relu1_1 to relu5_1, and fc6 as a descriptor of the whole picture.

Simonyan and Zisserman 2014, configuration E; the layers are those of Deep Image Analogy (Liao et al. 2017) and of the
paper. Import this module only to use it: it needs torch.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as F

from ..device import choose_device, fast_dtype, is_out_of_memory
from ..errors import InputError, MemoryTooSmall, SettingsError, WeightsError
from ..progress import check
from .architectures import ARCHITECTURES, POOL5_SIDE
from .dense import DenseLayer
from .weights import NetworkWeights

_DESCRIPTOR_SIZE = 32 * POOL5_SIDE  # 224 x 224, the size fc6 was trained for
_CENTRE = 0.45  # grey level near both preprocessings' means: keeps the folded first layer free of cancellation
# Per plane of the first convolution, y = gain * luminance + offset, luminance in 0..1.
_PREPROCESSINGS = {
    "oxford": ((255.0,) * 3, (-103.939, -116.779, -123.68)),
    "torchvision": (
        tuple(1 / deviation for deviation in (0.229, 0.224, 0.225)),
        tuple(-mean / deviation for mean, deviation in zip((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))),
    ),
}


def fold_luminance(weight: torch.Tensor, gains: Sequence[float], offsets: Sequence[float]) -> torch.Tensor:
    """Fold three planes made of one luminance into the first convolution, exactly.

    With plane c = gains[c] * x + offsets[c] and zero padding *after* that, one plane cannot do it at the border: there
    the offsets are missing. Two planes can: x - 0.45, and 1 inside the picture; both are padded with zeros.

    Args:
        weight: (O, 3, 3, 3) kernel for the three planes.
        gains, offsets: three numbers each.

    Returns:
        (O, 2, 3, 3) float64 kernel for the two planes.
    """
    kernel = weight.to(torch.float64)
    gain = torch.as_tensor(gains, dtype=torch.float64).view(1, 3, 1, 1)
    offset = torch.as_tensor(offsets, dtype=torch.float64).view(1, 3, 1, 1)
    return torch.stack(((kernel * gain).sum(1), (kernel * (offset + gain * _CENTRE)).sum(1)), dim=1)


@contextlib.contextmanager
def _device_memory(device: torch.device, shape: Sequence[int]) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise MemoryTooSmall(
            f"{device}: out of memory for features of {tuple(shape)}; take fewer slices at once, or the cpu"
        ) from error


class VGG19:
    """Feature extractor `vgg19`.

    Attributes:
        name: "vgg19".
        strides: pixels of the picture per feature pixel, layers 1 to 5.
        position_weight, luminance_weight: 0, the features stand alone, as in the paper (see `Extractor`).
        device, dtype: where and in which type the convolutions run; relu1_1 is always computed in float32.
    """

    name = "vgg19"
    strides: tuple[int, ...] = (1, 2, 4, 8, 16)
    position_weight = 0.0
    luminance_weight = 0.0

    def __init__(
        self, weights: NetworkWeights, device: str | torch.device = "cpu", dtype: str | torch.dtype = "auto"
    ) -> None:
        """Read the convolutions up to conv5_1 (13 million weights: 26 MB in bfloat16, 52 MB in float32).

        Args:
            weights: as `load_weights` returns them.
            device: "cpu", "cuda", "cuda:1", "mps" or "auto".
            dtype: "float32", "bfloat16" or "auto" (see `fast_dtype`).

        Raises:
            WeightsError: of another network, or a tensor that is not finite.
            DeviceError: no such device.
            SettingsError: another dtype.
        """
        if weights.network != self.name:
            raise WeightsError(f"{weights.path.name}: holds {weights.network}, {self.name} is needed")
        self.device = torch.device(choose_device(str(device)))
        dtypes = {"auto": fast_dtype(self.device), "float32": torch.float32, "bfloat16": torch.bfloat16}
        key = str(dtype).replace("torch.", "")
        if key not in dtypes:
            raise SettingsError(f"dtype {dtype!r} is not one of {', '.join(dtypes)}")
        self.dtype = dtypes[key]
        self._weights = weights
        self._depths = ARCHITECTURES[self.name].depths
        self._cast: dict[tuple[str, torch.dtype], tuple[torch.Tensor, torch.Tensor]] = {}
        self._fc6: DenseLayer | None = None
        self._first = self._on_device(*self._folded_first(), torch.float32)
        for layer in range(1, len(self.strides)):
            check()
            for name in self._names_between(layer):
                self._kernel(name, self.dtype)

    def provenance(self) -> dict[str, str]:
        """Return what a report should say: network, source and hash of the weights, preprocessing, device and type."""
        return {
            "name": self.name,
            "weights": self._weights.source,
            "sha256": self._weights.sha256,
            "preprocessing": self._weights.preprocessing,
            "device": str(self.device),
            "dtype": str(self.dtype).replace("torch.", ""),
        }

    def extract(self, luminance: torch.Tensor, layers: Sequence[int]) -> dict[int, torch.Tensor]:
        """Compute relu{l}_1 for the layers asked for, and nothing deeper.

        Pooling rounds sizes up, as in Caffe, so any size from 1 x 1 works; for multiples of 16 it makes no difference.
        At its largest, memory beside the result is 2 x 64 x N x H x W numbers.

        Args:
            luminance: (N, 1, H, W) sRGB grey in 0..1, on any device.
            layers: some of 1..5.

        Returns:
            (N, C, h, w) float32 by layer, on the extractor's device, not normalised, 0 or more. C = 64, 128, 256, 512,
            512 and h = ceil(H / stride). The memory order is channels-last.

        Raises:
            SettingsError: a layer outside 1..5.
            InputError: another shape, or values that are not finite.
            DeviceError: the device's memory is too small.
        """
        wanted = sorted(set(layers))
        if any(layer not in range(1, len(self.strides) + 1) for layer in wanted):
            raise SettingsError(f"layers {list(layers)}: expected some of 1 to {len(self.strides)}")
        _check_luminance(luminance)
        if self.device.type == "cpu" and len(luminance) > 1:  # what one picture needs stays in the cache: 64 ms, not 73
            alone = [self.extract(picture[None], wanted) for picture in luminance]
            return {layer: torch.cat([found[layer] for found in alone]) for layer in wanted}
        found: dict[int, torch.Tensor] = {}
        # no_grad, not inference_mode: the results may take part in the gradient of a feature deconvolution.
        with torch.no_grad(), _device_memory(self.device, luminance.shape):
            x = self._relu1_1(luminance) if wanted else luminance
            for layer in range(1, max(wanted, default=0) + 1):
                check()
                if layer > 1:
                    x = self._advance(layer - 1, x)
                if layer in wanted:
                    found[layer] = x.to(torch.float32)
                x = x.to(self.dtype)
        return found

    def layer_forward(self, layer: int, x: torch.Tensor) -> torch.Tensor:
        """Map relu{layer}_1 to relu{layer + 1}_1, differentiably, in the type of `x`.

        Args:
            layer: 1 to 4.
            x: (N, C, h, w) activations of that layer, floating point, on the extractor's device, in any memory order
                (torch's L-BFGS wants its unknown contiguous).

        Returns:
            (N, C', ceil(h / 2), ceil(w / 2)) activations of the next layer.
        """
        if layer not in range(1, len(self.strides)):
            raise SettingsError(f"layer {layer}: expected 1 to {len(self.strides) - 1}")
        with _device_memory(self.device, x.shape):
            return self._advance(layer, x)

    def descriptor(self, luminance: torch.Tensor) -> torch.Tensor:
        """Describe whole pictures by fc6, for retrieval by cosine similarity.

        After the ReLU: that is what Caffe's blob `fc6` holds, the layer's activation being computed in place.
        fc6 is read at the first call and kept, see `DenseLayer`.

        Args:
            luminance: (N, 1, H, W) sRGB grey in 0..1; resized to 224 x 224, bilinear with antialiasing.

        Returns:
            (N, 4096) float32, 0 or more.

        Raises:
            WeightsError: the file of weights ends before fc6.
            InputError, DeviceError: as for `extract`.
        """
        pooled = self._pool5(luminance).flatten(1)
        with torch.no_grad(), _device_memory(self.device, luminance.shape):
            if self._fc6 is None:
                self._fc6 = DenseLayer(self._weights, "fc6", self.device)
            return F.relu(self._fc6(pooled))

    def _pool5(self, luminance: torch.Tensor) -> torch.Tensor:
        _check_luminance(luminance)
        resized = F.interpolate(
            luminance.to(self.device, torch.float32), size=(_DESCRIPTOR_SIZE,) * 2, mode="bilinear", antialias=True
        )
        x = self.extract(resized, (5,))[5].to(self.dtype)
        with torch.no_grad(), _device_memory(self.device, luminance.shape):
            for index in range(2, self._depths[-1] + 1):
                x = self._convolve(f"conv5_{index}", x)
            return F.max_pool2d(x, 2, 2).to(torch.float32)

    def _planes(self, luminance: torch.Tensor) -> torch.Tensor:
        """Return what the network calls luminance, in 0..1."""
        return luminance

    def _preprocessing(self) -> tuple[Sequence[float], Sequence[float]]:
        return _PREPROCESSINGS[self._weights.preprocessing]

    def _parameters(self, name: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Return kernel (O, I, 3, 3) and bias (O,) of a convolution, float64 or float32."""
        return self._weights.tensor(f"{name}.weight"), self._weights.tensor(f"{name}.bias")

    def _folded_first(self) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = self._parameters("conv1_1")
        return fold_luminance(weight, *self._preprocessing()), bias

    def _relu1_1(self, luminance: torch.Tensor) -> torch.Tensor:
        x = self._planes(luminance.to(self.device, torch.float32))
        planes = torch.cat((x - _CENTRE, torch.ones_like(x)), dim=1).contiguous(memory_format=torch.channels_last)
        return F.relu_(F.conv2d(planes, *self._first, padding=1))

    def _names_between(self, layer: int) -> list[str]:
        inner = [f"conv{layer}_{index}" for index in range(2, self._depths[layer - 1] + 1)]
        return [*inner, f"conv{layer + 1}_1"]

    def _advance(self, layer: int, x: torch.Tensor) -> torch.Tensor:
        *inner, last = self._names_between(layer)
        for name in inner:
            x = self._convolve(name, x)
        return self._convolve(last, F.max_pool2d(x, 2, 2, ceil_mode=True))

    def _convolve(self, name: str, x: torch.Tensor) -> torch.Tensor:
        return F.relu_(F.conv2d(x, *self._kernel(name, x.dtype), padding=1))

    def _kernel(self, name: str, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
        if (name, dtype) not in self._cast:
            self._cast[name, dtype] = self._on_device(*self._parameters(name), dtype)
        return self._cast[name, dtype]

    def _on_device(
        self, weight: torch.Tensor, bias: torch.Tensor, dtype: torch.dtype
    ) -> tuple[torch.Tensor, torch.Tensor]:
        weight = weight.to(self.device, dtype).contiguous(memory_format=torch.channels_last)
        return weight, bias.to(self.device, dtype)


def _check_luminance(luminance: torch.Tensor) -> None:
    if luminance.ndim != 4 or luminance.shape[1] != 1 or 0 in luminance.shape or not luminance.is_floating_point():
        raise InputError(
            f"luminance: expected a floating-point (N, 1, H, W) with values in 0..1, got {luminance.dtype} "
            f"{tuple(luminance.shape)}"
        )
    extremes = torch.stack(torch.aminmax(luminance)).tolist()
    if not all(math.isfinite(value) for value in extremes):
        raise InputError("luminance: NaN or infinite values; fill them before computing features")
