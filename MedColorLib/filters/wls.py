"""Weighted least squares smoothing, solved in two dimensions at once (Farbman, Fattal, Lischinski, Szeliski 2008)."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, MedColorError
from . import options
from .checks import float64_pair, in_range_of, output_dtype, require_parameters

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

_LOG = logging.getLogger("MedColorLib")
DIRECT_PIXELS = 600_000  # above: tiles. A direct factor takes 1.2 GB here and grows faster than the image
_TILE, _OVERLAP = 512, 48  # pixels; the overlap is the decay length sqrt(lam / eps) of the defaults
_RESIDUAL_WANTED, _RESIDUAL_ALLOWED, _STEPS = 1e-10, 1e-7, 2000


@dataclass(frozen=True)
class WlsParameters:
    """Parameters of the weighted least squares filter.

    Attributes:
        lam: strength, 0..1e6.
        alpha: power of the log-luminance difference, 0..10: how sharply links fall at edges.
        eps: added to that power, 1e-8..1e8: links are at most lam / eps.
    """

    lam: float = options.number(0.2, 0.0, 1e6, "Strength; 0 smooths nothing.")
    alpha: float = options.number(1.8, 0.0, 10.0, "How sharply smoothing stops at edges of luminance.")
    eps: float = options.number(1e-4, 1e-8, 1e8, "Keeps smoothing finite where luminance is even.")

    def __post_init__(self) -> None:
        options.check(self)


def _system(guide: np.ndarray, parameters: WlsParameters) -> csr_matrix:
    """I + lam L: symmetric, each row summing to 1. Pixels in C order."""
    from scipy import sparse

    log_luminance = np.log1p(guide)  # ln(g + 1), not ln(g): black pixels have no noise of infinite contrast
    number = np.arange(guide.size).reshape(guide.shape)
    first, second, links = [], [], []
    for axis in (0, 1):
        contrast = np.abs(np.diff(log_luminance, axis=axis)).ravel()
        links.append(parameters.lam / (contrast**parameters.alpha + parameters.eps))
        ahead, behind = (number[1:], number[:-1]) if axis == 0 else (number[:, 1:], number[:, :-1])
        first.append(behind.ravel())
        second.append(ahead.ravel())
    i, j, w = np.concatenate(first), np.concatenate(second), np.concatenate(links)
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])
    laplacian = sparse.coo_matrix((np.concatenate([-w, -w, w, w]), (rows, columns)), shape=(guide.size, guide.size))
    return (sparse.identity(guide.size, format="csr") + laplacian.tocsr()).tocsr()


def _factor(matrix: csr_matrix):
    """Sparse LU in the symmetric mode of SuperLU: no pivoting is needed, the diagonal dominates."""
    from scipy.sparse.linalg import splu

    symmetric = {"SymmetricMode": True}
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)


def _tiles(shape: tuple[int, int]) -> list[np.ndarray]:
    """Pixel numbers of overlapping tiles that cover the image."""
    number = np.arange(shape[0] * shape[1]).reshape(shape)

    def spans(length: int) -> list[slice]:
        return [slice(max(start - _OVERLAP, 0), start + _TILE + _OVERLAP) for start in range(0, length, _TILE)]

    return [number[rows, columns].ravel() for rows in spans(shape[0]) for columns in spans(shape[1])]


def _conjugate_gradients(matrix: csr_matrix, right: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Solve with direct solves of overlapping tiles as the preconditioner (additive Schwarz). right (pixels, C)."""
    factors = [(tile, _factor(matrix[tile][:, tile])) for tile in _tiles(shape)]

    def preconditioned(residual: np.ndarray) -> np.ndarray:
        result = np.zeros_like(residual)
        for tile, factor in factors:
            result[tile] += factor.solve(residual[tile])
        return result

    solution, residual = np.zeros_like(right), right.copy()
    wanted = _RESIDUAL_WANTED * np.linalg.norm(right, axis=0)
    direction = np.zeros_like(right)
    energy_before = np.ones(right.shape[1])
    for _ in range(_STEPS):
        active = np.linalg.norm(residual, axis=0) > wanted  # a solved channel stays as it is: no 0 / 0
        if not active.any():
            break
        step = preconditioned(residual)
        energy = np.where(active, (residual * step).sum(axis=0), 0.0)
        direction = step + direction * (energy / energy_before)
        image = matrix @ direction
        length = energy / np.where(active, (direction * image).sum(axis=0), 1.0)
        solution += length * direction
        residual -= length * image
        energy_before = np.where(active, energy, 1.0)
    return solution


