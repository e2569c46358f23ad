"""The luminance VGG-19 of He et al. 2018 ("Deep Exemplar-based Colorization"), the "gray VGG-19" of the paper.

VGG-19 with batch normalisation, of the input too, after each convolution and before its ReLU (`data/bn`, `data/scale`,
`conv1_1/bn` ... in the released deploy.prototxt), fine-tuned on pictures whose three planes all hold the L of CIELAB,
scaled to 0..255, with no mean subtracted. Import this module only to use it: it needs torch.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from .vgg19 import VGG19

_EPSILON = 1e-5  # Caffe's and torch's default; the released network states no other


class GrayVGG19(VGG19):
    """Feature extractor `gray-vgg19`: as `VGG19`, with the batch normalisations folded into the convolutions.

    Attributes:
        name: "gray-vgg19".
    """

    name = "gray-vgg19"

    def descriptor(self, luminance: torch.Tensor) -> torch.Tensor:
        """Describe whole pictures by pool5: the released network ends there.

        Args:
            luminance: (N, 1, H, W) sRGB grey in 0..1; resized to 224 x 224, bilinear with antialiasing.

        Returns:
            (N, 25088) float32, 0 or more, for cosine similarity.
        """
        return self._pool5(luminance).flatten(1)

    def _planes(self, luminance: torch.Tensor) -> torch.Tensor:
        return lightness(luminance)

    def _preprocessing(self) -> tuple[Sequence[float], Sequence[float]]:
        gain, shift = self._normalisation("data_bn")
        return (255.0 * gain).tolist(), shift.tolist()

    def _parameters(self, name: str) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = super()._parameters(name)
        gain, shift = self._normalisation(f"{name}_bn")
        return weight.to(torch.float64) * gain.view(-1, 1, 1, 1), bias.to(torch.float64) * gain + shift

    def _normalisation(self, name: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Return gain and shift of a batch normalisation, y = gain * x + shift, per channel in float64."""
        mean = self._weights.tensor(f"{name}.running_mean").to(torch.float64)
        variance = self._weights.tensor(f"{name}.running_var").to(torch.float64)
        gain = torch.rsqrt(variance + _EPSILON)
        if f"{name}.weight" in self._weights:
            gain = gain * self._weights.tensor(f"{name}.weight").to(torch.float64)
        shift = -mean * gain
        if f"{name}.bias" in self._weights:
            shift = shift + self._weights.tensor(f"{name}.bias").to(torch.float64)
        return gain, shift


def lightness(luminance: torch.Tensor) -> torch.Tensor:
    """Return CIELAB's L* / 100 of sRGB grey, both in 0..1 (IEC 61966-2-1 and CIE 15)."""
    linear = torch.where(luminance <= 0.04045, luminance / 12.92, ((luminance.clamp(min=0) + 0.055) / 1.055) ** 2.4)
    cube = 216 / 24389
    root = linear.clamp(min=cube) ** (1 / 3)
    return torch.where(linear > cube, 1.16 * root - 0.16, linear * (24389 / 2700))
