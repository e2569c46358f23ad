"""Luminance as alpha, and a surface that interpolation does not darken."""

from __future__ import annotations

from itertools import product

import numpy as np

from .presets import ALPHA_AIR, LUMINANCE_WEIGHTS

# Air around the voxels, in voxels: room for the colour that goes on into it, then alpha 0, so that alpha's range
# starts at 0 and no surface ends at the border of the texture.
MARGIN = 3
_RAMP = 3  # voxels from air on in which tissue may be mixed with air
_ROUNDS = 3  # a layer's voxels that are so far from the next one take its colour
_AT_A_TIME = 1 << 14  # voxels
_SAME_HUE = 0.9  # cosine between colours (R, G, B): what is mixed with air gets darker and stays of its hue


def surface_rgba(rgb: np.ndarray) -> np.ndarray:
    """RGB (k, j, i, 3) uint8 to RGBA (k + 6, j + 6, i + 6, 4): a margin of air, luminance as alpha, no dark rim.

    Colours are changed only in air and in voxels that touch air; alpha only there, too.
    """
    inner = slice(MARGIN, -MARGIN)
    rgba = np.zeros((*(n + 2 * MARGIN for n in rgb.shape[:3]), 4), dtype=np.uint8)
    rgba[inner, inner, inner, :3] = rgb
    for plane in rgba:
        plane[..., 3] = luminance_alpha(plane)
    _dress(rgba)
    return rgba


def _same_hue(dark: np.ndarray, bright: np.ndarray) -> np.ndarray:
    """(n,) bool, whether colours (n, 3) uint8 point about the same way."""
    a, b = dark.astype(np.float32), bright.astype(np.float32)
    dot, aa, bb = (np.einsum("nc,nc->n", x, y) for x, y in ((a, b), (a, a), (b, b)))
    return dot * dot >= np.float32(_SAME_HUE**2) * aa * bb


def luminance_alpha(rgb: np.ndarray) -> np.ndarray:
    """Luminance 0.30 R + 0.59 G + 0.11 B of uint8 (..., 3 or 4), truncated to uint8 as vtkImageLuminance does.

    Slicer passes a three-component volume through that filter to get alpha. Each partial sum is rounded to float32, as
    there: white is 255, and all bytes are the same.
    """
    luminance = np.zeros(rgb.shape[:-1], dtype=np.float32)
    for channel, weight in enumerate(LUMINANCE_WEIGHTS):
        luminance = (luminance + np.float64(weight) * rgb[..., channel]).astype(np.float32)
    return luminance.astype(np.uint8)


def _dilated(mask: np.ndarray) -> np.ndarray:
    """Mask (k, j, i) grown by one voxel in all 26 directions."""
    import cv2

    square = np.ones((3, 3), dtype=np.uint8)
    planes = np.stack([cv2.dilate(plane, square) for plane in mask.view(np.uint8)]).view(bool)
    grown = planes.copy()
    grown[1:] |= planes[:-1]
    grown[:-1] |= planes[1:]
    return grown


def _dress(rgba: np.ndarray) -> None:
    """Continue the tissue's colour into the air around it and soften the step in alpha between them, in place.

    Linear interpolation mixes the colour of air into the outer half voxel, and the first samples that a ray meets are
    taken there: without this every surface has a dark rim. The same mixing happened already in the scan: a voxel half
    filled by air is dark, and a skin of such voxels shows dark terraces where the surface passes from one to the next. So
    voxels near air also take the colour of their inner neighbours, layer by layer, where that is brighter.
    Alpha ends in a step where a mask cut the body out; on a step, shading shows each voxel as a stair.
    """
    alpha = rgba[..., 3]
    tissue = alpha > ALPHA_AIR
    near_air = _dilated(~tissue)
    core = tissue & ~near_air
    deep = [core]
    for _ in range(_RAMP - 1):
        deep.append(deep[-1] & ~_dilated(~deep[-1]))
    for inner, outer in zip(deep[::-1], [*deep[-2::-1], tissue]):  # from the inside outwards
        _brighten(rgba, inner, outer)
    reached = _dilated(tissue)
    air = reached & ~tissue
    _take_colour(rgba, np.flatnonzero(air), tissue)
    _take_colour(rgba, np.flatnonzero(_dilated(reached) & ~reached), reached)
    alpha *= reached
    # What is too thin to have a core would fade away.
    _soften_alpha(rgba, np.flatnonzero(air | (tissue & near_air & _dilated(core))))


