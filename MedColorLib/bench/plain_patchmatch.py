"""PatchMatch as Deep Image Analogy uses it (Barnes et al. 2009; Liao et al. 2017, section 4.3), written out: slow and clear.

Independent of `matching.fields`, in NumPy, position by position in scan order, for comparison and as an oracle on tiny maps.
A position takes over its left and upper neighbours' matches moved by one (right and lower ones on the way back), then tries
chance positions around its best match in a window that is halved until it is a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

_FORWARD, _BACKWARD = 1, -1


class PatchDistance:
    """The paper's distance of two patches: mean over the patch of |F(p + o) - G(q + o)|^2.

    The features of both layers' maps (F_A with F_A', F_B' with F_B) stand in one vector, so that their two terms are one.
    Off either map the features count as having nothing in common: |F|^2 + |G|^2.
    """

    def __init__(self, target: np.ndarray, reference: np.ndarray, radius: int) -> None:
        """Args: target: (C, h, w), reference: (C, h2, w2), all positions of one length. radius: of the patch."""
        self.side = 2 * radius + 1
        self.shape, self.shape2 = target.shape[1:], reference.shape[1:]
        self._here, self._there = (_padded(values, radius) for values in (target, reference))
        self._on_here, self._on_there = (
            _padded(np.ones((1, *shape)), radius)[..., 0] > 0 for shape in (self.shape, self.shape2)
        )
        self._apart = 2 * float((target.astype(np.float64) ** 2).sum(0).max())

    def __call__(self, p: tuple[int, int], q: tuple[int, int]) -> float:
        """Distance of the patch around p in the target to the one around q in the reference."""
        here, there = (np.s_[row : row + self.side, col : col + self.side] for row, col in (p, q))
        squared = ((self._here[here] - self._there[there]) ** 2).sum(-1)
        return float(np.where(self._on_here[here] & self._on_there[there], squared, self._apart).mean())


def _padded(values: np.ndarray, radius: int) -> np.ndarray:
    """(C, h, w) -> (h + 2 radius, w + 2 radius, C) float64 with zeros around."""
    return np.pad(np.moveaxis(np.asarray(values, np.float64), 0, -1), ((radius,) * 2, (radius,) * 2, (0, 0)))


def plain_patchmatch(
    target: np.ndarray,
    reference: np.ndarray,
    start: np.ndarray,
    radius: int,
    search_radius: int,
    iterations: int,
    seed: int = 0,
    allowed: np.ndarray | None = None,
) -> np.ndarray:
    """Improve a nearest-neighbour field from target to reference.

    Args:
        target: (C, h, w), reference: (C, h2, w2) features, all positions of one length.
        start: (h, w) flat row-major indices into the reference's map.
        radius: of the patch. search_radius: half side of the first window of chance.
        allowed: (h2, w2) bool, where a match may lie; None: everywhere. A start that is not allowed is left at the first
            candidate that is.

    Returns:
        (h, w) int64; no position is worse than its start where that was allowed.
    """
    distance = PatchDistance(target, reference, radius)
    allowed = np.ones(distance.shape2, bool) if allowed is None else allowed
    rng = np.random.default_rng(seed)
    field = np.stack(np.divmod(np.asarray(start, np.int64), distance.shape2[1]), -1)
    best = np.full(distance.shape, np.inf)
    for p in np.ndindex(distance.shape):
        q = tuple(field[p])
        best[p] = distance(p, q) if allowed[q] else np.inf
    for iteration in range(iterations):
        way = _BACKWARD if iteration % 2 else _FORWARD
        for p in list(np.ndindex(distance.shape))[::way]:
            for q in (*_propagated(field, p, way), *_chances(field[p], search_radius, distance.shape2, rng)):
                if _inside(q, distance.shape2) and allowed[q]:
                    found = distance(p, q)
                    if found < best[p]:
                        best[p], field[p] = found, q
    return field[..., 0] * distance.shape2[1] + field[..., 1]


def _propagated(field: np.ndarray, p: tuple[int, int], way: int) -> Iterator[tuple[int, int]]:
    """The matches of the two neighbours already visited, moved by one."""
    for dy, dx in ((way, 0), (0, way)):
        neighbour = p[0] - dy, p[1] - dx
        if _inside(neighbour, field.shape[:2]):
            yield int(field[neighbour][0]) + dy, int(field[neighbour][1]) + dx


def _chances(centre: np.ndarray, search_radius: int, shape2, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
    """Chance positions around the match at the beginning, in windows halved down to one pixel."""
    radius = search_radius
    row, col = (int(v) for v in centre)
    while radius >= 1:
        dy, dx = (int(v) for v in rng.integers(-radius, radius + 1, 2))
        yield min(max(row + dy, 0), shape2[0] - 1), min(max(col + dx, 0), shape2[1] - 1)
        radius //= 2


def _inside(p: tuple[int, int], shape) -> bool:
    return 0 <= p[0] < shape[0] and 0 <= p[1] < shape[1]
