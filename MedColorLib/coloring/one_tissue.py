"""Stage *one tissue, one colour*: where grey tells tissue, what a grey is all over a slice counts beside what it is nearby.

A photograph shows one level. On a scan of another, matches near the orbits of the photograph find orbits, those near its
cerebellum find cerebellum, and one brain gets two hues. In MR the same grey at the same depth below the skin is mostly one
tissue (scalp, skull and brain lie in layers, as muscle and organs do), so its colour all over the slice is a second
estimate beside the one of the neighbourhood. The less the matches nearby can be trusted, the more it counts. In CT, where
brain, muscle and blood share a grey, it counts only in slices whose matches know no place either.
"""

from __future__ import annotations

import numpy as np

from ..filters.regression import RegressionParameters

DEPTHS = 5  # layers below the skin, thinner the nearer to it
# Evidence of a pixel nearby from which its neighbourhood decides alone; up to which the slice does.
ENOUGH, NONE = 1.1, 0.2
_AROUND_CELLS = 2.0  # Gaussian within which evidence is counted
_LEAST = 1e-3  # of the cell with most evidence: cells with less lie outside the body


def one_tissue(
    relation: np.ndarray,
    sums: np.ndarray,
    parameters: RegressionParameters,
    share: float,
    elsewhere: np.ndarray | None = None,
) -> np.ndarray:
    """The relation of colour and grey, drawn towards that of all places as deep.

    Args:
        relation: (rows, cols, bins, C) of `regression.solve`. sums: (rows, cols, bins, C + 1) that it comes from.
        share: 0..1, how far grey tells tissue; 0 leaves the relation as it is.
        elsewhere: (DEPTHS, bins, C + 1), of `layers_of`: what slices all over the scan say, beside this one; or None.

    Returns:
        (rows, cols, bins, C) float32.
    """
    if share == 0:
        return relation
    evidence, inside = _evidence(sums)
    if not inside.any():
        return relation
    weight = share * np.clip((ENOUGH - _nearby(evidence, inside, parameters.cell_px)) / (ENOUGH - NONE), 0, 1)
    weight = weight.astype(np.float32)[..., None, None]
    return relation + weight * (_as_deep(sums, inside, parameters.support_px, elsewhere) - relation)


def _evidence(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rows, cols) evidence of each cell, and bool: which lie inside the body."""
    evidence = sums[..., -1].sum(-1)
    return evidence, evidence > _LEAST * evidence.max()


def _nearby(evidence: np.ndarray, inside: np.ndarray, cell_px: float) -> np.ndarray:
    """(rows, cols) mean evidence of a pixel around each cell."""
    from scipy.ndimage import gaussian_filter

    cells = gaussian_filter(inside.astype(np.float32), _AROUND_CELLS)
    return gaussian_filter(evidence, _AROUND_CELLS) / np.maximum(cells * np.float32(cell_px**2), np.float32(1e-6))


def _as_deep(sums: np.ndarray, inside: np.ndarray, support_px: float, elsewhere: np.ndarray | None) -> np.ndarray:
    """E[colour | depth, grey] at every cell; where a depth lacks a grey, what other depths say of it."""
    from scipy.ndimage import gaussian_filter1d

    rows, cols, bins, count = sums.shape
    shares = _layers(inside)
    layers = _by_depth(shares, sums)
    if elsewhere is not None:
        layers += elsewhere
    layers = gaussian_filter1d(layers, 1.0, axis=1, mode="nearest")
    curve = layers.sum(0)
    total = curve.sum(0)
    support = np.float32(max(support_px, 1e-30))
    curve = (curve[:, :-1] + support * total[:-1] / max(total[-1], 1e-30)) / (curve[:, -1:] + support)
    layers = (layers[..., :-1] + support * curve) / (layers[..., -1:] + support)
    return (shares.T @ layers.reshape(DEPTHS, -1)).reshape(rows, cols, bins, count - 1)


def _layers(inside: np.ndarray) -> np.ndarray:
    """(DEPTHS, cells) float32: how far a cell belongs to each layer; 1 in all."""
    from scipy.ndimage import distance_transform_edt

    depth = distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1] / (min(inside.shape) / 2)
    at = np.minimum(np.sqrt(depth) * DEPTHS, DEPTHS - 1).ravel()
    return np.maximum(1 - np.abs(at - np.arange(DEPTHS)[:, None]), 0).astype(np.float32)


def _by_depth(shares: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """(DEPTHS, bins, C + 1)"""
    return (shares @ sums.reshape(shares.shape[1], -1)).reshape(DEPTHS, *sums.shape[2:])


def layers_of(sums: np.ndarray) -> np.ndarray:
    """(DEPTHS, bins, C + 1): the sums (rows, cols, bins, C + 1) of a slice by depth below the skin."""
    _, inside = _evidence(sums)
    return _by_depth(_layers(inside), sums) if inside.any() else np.zeros((DEPTHS, *sums.shape[2:]), np.float32)
