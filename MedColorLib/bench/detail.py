"""How much of the scan's own detail a result shows: local correlation, noise, halos. Luminance (L*) of both.

    detail(colorize, volume, references, settings, slices) -> Detail
    detail_of(scan, result, body) -> Detail, of L* (n, rows, cols) and body (n, rows, cols) bool

Correlation: mean of |r| between scan and result in windows of 9 x 9 pixels that lie wholly in the body and in which the
scan varies by more than three times its noise and twice its calmest windows; 1 where every edge and texture of the scan is
there, whatever its sign.
Noise: rms of what is finer than a Gaussian of 1.5 pixels, result over scan, in the 30 % of windows where the scan varies
least; 1 for the scan itself, above 1 where noise is amplified.
Halo: at strong edges of the scan, along their normal, how much more the result changes than the scan between 3..5 and
9..11 pixels from the edge, on sides where the scan itself is flat: mean, in L*. A plain picture of two tissues has 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..color.lab import gray_to_lightness, srgb_to_lab
from ..parameters import Settings
from ..volume import Volume

WINDOW_PX = 9
MR_FOLDER, MR_SLICES = "mr_head_t1_dicom", (20, 30)
CT_FILE, CT_SLICES = "vhf_head_ct.nrrd", (117, 127)
TARGETS = {"MR head": 0.90, "CT head": 0.85}
_ABOVE_NOISE, _LEAST_STEP = 3.0, 0.5  # L*: half a level of 8 bits is no detail
_CALM_SHARE, _ABOVE_CALM = 0.05, 2.0
_QUIET_SHARE, _FINE_PX = 0.3, 1.5
_EDGE_SHARE, _EDGE_SLOPE = 0.95, 3.0  # of the body's gradients; L* a pixel
_NEAR_PX, _FAR_PX = (3.0, 4.0, 5.0), (9.0, 10.0, 11.0)
_FLAT = 2.0  # L*


@dataclass(frozen=True)
class Detail:
    """See the module; `share` is the part of the body's windows that had detail."""

    correlation: float
    noise: float
    halo: float
    share: float


def mr_head(colorize, data, settings: Settings | None = None) -> Detail:
    """Ten slices of the MR head after the photograph of the head."""
    return _of_file(colorize, data, MR_FOLDER, MR_SLICES, settings)


def ct_head(colorize, data, settings: Settings | None = None) -> Detail:
    """Ten slices of the CT head after the photograph of the head."""
    return _of_file(colorize, data, CT_FILE, CT_SLICES, settings)


def _of_file(colorize, data, name: str, slices: tuple[int, int], settings: Settings | None) -> Detail:
    from .pairs import SECTIONS
    from .seen import cut, load

    slab = cut(load(str(data / name)), *slices)
    return detail(colorize, slab, [str(data / SECTIONS["head"])], settings or Settings())


def detail(colorize, volume: Volume, references: list, settings: Settings) -> Detail:
    """Colour a volume and compare its luminance with the scan's under the window of the run."""
    scan, body, order = display_lightness(volume, references, settings)
    rgb = order.view(colorize(volume, references, settings).rgb)
    return detail_of(scan, srgb_to_lab(rgb.astype(np.float64) / 255)[..., 0], body)


def display_lightness(volume: Volume, references: list, settings: Settings):
    """L* (n, rows, cols) of the scan as it is shown, its body (n, rows, cols) bool, and the order of its slices."""
    from ..run.prepare import prepare

    prepared = prepare(volume, references, settings)
    window, view = prepared.window, prepared.view
    grey = np.clip((np.asarray(view[:]).astype(np.float64) - window.low) / (window.high - window.low), 0, 1)
    body = np.stack([prepared.body.plane(k) > 0.5 for k in range(len(view))])
    return gray_to_lightness(grey), body, prepared.order


def detail_of(scan: np.ndarray, result: np.ndarray, body: np.ndarray) -> Detail:
    """See the module."""
    planes = [_Plane(*planes) for planes in zip(scan, result, body)]
    sure = [plane for plane in planes if plane.inside.any()]
    noise = float(np.median([plane.noise for plane in sure])) if sure else 0.0
    # an interpolated scan has little noise from pixel to pixel: what the calmest windows hold counts as noise, too
    calm = float(np.median([np.quantile(plane.scan_std[plane.inside], _CALM_SHARE) for plane in sure])) if sure else 0.0
    limit = max(_ABOVE_NOISE * noise, _ABOVE_CALM * calm, _LEAST_STEP)
    with_detail = [plane.inside & (plane.scan_std > limit) for plane in sure]
    values = np.concatenate([plane.correlation[where] for plane, where in zip(sure, with_detail)])
    windows = sum(int(plane.inside.sum()) for plane in sure)
    return Detail(
        float(np.abs(values).mean()) if values.size else float("nan"),
        _noise_ratio(sure),
        _halo(sure),
        values.size / max(windows, 1),
    )


