"""Local regression on luminance: colour as a function of grey within a neighbourhood.

The matched colours are averaged in a bilateral grid (x, y, grey) and read back with the slice's own grey, like the
bilateral grid of Chen, Paris, Durand (2007) used as an estimator: matching decides *which* colours belong to a region,
the slice's grey decides *where* each of them goes. Cells with little support borrow from cells four times as large, and
those from the whole slice, so no pixel is left without a colour and single wrong matches are outvoted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SettingsError
from . import options

if TYPE_CHECKING:
    import torch

MOST_CELLS = 1 << 22  # 130 MB of sums a slice; the defaults on 256 x 256 pixels take 37 000
_LEAST_SUPPORT = 1e-30  # what float32 can still divide by where a cell has no evidence at all
WHOLE = (0.0, 1.0, 0.0, 1.0)  # (top, bottom, left, right): the picture fills the frame of the cells


@dataclass(frozen=True)
class RegressionParameters:
    """Parameters of the local regression.

    Attributes:
        cell_px: side of the finest cells in pixels of the matching raster.
        bins: grey levels of the grid over the guide's range 0..255.
        support_px: pixels of evidence at which a cell counts as much as the coarser ones around it.
        levels: how many times the cells are coarsened by two before the whole slice.
    """

    cell_px: float = options.number(8.0, 1, 1e6, "Side of the finest neighbourhoods on the matching raster.", "px")
    bins: int = options.count(64, 2, 1024, "Levels of grey told apart.")
    support_px: float = options.number(
        4.0,
        0,
        1e9,
        "Evidence at which a neighbourhood counts as much as the larger ones around it; if not given, up to 64 for MR.",
        "px",
        above_low=True,
    )
    levels: int = options.count(3, 0, 8, "How many times neighbourhoods are doubled before the whole slice.")

    def __post_init__(self) -> None:
        options.check(self)


def smooth(source: np.ndarray, guide: np.ndarray, parameters: RegressionParameters | None = None) -> np.ndarray:
    """Regress `source` (H, W, C) on `guide` (H, W) 0..255 and return it at the guide's pixels; float32, same shape."""
    model = fit(source, guide, np.ones(guide.shape, np.float32), parameters or RegressionParameters())
    return predict(model, guide)


def fit(source: np.ndarray, guide: np.ndarray, weight: np.ndarray, parameters: RegressionParameters) -> np.ndarray:
    """Estimate the grid of mean colours.

    Args:
        source: (H, W, C). guide: (H, W), 0..255. weight: (H, W), 0 or more: trust in each pixel, 0 leaves it out.

    Returns:
        (rows, columns, bins, C) float32; defined everywhere.
    """
    return solve(splat(source, guide, weight, parameters), parameters)


def solve(sums: np.ndarray, parameters: RegressionParameters) -> np.ndarray:
    """Mean colours (rows, columns, bins, C) float32 from the sums of `splat`, or from a weighted sum of several."""
    planes = _blur(np.ascontiguousarray(np.moveaxis(sums, -1, 0)))
    support = max(parameters.support_px, _LEAST_SUPPORT)
    return np.ascontiguousarray(np.moveaxis(_shrink(planes, support, parameters.levels), 0, -1))


def predict(
    model: np.ndarray,
    guide: np.ndarray,
    within: tuple[float, float, float, float] = WHOLE,
    mask: np.ndarray | None = None,
) -> np.ndarray:
    """Read the grid at every pixel of `guide` (h, w), whose size may differ from the one fitted: (h, w, C) float32.

    Args:
        mask: (h, w) bool: read only there; returns (n, C), row by row.
    """
    import torch

    axes = zip(_positions(guide.shape, model.shape[:2], within), model.shape[:2])
    y, x = (torch.from_numpy(at * (2 / (count - 1)) - 1).float() for at, count in axes)
    values = guide if mask is None else guide[mask]
    if not values.size:
        return np.zeros((0, model.shape[-1]), np.float32)
    where = torch.empty(values.size, 3)
    if mask is None:
        place = where.view(*guide.shape, 3)
        place[..., 0], place[..., 1] = x, y[:, None]
    else:
        place = where
        rows, cols = (torch.from_numpy(at) for at in np.divmod(np.flatnonzero(mask), guide.shape[1]))
        place[:, 0], place[:, 1] = x[cols], y[rows]
    place[..., 2] = torch.from_numpy(np.clip(values, 0, 255).astype(np.float32)) * (2 / 255) - 1
    return _read(model, where).reshape(*values.shape, -1)


