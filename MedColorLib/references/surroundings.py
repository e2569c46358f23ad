"""What lies round the tissue in a photograph: gelatin, paper, cloth, a table, found from the border inwards.

Colours at the border come in a few clusters. A cluster of a hue that no tissue has (blue, green, violet) or of none (grey,
black, white) is surroundings wherever it reaches the border. One that could be tissue (cream or red-brown gelatin, wood) is
so only where it goes round the picture and a compact body is left inside. From such seeds the surroundings grow to what looks
like them and is joined to them; a graph cut (GrabCut) draws the outline along edges. A block of gelatin on a tray is
peeled off in a second round.

All arrays have the size of the reduced picture; L*a*b* is that of the picture brought to a usual exposure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BORDER = 0.02  # of the longer side: how deep the border is
LEAST_SEEDS = 0.06  # of the border's pixels; less is not surroundings
LINKED = 14.0  # of L*a*b*: colours of one material, shaded or grained, come in clusters that near to each other
SPREAD = np.array(
    [[2.5, 1.5, 1.5], [20.0, 6.0, 6.0]]
)  # least and most of L*, a*, b* within a cluster; a drawing has none
SMALL_CLUSTER = 0.04  # of the border or the seeds: what two materials mix to where they meet
PEELS = 2


@dataclass(frozen=True)
class Surroundings:
    """What is not tissue because it is, or joins, the picture's surroundings.

    Attributes:
        outside: (h, w) bool. seeds: (h, w) bool, those of its pixels that it was recognised by.
    """

    outside: np.ndarray
    seeds: np.ndarray

    @property
    def found(self) -> bool:
        """False of a picture that tissue fills from edge to edge."""
        return bool(self.outside.any())


@dataclass(frozen=True)
class _Material:
    """How surroundings grow: `reach` from the colours of seeds joins them at once, `limit` is never passed, in deviations.

    `learning`: whether the graph cut may learn the colours anew; not where they could be those of tissue.
    """

    reach: float
    limit: float
    learning: bool


_UNLIKE_TISSUE = _Material(4.0, 9.0, learning=True)
_LIKE_TISSUE = _Material(2.5, 7.0, learning=False)


def of_no_tissue(lab: np.ndarray) -> np.ndarray:
    """Where (..., 3) L*a*b* has a hue that no tissue has: cyan, blue, violet, green; (...) bool."""
    _, a, b = np.moveaxis(lab, -1, 0)
    blue = (b < -3) & (a < -0.8 * b)
    violet = (b < -5) & (a < -2.5 * b)
    green = (a < -5) & (np.hypot(a, b) > 8) & (b < -2.2 * a)
    return blue | violet | green


def without_hue(lab: np.ndarray) -> np.ndarray:
    """Where (..., 3) L*a*b* is grey, black or white; tissue of that kind is not seen at a border."""
    lightness, a, b = np.moveaxis(lab, -1, 0)
    chroma = np.hypot(a, b)
    return (chroma < 5) | ((a < 1.5) & (chroma < 7)) | ((lightness > 90) & (chroma < 12) & (a < 3))


def find_surroundings(lab: np.ndarray) -> Surroundings:
    """Surroundings of the picture (h, w, 3) L*a*b*; nothing where tissue fills it."""
    clear, could_be_tissue = _seeds(lab)
    outside, seeds = np.zeros(clear.shape, bool), clear
    if could_be_tissue.any():
        grown = _grow(lab, clear | could_be_tissue, _LIKE_TISSUE)
        if _holds_a_body(solid(grown)):
            outside, seeds = grown, clear | could_be_tissue
    if not outside.any() and clear.sum() > LEAST_SEEDS * _border_of(clear.shape).sum():
        outside = _grow(lab, clear, _UNLIKE_TISSUE)
        if (of_no_tissue(lab[outside]) | without_hue(lab[outside])).mean() < 0.5:  # it ran into tissue
            outside = _grow(lab, clear, _LIKE_TISSUE)
    for _ in range(PEELS):
        if outside.mean() < 0.05:
            break
        more = _peel(lab, outside)
        if more is None:
            break
        outside, seeds = outside | more.outside, seeds | more.seeds
    return Surroundings(outside, seeds)


def solid(outside: np.ndarray) -> np.ndarray:
    """(h, w) bool: what is left, without cracks, holes and threads."""
    from scipy import ndimage

    return opened(ndimage.binary_fill_holes(closed(~outside, 5)), 5)


def disc(size: int) -> np.ndarray:
    """Structuring element."""
    import cv2

    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))


def dilated(mask: np.ndarray, size: int) -> np.ndarray:
    """Grown by a disc `size` pixels wide."""
    import cv2

    return cv2.dilate(mask.astype(np.uint8), disc(size)) > 0


def eroded(mask: np.ndarray, size: int) -> np.ndarray:
    """Shrunk by a disc `size` pixels wide, but not from the picture's edge."""
    import cv2

    return cv2.erode(mask.astype(np.uint8), disc(size), borderType=cv2.BORDER_CONSTANT, borderValue=1) > 0


