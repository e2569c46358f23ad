"""Chance and waves with the same bits on every machine: integer hashes, and sums and products that round alike everywhere.

No sine, exponential or random generator of a library: their last digits depend on processor and version.
"""

from __future__ import annotations

import numpy as np


def hashed(*indices: np.ndarray, seed: int = 0) -> np.ndarray:
    """uint32 that look random, of integer arrays that broadcast against each other."""
    value = np.array([(seed * 0x9E3779B1 + 0x85EBCA6B) & 0xFFFFFFFF], np.uint32)
    for index in indices:
        value = (value ^ np.asarray(index).astype(np.int64).astype(np.uint32)) * np.uint32(0xCC9E2D51)
        value = (value ^ (value >> np.uint32(15))) * np.uint32(0x1B873593)
        value = value ^ (value >> np.uint32(13))
    value = (value ^ (value >> np.uint32(16))) * np.uint32(0x7FEB352D)
    value = (value ^ (value >> np.uint32(15))) * np.uint32(0x846CA68B)
    return value ^ (value >> np.uint32(16))


def grain(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """float32 of that shape, mean 0 and deviation 1: four bytes of a hash added up, which is nearly normal."""
    drawn = hashed(np.arange(int(np.prod(shape))), seed=seed).reshape(shape)
    total = sum(((drawn >> np.uint32(8 * byte)) & np.uint32(255)).astype(np.int32) for byte in range(4))
    return (total - 510).astype(np.float32) / np.float32(147.8)


def lumps(axes: tuple[np.ndarray, ...], cell: float | tuple[float, ...], seed: int = 0) -> np.ndarray:
    """Smooth values of -1..1 on a grid: one value a cell, drawn by hash, and cubic steps between.

    Args:
        axes: float positions along each axis of the grid.
        cell: distance of the values, in the axes' unit; one for each axis or for all.
    """
    cells = cell if isinstance(cell, tuple) else (cell,) * len(axes)
    nodes, steps = [], []
    for axis, size in zip(axes, cells):
        at = axis.astype(np.float32) / np.float32(size)
        floor = np.floor(at)
        part = at - floor
        first = floor.astype(np.int64)
        nodes.append(np.arange(first.min(), first.max() + 2))
        steps.append((first - first.min(), part * part * (3 - 2 * part)))
    values = hashed(*np.ix_(*nodes), seed=seed).astype(np.float32) / np.float32(2**31) - 1
    for axis, (first, step) in enumerate(steps):
        along = step.reshape([-1 if other == axis else 1 for other in range(len(axes))])
        lower = values.take(first, axis)
        values = lower + along * (values.take(first + 1, axis) - lower)
    return values


def sine(turns: np.ndarray) -> np.ndarray:
    """The sine of an angle in turns, to 0.001, by two parabolas."""
    part = turns - np.floor(turns) - np.float32(0.5)
    parabola = part * (16 * np.abs(part) - 8)
    return parabola * (np.float32(0.775) + np.float32(0.225) * np.abs(parabola))


def ripples(
    points: tuple[np.ndarray, np.ndarray, np.ndarray], wavelength_mm: float, seed: int, count: int = 14
) -> np.ndarray:
    """Distance in mm, about, from surfaces that wander through space `wavelength_mm / 2` apart.

    Waves of nearly one length from all directions are added up; where the sum is 0 lies a labyrinth of sheets, as wide
    apart everywhere as the folds of a cortex are.
    """
    drawn = hashed(np.arange(count)[:, None], np.arange(4)[None], seed=seed).astype(np.float64) / 2**32
    height, slope = 0.0, [0.0, 0.0, 0.0]
    for up, around, length, phase in drawn:
        cosine = 2 * up - 1
        flat = np.sqrt(1 - cosine * cosine)
        way = flat * sine(np.float64(around)), flat * sine(np.float64(around + 0.25)), cosine
        rate = [np.float32(part / (wavelength_mm * (0.85 + 0.3 * length))) for part in way]
        turns = sum(r * p for r, p in zip(rate, points)) + np.float32(phase)
        height = height + sine(turns)
        along = sine(turns + np.float32(0.25))
        slope = [s + np.float32(6.2832) * r * along for s, r in zip(slope, rate)]
    steep = slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2]
    floor = np.float32(count / 2 / 3 * (6.2832 / wavelength_mm) ** 2 * 0.35)  # where the sum is flat no sheet is near
    return np.abs(height) / np.sqrt(steep + floor)