def _read(model: np.ndarray, where: torch.Tensor) -> np.ndarray:
    """The grid at places (n, 3), -1..1 across, down and in grey: (n, C). Beyond its rim as at it."""
    import torch

    parts = torch.get_num_threads()  # grid_sample gives every thread whole samples: one picture would take one thread
    volumes = torch.from_numpy(np.ascontiguousarray(model)).permute(3, 2, 0, 1)[None].expand(parts, -1, -1, -1, -1)
    padded = torch.nn.functional.pad(where, (0, 0, 0, -len(where) % parts)).view(parts, 1, 1, -1, 3)
    out = torch.nn.functional.grid_sample(volumes, padded, mode="bilinear", padding_mode="border", align_corners=True)
    return out.movedim(1, -1).reshape(-1, model.shape[-1])[: len(where)].numpy()


def predict_at(model: np.ndarray, y: np.ndarray, x: np.ndarray, guide: np.ndarray) -> np.ndarray:
    """Read the grid at places of its frame, 0..1 down and across, each with a guide 0..255: (h, w, C) float32.

    Args:
        y, x: as `guide` (h, w), or broadcast to it; what lies outside the frame is read at its rim.
    """
    import torch

    axes = zip((y, x), model.shape[:2])
    down, across = (np.clip(0.5 + at * (n - 2), 0, n - 1) * (2 / (n - 1)) - 1 for at, n in axes)
    where = np.empty((*guide.shape, 3), np.float32)
    where[..., 0], where[..., 1], where[..., 2] = across, down, np.clip(guide, 0, 255) * (2 / 255) - 1
    return _read(model, torch.from_numpy(where).view(-1, 3)).reshape(*guide.shape, -1)


def splat(
    source: np.ndarray,
    guide: np.ndarray,
    weight: np.ndarray,
    parameters: RegressionParameters,
    within: tuple[float, float, float, float] = WHOLE,
    every: int = 1,
) -> np.ndarray:
    """Weighted sums of colour and, last, of weight, spread linearly over the nearest cells.

    Args:
        source, guide, weight, parameters: as for `fit`. within, every: as for `Witnesses`.

    Returns:
        (rows, columns, bins, C + 1) float32.
    """
    return Witnesses(guide, weight > 0, parameters, within, every).sums(source, weight)


