"""Fast global smoother (Min, Choi, Lu, Ham, Sohn, Do: Fast Global Image Smoothing Based on Weighted Least Squares).

This file takes arrays apart and puts them together; `opencv` or `fgs_torch` solves, `fgs_parameters` says which lambda.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from . import opencv
from .checks import output_dtype, require_parameters
from .fgs_parameters import FgsParameters, lambda_schedule

if TYPE_CHECKING:
    import torch


def fast_global_smoother(
    source: np.ndarray | torch.Tensor,
    guide: np.ndarray | torch.Tensor,
    lam: float = 32.0,
    sigma: float = 200.0,
    iterations: int = 3,
    schedule: str = "min2014",
    confidence: np.ndarray | torch.Tensor | None = None,
) -> np.ndarray | torch.Tensor:
    """Smooth an image, or a stack of images, except across the edges of a guide (Min et al. 2014).

    Rows, then columns, are smoothed by the exact solution of (I + lambda_t L) x = f, L the Laplacian of the line with
    links exp(-|guide difference| / sigma), the Euclidean norm over the guide's channels. The result is linear in the
    source; rows before columns makes it depend, a little, on the image's orientation. In float32 it is within 1e-5 of
    the source's largest magnitude from the exact result at any lambda and sigma, for lines of up to 4096 pixels.
    Constants are kept exactly.

    Two solvers take turns. OpenCV's, the faster one, where it is as exact as that: one image of numbers of up to 32 bits with
    a guide of whole numbers from 0 to 255 (of any type; one or three channels), no confidence, no more than `opencv.
    LARGEST_LAMBDA` in an iteration. Everything else, torch tensors included, is solved by `fgs_torch`, for sources of one sign
    even within 1e-5 pixel by pixel.

    Args:
        source: (H, W), (H, W, C) or (N, H, W, C), any real dtype and range: numpy arrays, or torch tensors on any
            device. Not altered. A stack of images of one channel is (N, H, W, 1).
        guide: (H, W) or (H, W, G), for one image or shared by a stack; or (N, H, W) or (N, H, W, G): beside a source of
            four dimensions, a guide of three is (N, H, W). Any real dtype; same kind and device as the source.
        lam: strength, 0..1e30; 0 returns the source. See `schedule`.
        sigma: in the guide's units, at least 0; the default is for 8-bit luminance, 0..255. 0 links equal pixels only.
        iterations: T, 1..100.
        schedule: "min2014": lambda_t = 3/2 4^(T-t) / (4^T - 1) lambda; "opencv": lambda_t = lambda / 4^(t-1).
        confidence: (H, W), or (N, H, W) for a stack, in 0..1: returns FGS(c f) / FGS(c), so that pixels of little
            confidence take the values of those near them; the source itself where no confidence reaches.

    Returns:
        Shape, kind and device of the source; its dtype for floats, float32 for integers. Each channel of each image
        lies within the range of its source.

    Raises:
        InputError: shapes or kinds that do not fit, empty, not real, NaN or infinite values, confidence outside 0..1.
        SettingsError: a parameter outside its range.
    """
    from .fgs_torch import fgs_torch

    FgsParameters(lam, sigma, iterations, schedule)  # refuse wrong settings before anything is copied
    is_numpy = _one_kind(source, guide, confidence)
    if is_numpy and confidence is None and lam > 0:
        found = opencv.fast_global_smoother(source, guide, lambda_schedule(lam, iterations, schedule), sigma)
        if found is not None:
            return found.astype(output_dtype(source), copy=False)
    tensor, guide_tensor = _float_tensor("source", source), _guide_tensor(guide)
    single, flat = tensor.ndim < 4, tensor.ndim == 2
    if tensor.ndim not in (2, 3, 4):
        raise InputError(f"source: expected (H, W), (H, W, C) or (N, H, W, C), got shape {tuple(tensor.shape)}")
    tensor = tensor[..., None] if flat else tensor
    planes = (tensor[None] if single else tensor).permute(0, 3, 1, 2).contiguous()
    trust = None if confidence is None else _maps("confidence", _float_tensor("confidence", confidence), single, False)
    guide_maps = _maps("guide", guide_tensor, single, True)
    result = fgs_torch(planes, guide_maps, lam, sigma, iterations, schedule=schedule, confidence=trust)
    result = result.permute(0, 2, 3, 1)
    result = result[0] if single else result
    result = result[..., 0] if flat else result
    return np.ascontiguousarray(result.numpy()) if is_numpy else result.contiguous()


def smooth(source: np.ndarray, guide: np.ndarray, parameters: FgsParameters | None = None) -> np.ndarray:
    """`fast_global_smoother` with the signature of FILTERS: source (H, W, C), guide (H, W) -> like source."""
    parameters = FgsParameters() if parameters is None else parameters
    require_parameters(parameters, FgsParameters)
    return fast_global_smoother(source, guide, **asdict(parameters))


def _one_kind(source: Any, guide: Any, confidence: Any) -> bool:
    """True for numpy arrays (or lists), False for torch tensors; a mixture is refused."""
    import torch

    given = [value for value in (source, guide, confidence) if value is not None]
    tensors = sum(isinstance(value, torch.Tensor) for value in given)
    if tensors not in (0, len(given)):
        raise InputError("source, guide and confidence: expected all numpy arrays or all torch tensors, got a mixture")
    return tensors == 0


def _real_array(name: str, values: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind not in "buif" or array.dtype.itemsize > 8:
        raise InputError(f"{name}: expected an array of integers or of floats up to float64, got dtype {array.dtype}")
    return array


def _float_tensor(name: str, values: Any) -> torch.Tensor:
    """As a torch tensor of floats, a copy where the array is read-only, of foreign byte order or of integers."""
    import torch

    if isinstance(values, torch.Tensor):
        if values.is_complex():
            raise InputError(f"{name}: expected real numbers, got {values.dtype}")
        return values if values.is_floating_point() else values.to(torch.float32)
    array = _real_array(name, values)
    dtype = array.dtype.newbyteorder("=") if array.dtype.kind == "f" else np.dtype(np.float32)
    return torch.from_numpy(np.require(array, dtype, ["C", "W"]))


def _guide_tensor(values: Any) -> torch.Tensor:
    """As a torch tensor; numpy integers become their offset from the smallest: torch lacks some unsigned types."""
    import torch

    if isinstance(values, torch.Tensor):
        return values
    array = _real_array("guide", values)
    if array.dtype.kind == "f" or array.size == 0:
        return _float_tensor("guide", array)
    array = array.astype(np.uint8) if array.dtype.kind == "b" else array.astype(array.dtype.newbyteorder("="))
    array -= array.min()  # a range beyond the signed type wraps around, and reads correctly as unsigned
    return torch.from_numpy(array.view(f"u{array.dtype.itemsize}").astype(np.float64))


def _maps(name: str, tensor: torch.Tensor, single: bool, may_have_channels: bool) -> torch.Tensor:
    """Guide or confidence as (N or 1, G, H, W)."""
    ndim = tensor.ndim
    if ndim == 2:
        return tensor[None, None]
    if ndim == 3 and not single:
        return tensor[:, None]
    if ndim == 3 and may_have_channels:
        return tensor.permute(2, 0, 1)[None].contiguous()
    if ndim == 4 and not single and may_have_channels:
        return tensor.permute(0, 3, 1, 2).contiguous()
    expected = "(H, W)" + (" or (H, W, G)" if may_have_channels else "")
    if not single:
        expected = "(H, W), (N, H, W)" + (" or (N, H, W, G)" if may_have_channels else "")
    raise InputError(f"{name}: expected {expected} beside this source, got shape {tuple(tensor.shape)}")
