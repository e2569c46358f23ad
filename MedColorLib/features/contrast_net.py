"""Own features: a small network that sees anatomy, not contrast. Nothing to download; the weights lie beside this file.

It was trained by the project on pictures made by formula, each seen through two random contrasts, so that one place has the
same features in a CT, in an MR of any weighting and in a photograph (`Testing/Training`). No real picture took part.
The idea at scale: anatomix (Dey et al., ICLR 2025), SynthMorph (Hoffmann et al. 2022), DISA (Ronchetti et al. 2023).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..device import side_by_side
from ..errors import InputError, SettingsError, WeightsError
from . import OWN_CONTEXT, OWN_WEIGHTS, own_weights_sha256

CHANNELS = 32
STRIDE = 4  # pixels of the luminance per position of the features
MULTIPLE = 16  # height and width must be multiples of it: the coarsest level lies at a sixteenth

WEIGHTS = OWN_WEIGHTS

_NEAR_PX, _FAR_CELLS = 9, 9  # sides of the squares whose mean and deviation standardise a pixel: 9 pixels, 9 cells of 4
_PLANES = 3
_FLOOR = 0.08  # of the picture's deviation, added to a square's: noise in a flat region stays small


class Contrast:
    """The network as an extractor; see `features.Extractor`. Layer 3 is its own raster, 4 and 5 are means of it."""

    name = "embedded"

    def __init__(self, device: str = "cpu", context: float = OWN_CONTEXT) -> None:
        """Args:
            context: share 0..1 of what the coarsest level says: where in the body a position lies. At 1 matches keep their
                place; at 0 they follow tissue alone, and are less consistent.

        Raises:
            WeightsError: the weights are missing or not what this version expects.
        """
        self.device, self.context = torch.device(device), context
        self._network = _loaded(str(self.device))

    def provenance(self) -> dict:
        """Which weights, and what of them is used: for whoever keeps features or descriptors."""
        return {"sha256": own_weights_sha256(), "context": self.context}

    def extract(self, luminance: Tensor, layers: Sequence[int]) -> dict[int, Tensor]:
        """(N, 1, H, W) -> layer: (N, 32, H / 2^(l-1), W / 2^(l-1)) unit length, float32, for layers among 3, 4, 5.

        Raises:
            SettingsError: another layer. InputError: as for the function `extract`.
        """
        if not set(layers) <= {3, 4, 5}:
            raise SettingsError(f"layers {list(layers)}: the own features have layers 3, 4 and 5 only")
        finest = self.positions(luminance)
        return {n: finest if n == 3 else F.normalize(F.avg_pool2d(finest, 2 ** (n - 3)), dim=1) for n in layers}

    def positions(self, luminance: Tensor) -> Tensor:
        """(N, 1, H, W) -> (N, 32, H / 4, W / 4); see the function `extract`."""
        _check(luminance)
        luminance = luminance.to(self.device, torch.float32)
        if self.device.type == "cpu":
            return self._one_by_one(luminance)
        return self._through(luminance)

    def _through(self, luminance: Tensor) -> Tensor:
        with torch.no_grad():
            return self._network(luminance, self.context)

    def _one_by_one(self, luminance: Tensor) -> Tensor:
        """Pictures side by side, each on one thread: the same bits whatever else is in the batch and however many threads."""
        with side_by_side() as each:
            return torch.cat(list(each(self._through, luminance[:, None].unbind())))

    def descriptor(self, luminance: Tensor) -> Tensor:
        """(N, 1, H, W) -> (N, 2048): the features on an 8 x 8 raster of the slice, unit length."""
        return F.normalize(F.adaptive_avg_pool2d(self.positions(luminance), 8).flatten(1), dim=1)


def extract(luminance: Tensor, device: str = "cpu", context: float = OWN_CONTEXT) -> Tensor:
    """Features of grey pictures that do not change with their contrast.

    Args:
        luminance: (N, 1, H, W) floating point, display grey 0..1, black outside the body; H and W multiples of 16.
        context: see `Contrast`.

    Returns:
        (N, 32, H / 4, W / 4) float32 of unit length; position (i, j) stands for pixels 4i .. 4i + 3, 4j .. 4j + 3.

    Raises:
        InputError: another shape or type, NaN or infinite values. WeightsError: see `Contrast`.
    """
    return Contrast(device, context).positions(luminance)


@functools.lru_cache(maxsize=4)
def _loaded(device: str) -> ContrastNet:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    network = ContrastNet()
    remedy = "install MedColor anew, or train it: see Testing/Training/README.md"
    try:
        stored = {name: values.float() for name, values in load_file(str(WEIGHTS)).items()}
        network.load_state_dict(stored)
    except (OSError, SafetensorError) as error:
        raise WeightsError(
            f"{WEIGHTS.name}: the weights of the own features cannot be read ({error}); {remedy}"
        ) from error
    except RuntimeError as error:  # names or shapes
        raise WeightsError(f"{WEIGHTS.name}: weights of another version; {remedy}") from error
    if not all(bool(torch.isfinite(values).all()) for values in stored.values()):
        raise WeightsError(f"{WEIGHTS.name}: weights that are not finite; {remedy}")
    return network.to(device, memory_format=torch.channels_last).eval().requires_grad_(False)


def _check(luminance: Tensor) -> None:
    shape = tuple(luminance.shape)
    if len(shape) != 4 or shape[1] != 1 or 0 in shape or not luminance.is_floating_point():
        raise InputError(f"luminance: expected a floating-point (N, 1, H, W) in 0..1, got {luminance.dtype} {shape}")
    if shape[2] % MULTIPLE or shape[3] % MULTIPLE:
        raise InputError(f"luminance: height and width must be multiples of {MULTIPLE}, got {shape[2]} x {shape[3]}")
    if not bool(torch.isfinite(luminance).all()):
        raise InputError("luminance: NaN or infinite values; fill them before computing features")


class ContrastNet(nn.Module):
    """Luminance (N, 1, H, W) -> (N, 32, H / 4, W / 4), unit length. Three levels: a quarter, an eighth, a sixteenth."""

    def __init__(self, width: int = 48, deep: int = 64) -> None:
        super().__init__()
        inputs = 4 * _PLANES  # blocks of 2 x 2 pixels as channels: as good as a stride-1 layer, much faster
        self.stem = nn.Sequential(_layer(inputs, 32), _layer(32, width, stride=2))
        self.quarter = nn.ModuleList([_layer(width, width), _layer(width, width, dilation=2)])
        self.to_eighth = _layer(width, deep, stride=2)
        self.eighth = nn.ModuleList(
            [_layer(deep, deep), _layer(deep, deep, dilation=2), _layer(deep, deep, dilation=4)]
        )
        self.to_sixteenth = _layer(deep, deep, stride=2)
        self.sixteenth = nn.ModuleList([_layer(deep, deep), _layer(deep, deep, dilation=2)])
        self.join_eighth = _layer(2 * deep, deep, kernel=1)
        self.join_quarter = _layer(width + deep, deep)
        self.head = nn.Conv2d(deep + width, CHANNELS, 1)

    def forward(self, luminance: Tensor, context: float = 1.0) -> Tensor:
        """See the class, and `Contrast` for `context`."""
        x = self.stem(F.pixel_unshuffle(standardised(luminance), 2))
        early = x
        x = quarter = _residual(self.quarter, x)
        x = eighth = _residual(self.eighth, self.to_eighth(x))
        far = torch.zeros_like(eighth)  # nothing reads the coarsest level where its share is 0
        if context:
            far = context * _doubled(_residual(self.sixteenth, self.to_sixteenth(x)))
        x = self.join_eighth(torch.cat([eighth, far], 1))
        x = self.join_quarter(torch.cat([quarter, _doubled(x)], 1))
        return F.normalize(self.head(torch.cat([early, x], 1)), dim=1)


def standardised(luminance: Tensor) -> Tensor:
    """(N, 1, H, W) -> (N, 3, H, W): standardised by the whole picture, and by squares of 9 and of 36 pixels around a pixel.

    The squares bring out soft tissue that lies within a few per cent of a range that bone takes.
    """
    mean = luminance.mean((2, 3), keepdim=True)
    x = luminance - mean
    deviation = x.square().mean((2, 3), keepdim=True).sqrt() + 1e-3
    x = x / deviation
    moments = torch.cat([x, x.square()], 1)
    far = F.interpolate(_around(F.avg_pool2d(moments, STRIDE), _FAR_CELLS), size=x.shape[2:], mode="bilinear")
    return torch.cat([x, _locally(x, _around(moments, _NEAR_PX)), _locally(x, far)], 1)


def _around(values: Tensor, side: int) -> Tensor:
    """Mean of the square around every position, of what lies inside the picture; rows and columns one after the other."""
    half = side // 2
    rows = F.avg_pool2d(values, (side, 1), 1, (half, 0), count_include_pad=False)
    return F.avg_pool2d(rows, (1, side), 1, (0, half), count_include_pad=False)


def _locally(x: Tensor, moments: Tensor) -> Tensor:
    variance = (moments[:, 1:] - moments[:, :1].square()).clamp_min(0)
    return (x - moments[:, :1]) / (variance.sqrt() + _FLOOR)


def _layer(inputs: int, outputs: int, kernel: int = 3, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    padding = dilation * (kernel // 2)
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, padding, dilation, bias=False)
    return nn.Sequential(convolution, nn.GroupNorm(8, outputs), nn.LeakyReLU(0.1, inplace=True))


def _residual(layers: nn.ModuleList, x: Tensor) -> Tensor:
    for layer in layers:
        x = x + layer(x)
    return x


def _doubled(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