def _brighten(rgba: np.ndarray, inner: np.ndarray, outer: np.ndarray) -> None:
    """Give the voxels of `outer` that are not in `inner` the colour that lies behind them, where it is brighter, in place.

    Round a bend a layer is more than a voxel thick: what touches nothing of `inner` takes from what has taken.
    """
    known, targets = inner.copy(), np.flatnonzero(outer & ~inner)
    for _ in range(_ROUNDS):
        found = _take_colour(rgba, targets, known, only_if_brighter=True)
        known.reshape(-1)[targets[found]] = True
        targets = targets[~found]


def _soften_alpha(rgba: np.ndarray, targets: np.ndarray) -> None:
    """Replace alpha of the voxels `targets` (flat indices) by the binomial mean of their surroundings, in place."""
    alpha = rgba.reshape(-1, 4)[:, 3]
    total = np.zeros(targets.size, dtype=np.float32)
    for n in range(0, targets.size, _AT_A_TIME):
        part = slice(n, n + _AT_A_TIME)
        for offset, weight in _neighbourhood(rgba.shape[:3]):
            total[part] += weight * alpha[targets[part] + offset]
    alpha[targets] = np.rint(total).astype(np.uint8)


def _neighbourhood(shape: tuple[int, int, int]) -> list[tuple[int, float]]:
    """Flat offset and binomial weight (1 2 1 along each axis, sum 1) of a voxel and its 26 neighbours."""
    _, nj, ni = shape
    return [
        ((dk * nj + dj) * ni + di, 0.5 ** (3 + abs(dk) + abs(dj) + abs(di)))
        for dk, dj, di in product((-1, 0, 1), repeat=3)
    ]


def _take_colour(
    rgba: np.ndarray, targets: np.ndarray, known: np.ndarray, only_if_brighter: bool = False
) -> np.ndarray:
    """Give the voxels `targets` (flat indices, not on the array's border, none of them known) the mean of `known` neighbours.

    Returns which of them have such neighbours, (n,) bool.

    Bright neighbours weigh far more: the dark ones hold more air. Works on the list of targets only, since surfaces are a
    few percent of a volume, and on some at a time, whose sums stay in the processor's cache.
    """
    parts = range(0, targets.size, _AT_A_TIME)
    found = [_take_colour_of(rgba, targets[n : n + _AT_A_TIME], known, only_if_brighter) for n in parts]
    return np.concatenate(found) if found else np.zeros(0, bool)


def _take_colour_of(rgba: np.ndarray, targets: np.ndarray, known: np.ndarray, only_if_brighter: bool) -> np.ndarray:
    colour, voxels = rgba.reshape(-1, 4), rgba.view(np.uint32).reshape(-1)  # a voxel is one number: read at once
    flat_known = known.reshape(-1)
    total = np.zeros((targets.size, 4), dtype=np.float32)
    sum_of_weights = np.zeros(targets.size, dtype=np.float32)
    places = np.empty_like(targets)
    for offset, weight in _neighbourhood(known.shape):
        np.add(targets, offset, out=places)
        neighbour = voxels.take(places).view(np.uint8).reshape(-1, 4)
        share = (neighbour[:, 3] + np.float32(1)) * np.float32(1 / 64)
        share *= share
        share *= share * (flat_known.take(places) * np.float32(weight))
        total += neighbour * share[:, None]
        sum_of_weights += share
    chosen = sum_of_weights > 0
    mean = np.rint(total[chosen, :3] / sum_of_weights[chosen, None]).astype(np.uint8)
    targets = targets[chosen]
    if only_if_brighter:
        own = colour[targets, :3]
        better = (luminance_alpha(mean) > luminance_alpha(own)) & _same_hue(own, mean)
        targets, mean = targets[better], mean[better]
    colour[targets, :3] = mean
    return chosen