def opened(mask: np.ndarray, size: int) -> np.ndarray:
    """Without what is narrower than `size` pixels."""
    import cv2

    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc(size)) > 0


def closed(mask: np.ndarray, size: int) -> np.ndarray:
    """Without gaps narrower than `size` pixels; the picture goes on beyond its edge as it is there."""
    import cv2

    wide = cv2.copyMakeBorder(mask.astype(np.uint8), size, size, size, size, cv2.BORDER_REPLICATE)
    return cv2.morphologyEx(wide, cv2.MORPH_CLOSE, disc(size))[size:-size, size:-size] > 0


def rectangularity(part: np.ndarray) -> tuple[float, float]:
    """How far a part fills the narrowest rectangle round it (an ellipse 0.79), and that one's length over its width."""
    import cv2

    outlines, _ = cv2.findContours(part.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    sides = np.array(cv2.minAreaRect(max(outlines, key=len))[1]) + 1
    return float(np.count_nonzero(part) / sides.prod()), float(sides.max() / sides.min())


def _edges(mask: np.ndarray) -> np.ndarray:
    """The outermost pixels, one after the other."""
    return np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])


def _border_width(shape: tuple[int, int]) -> int:
    return max(2, round(BORDER * max(shape)))


def _border_of(shape: tuple[int, int]) -> np.ndarray:
    """(h, w) bool: the picture's border."""
    width = _border_width(shape)
    border = np.ones(shape, bool)
    border[width:-width, width:-width] = False
    return border


def _clusters(colors: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """k-means of (n, 3): cluster of each, centres."""
    import cv2

    cv2.setRNGSeed(0)
    colors = np.ascontiguousarray(colors, np.float32)
    count = min(most, len(np.unique(colors.round(), axis=0)))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.5)
    _, labels, centres = cv2.kmeans(colors, count, None, stop, 2, cv2.KMEANS_PP_CENTERS)
    return labels.ravel(), centres


def _linked(centres: np.ndarray, first: int, members: list[int]) -> list[int]:
    """Members that are joined to `first` by steps of less than LINKED."""
    group = {first}
    while True:
        new = {
            j
            for j in members
            if j not in group and min(np.linalg.norm(centres[j] - centres[i]) for i in group) < LINKED
        }
        if not new:
            return sorted(group)
        group |= new


def _seeds(lab: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) bool: pixels of the border that are surroundings by their colour, and those that may be tissue as well."""
    shape = lab.shape[:2]
    border = _border_of(shape)
    labels, centres = _clusters(lab[border], 6)
    cluster = np.full(shape, -1)
    cluster[border] = labels
    large = np.bincount(labels, minlength=len(centres)) >= SMALL_CLUSTER * labels.size
    clear = np.flatnonzero((of_no_tissue(centres) | without_hue(centres)) & large)
    seeds = np.isin(cluster, clear)
    seeds &= ~_dark_or_pale_tissue(seeds, lab)
    ring = np.zeros(shape, bool)
    others = [i for i in range(len(centres)) if i not in clear]
    gelatin = np.isin(labels, np.flatnonzero(of_no_tissue(centres))).mean()
    if others and gelatin < 0.25:  # else what is warm at the border is tissue that touches it
        group = _linked(centres, max(others, key=lambda i: np.count_nonzero(labels == i)), others)
        ring = np.isin(cluster, group)
        one_material = set(_linked(centres, group[0], [*group, *clear])) - set(group)
        if not _goes_round(ring | seeds) or (sum(_corners(ring)) < 2 and not one_material):
            ring = np.zeros(shape, bool)
    return seeds, ring


def _dark_or_pale_tissue(seeds: np.ndarray, lab: np.ndarray) -> np.ndarray:
    """Those seeds without hue that are a small stretch of the border and no corner: a vessel, an eye, a bone cut by it."""
    from scipy import ndimage

    labels, count = ndimage.label(seeds, structure=np.ones((3, 3)))
    if not count:
        return seeds
    index = np.arange(count + 1)
    long = ndimage.sum_labels(seeds, labels, index) >= 0.15 * _border_of(seeds.shape).sum()
    blue = ndimage.mean(of_no_tissue(lab), labels, index) >= 0.5
    corner = np.isin(index, [labels[0, 0], labels[0, -1], labels[-1, 0], labels[-1, -1]])
    tissue = ~(long | blue | corner)
    tissue[0] = False
    return tissue[labels]


def _goes_round(seeds: np.ndarray) -> bool:
    """Whether seeds lie along three sides and in three corners."""
    width = _border_width(seeds.shape)
    sides = [edge.mean() for edge in (seeds[:width], seeds[-width:], seeds[:, :width], seeds[:, -width:])]
    return sum(side > 0.4 for side in sides) >= 3 and sum(_corners(seeds)) >= 3


def _corners(seeds: np.ndarray) -> list[bool]:
    """In which of the four corners seeds prevail."""
    width = _border_width(seeds.shape)
    turned = (seeds, seeds[::-1], seeds[:, ::-1], seeds[::-1, ::-1])
    return [(way[:width, : 3 * width].mean() + way[: 3 * width, :width].mean()) / 2 > 0.6 for way in turned]


def _holds_a_body(inside: np.ndarray) -> bool:
    """Whether what lies inside is a body and not what two tissues leave of each other in a picture that they fill."""
    import cv2
    from scipy import ndimage

    labels, count = ndimage.label(inside)
    if not count:
        return False
    sizes = np.bincount(labels.ravel())[1:]
    outlines, _ = cv2.findContours(
        (labels == 1 + sizes.argmax()).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    hull = cv2.contourArea(cv2.convexHull(max(outlines, key=len)))
    share, largest, convex = inside.mean(), sizes.max() / sizes.sum(), sizes.max() / max(hull, 1)
    edge = _edges(inside).mean()
    if share > 0.28:
        return bool(largest > 0.67 and convex > 0.75 and edge < 0.2)
    return bool(share > 0.05 and largest > 0.95 and convex > 0.9 and edge < 0.05)


def distance_to(lab: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """(h, w) of each pixel to the colours of the seeds, in standard deviations of the nearest cluster."""
    colors = lab[seeds]
    labels, centres = _clusters(colors, 5)
    distance = np.full(lab.shape[:2], np.inf, np.float32)
    for i, centre in enumerate(centres):
        own = colors[labels == i]
        if len(own) >= max(8, SMALL_CLUSTER * len(colors)):
            spread = np.clip(own.std(axis=0), *SPREAD)
            distance = np.minimum(distance, np.linalg.norm((lab - centre) / spread, axis=2))
    return distance


def _joined(mask: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The parts of `mask` that hold seeds."""
    from scipy import ndimage

    labels, _ = ndimage.label(mask | seeds)
    found = np.unique(labels[seeds])
    return np.isin(labels, found[found > 0])


