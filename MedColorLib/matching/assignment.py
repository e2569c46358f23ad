"""Stage *assignment*: with several references, which one each slice takes.

A series of photographs runs along the body as the slices do, so its order is used: of all assignments that never step back
(in either direction of the series), the one with the highest total similarity, by dynamic programming. A mere set of
references, where order would cost likeness, is assigned freely.
"""

from __future__ import annotations

import numpy as np

SERIES_SIZE = 4  # fewer references have no order worth the name
WORTH = 0.12  # share of what free choice gains that order may cost: noisy series measured 0 to 0.1, shuffled sets 0.12 to 0.4


def assign(similarity: np.ndarray) -> tuple[np.ndarray, str]:
    """Choose a reference for every slice.

    Args:
        similarity: (slices, references), both in the order of their stacks; higher is more alike.

    Returns:
        (slices,) int64 indices of references; "along the series", "against the series" or "freely".
    """
    free = similarity.argmax(axis=1)
    if similarity.shape[1] < SERIES_SIZE or similarity.shape[0] < 2:
        return free, "freely"
    forward, gain = monotone(similarity)
    backward, gain_back = monotone(similarity[:, ::-1])
    backward = similarity.shape[1] - 1 - backward
    ordered, total, name = forward, gain, "along the series"
    if gain_back > gain:
        ordered, total, name = backward, gain_back, "against the series"
    best, any_reference = similarity.max(axis=1).sum(), similarity.mean(axis=1).sum()
    return (ordered, name) if best - total <= WORTH * (best - any_reference) else (free, "freely")


def monotone(similarity: np.ndarray) -> tuple[np.ndarray, float]:
    """The non-decreasing assignment of highest total similarity and that total.

    Dynamic programming: best[i, j] = similarity[i, j] + max over j' <= j of best[i - 1, j']; ties stay low. References at
    either end may stay unused, so series and volume need overlap only in part.
    """
    count, references = similarity.shape
    best = np.empty_like(similarity, dtype=np.float64)
    came_from = np.zeros((count, references), np.int64)
    best[0] = similarity[0]
    for i in range(1, count):
        running = np.maximum.accumulate(best[i - 1])
        rises = np.concatenate([[True], running[1:] > running[:-1]])
        came_from[i] = np.maximum.accumulate(np.where(rises, np.arange(references), 0))
        best[i] = similarity[i] + running
    choice = np.empty(count, np.int64)
    choice[-1] = best[-1].argmax()
    for i in range(count - 1, 0, -1):
        choice[i - 1] = came_from[i, choice[i]]
    return choice, float(best[-1].max())