def _relative_residual(matrix: csr_matrix, solution: np.ndarray, right: np.ndarray) -> float:
    """Largest |b - A x| / |b| of the channels. As A >= I, it bounds the error |x - x*| / |b|."""
    sizes = np.linalg.norm(right, axis=0)
    residuals = np.linalg.norm(right - matrix @ solution, axis=0)
    return float(np.max(residuals / np.where(sizes > 0, sizes, 1.0)))


def wls(source: np.ndarray, guide: np.ndarray, lam: float = 0.2, alpha: float = 1.8, eps: float = 1e-4) -> np.ndarray:
    """Minimise sum (u - f)^2 + lam sum (u_p - u_q)^2 / (|l_p - l_q|^alpha + eps), p, q neighbours, l = ln(guide + 1).

    Sparse direct solution in float64 up to 600 000 pixels, above that conjugate gradients to a relative residual of
    1e-10. The residual is logged and checked. Linear in the source, within its range; constants stay exactly.

    Args:
        source: (H, W) or (H, W, C), any real dtype and range.
        guide: (H, W) luminance, at least 0; 0..255 expected, as one grey level is added before the logarithm.
        lam, alpha, eps: see `WlsParameters`.

    Returns:
        Shape of the source; its dtype for floats, float32 for integers.

    Raises:
        InputError: shapes that do not fit, empty arrays, NaN or infinite values, a negative guide.
        SettingsError: a parameter outside its range.
        MedColorError: the residual stayed above 1e-7.
    """
    parameters = WlsParameters(lam, alpha, eps)
    planes, guide64 = float64_pair(source, guide)
    if guide64.min() < 0:
        raise InputError(f"guide: expected luminance of at least 0 (its logarithm is taken), got {guide64.min():g}")
    matrix = _system(guide64, parameters)
    mean = planes.mean(axis=(0, 1))
    right = (planes - mean).reshape(-1, planes.shape[2])  # rows sum to 1: the mean passes unchanged
    direct = guide64.size <= DIRECT_PIXELS
    solution = _factor(matrix).solve(right) if direct else _conjugate_gradients(matrix, right, guide64.shape)
    residual = _relative_residual(matrix, solution, right)
    _LOG.debug("WLS: %d pixels, %s, relative residual %.1e", guide64.size, "direct" if direct else "tiles", residual)
    if not residual <= _RESIDUAL_ALLOWED:
        raise MedColorError(
            f"WLS: the solution's relative residual is {residual:.1e}, above {_RESIDUAL_ALLOWED:g}; use a smaller lam "
            f"or a larger eps (now {parameters.lam:g} and {parameters.eps:g}), or another smoother"
        )
    result = in_range_of(solution.reshape(planes.shape) + mean, planes)
    return result.reshape(np.shape(source)).astype(output_dtype(source))


def smooth(source: np.ndarray, guide: np.ndarray, parameters: WlsParameters | None = None) -> np.ndarray:
    """`wls` with the signature of FILTERS: source (H, W, C), guide (H, W) in 0..255 -> like source."""
    parameters = WlsParameters() if parameters is None else parameters
    require_parameters(parameters, WlsParameters)
    return wls(source, guide, parameters.lam, parameters.alpha, parameters.eps)