def _grow(lab: np.ndarray, seeds: np.ndarray, material: _Material, within: np.ndarray | None = None) -> np.ndarray:
    """(h, w) bool: surroundings that grow from seeds; what is not `within` is surroundings already."""
    import cv2

    within = np.ones(seeds.shape, bool) if within is None else within
    distance = distance_to(lab, seeds)
    near = _joined((distance < material.reach) & within, seeds)
    cut = np.where(near, cv2.GC_PR_BGD, cv2.GC_PR_FGD).astype(np.uint8)
    cut[seeds | ~within] = cv2.GC_BGD
    if np.count_nonzero(cut == cv2.GC_PR_FGD) < 20:
        return near | ~within
    # a* and b* tell materials apart better than L*, which shading changes
    picture = np.clip(lab * np.float32([2.55, 2, 2]) + np.float32([0, 128, 128]), 0, 255).astype(np.uint8)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)
    if material.learning:
        cv2.grabCut(picture, cut, None, *models, 3, cv2.GC_INIT_WITH_MASK)
    else:
        cv2.grabCut(picture, cut, None, *models, 0, cv2.GC_INIT_WITH_MASK)
        cv2.grabCut(picture, cut, None, *models, 1, cv2.GC_EVAL_FREEZE_MODEL)
    outside = (cut == cv2.GC_BGD) | (cut == cv2.GC_PR_BGD)
    # what is as warm as tissue must look the more like the seeds
    warm = (lab[..., 1] > -3) & (lab[..., 2] > 6) & ~without_hue(lab)
    limit = np.where(warm & material.learning, material.reach, material.limit)
    return outside & ((distance < limit) | seeds | ~within)


def _peel(lab: np.ndarray, outside: np.ndarray) -> Surroundings | None:
    """The next layer: gelatin that lies on a tray, paper on a table; None where the next layer is the body itself.

    That it is gelatin is seen by its hue, or, where tissue may have that colour, by its outline: blocks and sheets are
    rectangles, bodies are not.
    """
    from scipy import ndimage

    labels, count = ndimage.label(solid(outside))
    if not count:
        return None
    main = labels == 1 + np.bincount(labels.ravel())[1:].argmax()
    rim, ring = (
        ~eroded(main, 5),
        eroded(main, 5) & ~eroded(main, 13),
    )  # the rim's colours are mixed with what was peeled
    if main.mean() < 0.05 or np.count_nonzero(ring) < 30:
        return None
    names, centres = _clusters(lab[ring], 5)
    share = np.bincount(names, minlength=len(centres)) / names.size
    # what the frame cuts straight is no block
    block = _edges(main).mean() < 0.05 and rectangularity(ndimage.binary_fill_holes(main))[0] > 0.9
    clear = of_no_tissue(centres) | (without_hue(centres) & block)
    chosen = np.flatnonzero(clear)
    if block:
        group = _linked(centres, int(share.argmax()), list(range(len(centres))))
        if share[group].sum() > 0.7:
            chosen = np.union1d(chosen, group)
    if share[chosen].sum() < 0.2:
        return None
    cluster = np.full(outside.shape, -1)
    cluster[ring] = names
    seeds = np.isin(cluster, chosen)
    material = _UNLIKE_TISSUE if clear[chosen].all() else _LIKE_TISSUE
    grown = _grow(lab, seeds, material, within=main) | (main & rim & dilated(seeds, 9))
    left = solid(grown | outside).mean()
    return Surroundings(grown, seeds) if left > 0.03 else None
