"""The head as scanners show it: CT and MR of one anatomy."""

from __future__ import annotations

import numpy as np

from ..volume import Volume
from .head import SKIN_MM, anatomy, anatomy_and_depth, coordinates
from .noise import grain
from .space import SIZE_MM
from .tissues import NUMBER, TISSUES

SHAPE = (48, 128, 112)
_NOISE = {"ct": 7, "mr": 10}


def labels(shape: tuple[int, int, int] = SHAPE) -> np.ndarray:
    """(k, j, i) uint8 indices into TISSUES; k from the feet up, j from front to back, i from right to left.

    The truth of `sample`, at the middle of each voxel; any shape covers the same head.
    """
    return anatomy(*coordinates(shape))


def scan(modality: str, seed: int = 0, shape: tuple[int, int, int] = SHAPE) -> Volume:
    """CT in HU (int16) or T1-like MR (uint16): each voxel blurred with its neighbours, and noise."""
    up, back, left = coordinates(shape)
    step_mm = [2 * size / (n - 1) for size, n in zip(SIZE_MM, shape)]
    quarter = np.float32(step_mm[0] / 4)
    halves = np.stack([up - quarter, up + quarter], 1).ravel()  # a slice is as thick as it is far from the next
    tissues, depth_mm = anatomy_and_depth(halves, back, left)
    table = np.array([tissue[{"ct": 0, "mr": 1}[modality]] for tissue in TISSUES.values()], np.float32)
    body = _with_even_skin(table[tissues], tissues, depth_mm, step_mm, table)
    body = _blurred(_blurred(_of_two(_blurred(body, 0)), 1), 2)
    air, cover = table[NUMBER["air"]], _of_two(_share(depth_mm, step_mm[2]))
    values = air + cover * (body - air)  # voxels that skin fills in part have their share of it: no terraces
    values = np.rint(values + _NOISE[modality] * grain(shape, seed + 1))
    array = values.astype(np.int16) if modality == "ct" else np.maximum(values, 0).astype(np.uint16)
    ijk_to_ras = np.diag([-step_mm[2], -step_mm[1], step_mm[0], 1.0])
    ijk_to_ras[:3, 3] = (SIZE_MM[2], SIZE_MM[1], -SIZE_MM[0])
    return Volume(array, ijk_to_ras, name=f"phantom {modality.upper()}")


def _with_even_skin(values: np.ndarray, tissues: np.ndarray, depth_mm: np.ndarray, step_mm: list, table: np.ndarray):
    """Skin passes into the fat below it within a voxel, and goes on beyond the surface, so that blurring draws no air in."""
    skin, fat = (table[NUMBER[name]] for name in ("skin", "fat"))
    near = (depth_mm > -3 * step_mm[2]) & (depth_mm < SKIN_MM + step_mm[2])
    near &= (tissues == NUMBER["skin"]) | (tissues == NUMBER["fat"]) | (depth_mm <= 0)
    values[near] = skin + _share(depth_mm[near] - np.float32(SKIN_MM), step_mm[2]) * (fat - skin)
    return values


def _share(depth_mm: np.ndarray, step_mm: float) -> np.ndarray:
    return np.clip(depth_mm / np.float32(step_mm) + np.float32(0.5), 0, 1)


def _of_two(values: np.ndarray) -> np.ndarray:
    return (values[::2] + values[1::2]) / 2


def _blurred(values: np.ndarray, axis: int) -> np.ndarray:
    """Mean with both neighbours along an axis, of weights 1/6, 4/6 and 1/6."""
    lines = np.moveaxis(values, axis, 0)
    out = 4 * lines
    out[1:] += lines[:-1]
    out[:-1] += lines[1:]
    out[0] += lines[0]
    out[-1] += lines[-1]
    return np.moveaxis(out / 6, 0, axis)