class _Plane:
    """One slice: scan and result L*, and what its 9 x 9 windows hold."""

    def __init__(self, scan: np.ndarray, result: np.ndarray, body: np.ndarray) -> None:
        from scipy import ndimage

        def mean(values):
            return ndimage.uniform_filter(values, WINDOW_PX, mode="nearest")

        self.scan, self.result, self.body = scan, result, body
        self.inside = ndimage.binary_erosion(body, np.ones((WINDOW_PX, WINDOW_PX)))
        scan_mean, result_mean = mean(scan), mean(result)
        scan_var = np.maximum(mean(scan * scan) - scan_mean**2, 0)
        result_var = np.maximum(mean(result * result) - result_mean**2, 0)
        self.scan_std = np.sqrt(scan_var)
        both = np.sqrt(scan_var * result_var)
        covariance = mean(scan * result) - scan_mean * result_mean
        self.correlation = np.where(both > 1e-9, covariance / np.maximum(both, 1e-9), 0.0)
        self.noise = noise_level(scan, self.inside) if self.inside.any() else 0.0


def noise_level(plane: np.ndarray, where: np.ndarray) -> float:
    """Standard deviation of the noise: median absolute response of the mask 1 -2 1 by 1 -2 1, which sees no ramps."""
    from scipy import ndimage

    mask = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float64)
    response = ndimage.convolve(plane, mask, mode="nearest")[where]
    return float(np.median(np.abs(response)) / 0.6745 / 6)


def _noise_ratio(planes: list[_Plane]) -> float:
    from scipy import ndimage

    ours = scans = 0.0
    for plane in planes:
        varying = plane.inside & (plane.scan_std > 1e-6)  # where the window clips the scan there is nothing to amplify
        if not varying.any():
            continue
        quiet = varying & (plane.scan_std <= np.quantile(plane.scan_std[varying], _QUIET_SHARE))
        fine = [image - ndimage.gaussian_filter(image, _FINE_PX) for image in (plane.result, plane.scan)]
        ours += float((fine[0][quiet] ** 2).sum())
        scans += float((fine[1][quiet] ** 2).sum())
    return float(np.sqrt(ours / scans)) if scans > 0 else float("nan")


def _halo(planes: list[_Plane]) -> float:
    more = [_halos(plane) for plane in planes]
    values = np.concatenate(more) if more else np.zeros(0)
    return float(values.mean()) if values.size else 0.0


def _halos(plane: _Plane) -> np.ndarray:
    """For every flat side of a strong edge: |near - far| of the result minus that of the scan, 0 or more."""
    from scipy import ndimage

    smooth = ndimage.gaussian_filter(plane.scan, 1.0)
    slope = np.stack(np.gradient(smooth), -1)
    size = np.hypot(*np.moveaxis(slope, -1, 0))
    inside = ndimage.binary_erosion(plane.body, iterations=2)
    if not inside.any():
        return np.zeros(0)
    edge = inside & (size > max(np.quantile(size[inside], _EDGE_SHARE), _EDGE_SLOPE))
    edge &= size >= ndimage.maximum_filter(size, 3) - 1e-9  # the crest alone
    where = np.argwhere(edge).astype(np.float64)
    if not len(where):
        return np.zeros(0)
    normal = slope[edge] / size[edge][:, None]
    found = []
    for side in (-1, 1):
        points = {d: where + side * d * normal for d in (*_NEAR_PX, *_FAR_PX)}
        held = np.all([_at(plane.body.astype(np.float64), p) > 0.99 for p in points.values()], axis=0)
        scan = {d: _at(smooth, p) for d, p in points.items()}
        flat = held & (np.ptp(np.stack(list(scan.values())), axis=0) < _FLAT)
        found.append(np.maximum(_step(plane.result, points) - _step(plane.scan, points), 0)[flat])
    return np.concatenate(found)


def _at(plane: np.ndarray, points: np.ndarray) -> np.ndarray:
    from scipy import ndimage

    return ndimage.map_coordinates(plane, points.T, order=1, mode="constant", cval=0.0)


def _step(plane: np.ndarray, points: dict[float, np.ndarray]) -> np.ndarray:
    from scipy import ndimage

    smooth = ndimage.gaussian_filter(plane, 1.0)
    near, far = (np.mean([_at(smooth, points[d]) for d in distances], axis=0) for distances in (_NEAR_PX, _FAR_PX))
    return np.abs(near - far)