class Witnesses:
    """Pixels of a picture and how they spread over the nearest cells, for several sums of the same pixels.

    Args:
        guide: (H, W) 0..255. there: (H, W) bool: the others count nothing.
        within: (top, bottom, left, right) edges of the picture in a frame from 0 to 1 that the cells fill; what lies
            outside the frame goes to the cells at its rim.
        every: the arrays are each n-th row and column of a picture, from the first on, and count n * n times.
    """

    def __init__(
        self,
        guide: np.ndarray,
        there: np.ndarray,
        parameters: RegressionParameters,
        within: tuple[float, float, float, float] = WHOLE,
        every: int = 1,
    ) -> None:
        self._there, self._every = np.nonzero(there), every
        self._cells, self._shape = _cells(guide, self._there, parameters, within, every)

    def sums(self, source: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """As `splat`: source (H, W, C), weight (H, W) -> (rows, columns, bins, C + 1) float32."""
        trust = weight[self._there].astype(np.float32) * np.float32(self._every**2)
        values = np.concatenate([source[self._there] * trust[:, None], trust[:, None]], 1)
        return (self._cells @ values.astype(np.float32)).reshape(*self._shape, -1)


def _cells(guide: np.ndarray, keep: tuple, parameters: RegressionParameters, within, every: int):
    """Sparse (cells, pixels): how much of each pixel goes to which cell; and the cells' (rows, columns, bins)."""
    shape = tuple(every * side for side in guide.shape)
    rows, cols = (max(2, round(side / parameters.cell_px)) + 2 for side in shape)
    bins = parameters.bins
    if rows * cols * bins > MOST_CELLS:
        raise SettingsError(
            f"smoother_options: cell_px {parameters.cell_px:g} with {bins} bins asks for {rows * cols * bins} cells, at "
            f"most {MOST_CELLS} are taken; choose larger cells or fewer bins"
        )
    y, x = (at[::every][of] for at, of in zip(_positions(shape, (rows, cols), within), keep))
    z = np.clip(guide[keep], 0, 255).astype(np.float64) * ((bins - 1) / 255)
    return _spreading(((y, rows), (x, cols), (z, bins))), (rows, cols, bins)


def _spreading(positions):
    """Sparse (cells, points): how much of each point goes to which cell.

    Args:
        positions: for every axis of the cells, where the points lie (n,) and the number of cells.
    """
    from scipy.sparse import csc_array

    index, share = np.zeros((1, 1), np.int32), np.ones((1, 1), np.float32)
    for at, size in positions:
        low, fraction = _corner(at, size)
        nearest = np.stack([low, low + 1], 1).astype(np.int32)
        index = (index[:, :, None] * size + nearest[:, None]).reshape(len(at), 2 * index.shape[1])
        share = (share[:, :, None] * np.stack([1 - fraction, fraction], 1)[:, None].astype(np.float32)).reshape(
            index.shape
        )
    points, corners = share.shape
    starts = np.arange(0, points * corners + 1, corners, dtype=np.int32)
    cells = int(np.prod([size for _, size in positions]))
    return csc_array((share.ravel(), index.ravel(), starts), shape=(cells, points))


def _positions(shape, count, within) -> tuple[np.ndarray, np.ndarray]:
    """Cell coordinates of pixel rows and of columns: the frame's edges lie at 0.5 and n - 1.5, one cell is margin."""
    edges = within[:2], within[2:]
    return tuple(
        np.clip(0.5 + (low + (np.arange(side) + 0.5) / side * (high - low)) * (n - 2), 0, n - 1)
        for side, n, (low, high) in zip(shape, count, edges)
    )


def _corner(position: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The cell below each position, and how far beyond it the position lies, 0..1."""
    low = np.minimum(position.astype(np.int64), size - 2)
    return low, position - low


def _blur(sums: np.ndarray) -> np.ndarray:
    """Gaussian of one cell along rows, columns and bins of (C + 1, rows, cols, bins), as products with small matrices."""
    for _ in range(3):  # the last axis each time, then it becomes the second: after three turns they are in order again
        sums = np.moveaxis(sums @ _blurring(sums.shape[-1]).T, -1, 1)
    return sums


@lru_cache(maxsize=16)
def _blurring(count: int) -> np.ndarray:
    """(count, count) weights of a Gaussian of one cell, the ends continued."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(np.eye(count), 1.0, axis=0, mode="nearest").astype(np.float32)


def _shrink(sums: np.ndarray, support: float, levels: int) -> np.ndarray:
    """Mean colour per cell, drawn towards coarser cells, then the slice's curve, then its mean, where support is thin.

    Args:
        sums: (C + 1, rows, cols, bins).

    Returns:
        (C, rows, cols, bins).
    """
    curve = sums.sum((1, 2))
    overall = curve.sum(1)
    mean = overall[:-1] / max(overall[-1], 1e-30)
    curve = (curve[:-1] + support * mean[:, None]) / (curve[-1:] + support)
    pyramid = [sums]
    for _ in range(levels):
        if min(pyramid[-1].shape[1:3]) < 4:
            break
        pyramid.append(_halved(pyramid[-1]))
    estimate = np.broadcast_to(curve[:, None, None], (len(curve), *pyramid[-1].shape[1:]))
    for level in reversed(pyramid):
        if estimate.shape[1:] != level.shape[1:]:
            down, across = (_between(n, coarse) for n, coarse in zip(level.shape[1:3], estimate.shape[1:3]))
            estimate = across @ np.tensordot(estimate, down, (1, 1)).transpose(0, 3, 1, 2)
        estimate = (level[:-1] + support * estimate) / (level[-1:] + support)
    return estimate


def _between(count: int, coarse_count: int) -> np.ndarray:
    """(count, coarse_count) weights of linear interpolation from cells that divide the same length more coarsely."""
    at = np.clip((np.arange(count) + 0.5) * (coarse_count / count) - 0.5, 0, coarse_count - 1)
    weights = np.zeros((count, coarse_count), np.float32)
    low, fraction = _corner(at, coarse_count)
    weights[np.arange(count), low], weights[np.arange(count), low + 1] = 1 - fraction, fraction
    return weights


def _halved(sums: np.ndarray) -> np.ndarray:
    channels, rows, cols, bins = sums.shape
    padded = np.pad(sums, ((0, 0), (0, rows % 2), (0, cols % 2), (0, 0)))
    return padded.reshape(channels, (rows + 1) // 2, 2, (cols + 1) // 2, 2, bins).sum((2, 4))
