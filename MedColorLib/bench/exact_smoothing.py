"""Slow, obvious reference solutions for the smoothing filters."""

from __future__ import annotations

import numpy as np

from ..filters.fgs_parameters import lambda_schedule


def exact_lines(source: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Solve (I + L) x = f along the last axis in extended precision, L the Laplacian of a path with the given links.

    Forward and backward elimination without subtraction, in numpy's longdouble (64 bits of mantissa on x86): relative
    error below 1e-15 for any links.

    Args:
        source: (..., n), any sign: positive and negative parts are solved apart. links: (..., n - 1), 0 or more.

    Returns:
        (..., n) longdouble.
    """
    values = np.asarray(source, np.longdouble)
    parts = np.stack([np.maximum(values, 0), np.maximum(-values, 0)])
    positive, negative = _positive_lines(parts, np.asarray(links, np.longdouble))
    return positive - negative


def _positive_lines(values: np.ndarray, links: np.ndarray) -> np.ndarray:
    count = values.shape[-1]
    ground, load, share = np.longdouble(0), np.longdouble(0), np.longdouble(0)
    loads = np.empty_like(values)
    shares = np.empty((*np.broadcast_shapes(links.shape[:-1], values.shape[:-1]), count), np.longdouble)
    for i in range(count):
        before = links[..., i - 1] if i else np.longdouble(0)
        after = links[..., i] if i < count - 1 else np.longdouble(0)
        pivot = 1 + before * ground + after
        load = (values[..., i] + before * load) / pivot
        ground, share = (1 + before * ground) / pivot, after / pivot
        loads[..., i], shares[..., i] = load, share
    for i in range(count - 2, -1, -1):
        loads[..., i] += shares[..., i] * loads[..., i + 1]
    return loads


def exact_fgs(
    source: np.ndarray, guide: np.ndarray, lam: float, sigma: float, iterations: int, schedule: str
) -> np.ndarray:
    """The fast global smoother's own answer in extended precision. source (H, W, C), guide (H, W) -> (H, W, C)."""
    values = np.moveaxis(np.asarray(source, np.longdouble), 2, 0)
    guide = np.asarray(guide, np.longdouble)
    along_rows, along_columns = (np.exp(-np.abs(np.diff(g, axis=1)) / np.longdouble(sigma)) for g in (guide, guide.T))
    for strength in lambda_schedule(lam, iterations, schedule):
        values = exact_lines(values, np.longdouble(strength) * along_rows)
        values = exact_lines(values.swapaxes(1, 2), np.longdouble(strength) * along_columns).swapaxes(1, 2)
    return np.moveaxis(values, 0, 2)


def exact_plane(source: np.ndarray, guide: np.ndarray, lam: float, sigma: float) -> tuple[np.ndarray, float]:
    """Solve (I + lam L) x = f in two dimensions, the problem that the fast global smoother approximates.

    Returns:
        (H, W, C) float64 and the relative residual |f - A x| / |f| of the sparse direct solution.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    number = np.arange(guide.size).reshape(guide.shape)
    guide = guide.astype(np.float64)
    first = np.concatenate([number[:-1].ravel(), number[:, :-1].ravel()])
    second = np.concatenate([number[1:].ravel(), number[:, 1:].ravel()])
    links = lam * np.exp(-np.abs(guide.ravel()[first] - guide.ravel()[second]) / sigma)
    rows, columns = np.concatenate([first, second, first, second]), np.concatenate([second, first, first, second])
    entries = np.concatenate([-links, -links, links, links])
    matrix = sparse.identity(guide.size) + sparse.coo_matrix((entries, (rows, columns)), (guide.size,) * 2)
    right = source.reshape(guide.size, -1).astype(np.float64)
    options = {"SymmetricMode": True}
    factor = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    solution = factor.solve(right)
    residual = np.linalg.norm(right - matrix @ solution) / np.linalg.norm(right)
    return solution.reshape(source.shape), float(residual)
