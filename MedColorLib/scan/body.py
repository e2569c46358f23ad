"""Stage *body*: which voxels belong to the patient, which slices are empty, where to crop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .intensity import Window, apply_window, strided

_WORK_SIDE = 256  # in-plane pixels at which the outline is found; finer adds noise and time, not outline
_ENDS = (0.5, 99.5)  # percentiles: one bad voxel does not set the scale


@dataclass(frozen=True)
class Body:
    """Body mask at reduced resolution and what follows from it.

    Attributes:
        coarse: (k, h, w) bool at reduced in-plane resolution.
        shape: (k, j, i) of the volume.
        threshold: value that separates air from tissue.
        boxes: (k, 4) int, [j0, j1, i0, i1) per slice in full pixels; all zero where the slice is empty.
    """

    coarse: np.ndarray
    shape: tuple[int, int, int]
    threshold: float
    boxes: np.ndarray

    @property
    def slices(self) -> np.ndarray:
        """Indices k of slices that hold body."""
        return np.flatnonzero(self.boxes[:, 1] > self.boxes[:, 0])

    def plane(self, k: int) -> np.ndarray:
        """(j, i) float32 0..1: coverage by the body, smooth at the outline; 0.5 is the outline."""
        import cv2

        _, rows, cols = self.shape
        return cv2.resize(self.coarse[k].astype(np.float32), (cols, rows), interpolation=cv2.INTER_LINEAR)

    def painted(self, k: int, values: np.ndarray) -> np.ndarray:
        """(j, i) bool: where slice k is coloured: its body, and tissue within a coarse pixel or a slice of it.

        The outline is found on a coarse raster; rendered as it is, skin would show its steps. Voxels around it that are
        above the threshold belong to the body, too.

        Args:
            values: (j, i) of the slice.
        """
        import cv2

        near = self.coarse[max(k - 1, 0) : k + 2].any(axis=0).astype(np.uint8)
        wide = cv2.dilate(near, np.ones((3, 3), np.uint8)).astype(np.float32)
        _, rows, cols = self.shape
        rim = cv2.resize(wide, (cols, rows), interpolation=cv2.INTER_LINEAR) > 0.5
        return (self.plane(k) > 0.5) | (rim & (values > self.threshold))


def otsu_threshold(values: np.ndarray, bins: int = 512) -> float:
    """Otsu's threshold of 1-D finite values: maximal variance between two classes."""
    low, high = float(values.min()), float(values.max())
    counts, edges = np.histogram(values, bins=bins, range=(low, high))
    centres = (edges[:-1] + edges[1:]) / 2
    weight = np.cumsum(counts).astype(np.float64)
    moment = np.cumsum(counts * (centres - low))
    rest = weight[-1] - weight
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (moment[-1] * weight / weight[-1] - moment) ** 2 / (weight * rest)
    between = np.nan_to_num(between, nan=0.0, posinf=0.0)
    best = np.flatnonzero(between >= between.max() * (1 - 1e-12))
    return float(edges[1 + int(best.mean())])  # the middle of a plateau: empty bins between two classes tie


def find_body(array: np.ndarray) -> Body:
    """Outline the patient: Otsu between air and tissue, largest connected part, holes filled slice by slice.

    The table, foam, skin markers and noise are left out: they are fainter than tissue or not connected to it. Air inside
    the outline (lungs, sinuses) counts as body, so that it is not mistaken for background; it stays black by its
    luminance.

    Args:
        array: (k, j, i) scalars, rows and columns in the transverse plane.

    Raises:
        InputError: nothing stands out of the background.
    """
    from scipy import ndimage

    sample = strided(array)
    for highest in (_ENDS[1], 98.0, 95.0):  # metal of 1 or 2 % of the voxels hides the patient from the first
        measured = _measured_range(array, sample, highest)
        level = otsu_threshold(_normalised(sample, measured))
        coarse = _largest_parts(_opened(_coarse_mask(array, measured, level)))
        if coarse.any():
            break
    else:
        raise InputError("body: nothing stands out of the background; check the volume or give a window")
    radius = max(1, round(max(coarse.shape[1:]) / 64))
    for k in range(len(coarse)):
        if coarse[k].any():
            coarse[k] = _filled(coarse[k], radius, ndimage)
    threshold = measured.window.low * (1 - level) + measured.window.high * level
    return Body(coarse, array.shape, threshold, _boxes(coarse, array.shape))


@dataclass(frozen=True)
class _Measured:
    """Robust ends of what the scanner measured, the value below which nothing was, and what stands for it (0 = low)."""

    window: Window
    floor: float
    missing_as: float


def _measured_range(array: np.ndarray, sample: np.ndarray, highest: float) -> _Measured:
    """Tell padding from measurement, by a sample of the values.

    Scanners fill what lies outside their round field of view with one value far below the rest (-2000, -3024, -32768),
    and exports with NaN. Between padding and air, Otsu would find a circle. Where the values next to the missing ones are
    air, the missing ones are air, too; where they are not, the missing ones are the only air there is.
    """
    halves = sample[np.isfinite(sample)] / 2  # the difference of extremes stays finite
    floor = halves.min()
    above = halves[halves > floor]
    if above.size and above.min() - floor > 0.2 * np.ptp(np.percentile(above, _ENDS)) > 0:
        halves, floor = above, above.min()
    low, high = np.percentile(halves, (_ENDS[0], highest))
    if low == high:
        low, high = halves.min(), halves.max()
    window, floor = Window(2 * float(low), 2 * float(high), "robust ends"), 2 * float(floor)
    return _Measured(window, floor, 0.0 if _air_next_to_missing(array, floor, window) else -0.5)


def _air_next_to_missing(array: np.ndarray, floor: float, window: Window) -> bool:
    """Whether most pixels at the rim of what is missing are dark; True where there is no rim."""
    import cv2

    rim_size = dark = 0
    for plane in array[:: max(1, len(array) // 24)]:
        missing = (~(plane >= floor)).astype(np.uint8)
        near, far = (cv2.dilate(missing, np.ones((side, side), np.uint8)) for side in (3, 7))
        rim = (far > 0) & (near == 0)  # the first pixel may be half missing
        rim_size += np.count_nonzero(rim)
        dark += np.count_nonzero(apply_window(plane[rim], window) < 0.1)
    return dark >= 0.5 * rim_size


def _normalised(values: np.ndarray, measured: _Measured) -> np.ndarray:
    """Low to high as 0..1 (float32 holds it, whatever the units); what was not measured as `missing_as`."""
    grey = apply_window(values, measured.window)
    grey[~(values >= measured.floor)] = measured.missing_as
    return grey


def _coarse_mask(array: np.ndarray, measured: _Measured, level: float) -> np.ndarray:
    """(k, h, w) bool: normalised values above `level`, on the reduced raster."""
    import cv2

    rows, cols = array.shape[1:]
    scale = min(1.0, _WORK_SIDE / max(rows, cols))
    size = (max(1, round(cols * scale)), max(1, round(rows * scale)))
    out = np.empty((len(array), size[1], size[0]), bool)
    for k, plane in enumerate(array):
        values = _normalised(plane, measured)
        values = cv2.resize(values, size, interpolation=cv2.INTER_AREA) if scale < 1 else values
        out[k] = cv2.GaussianBlur(values, (0, 0), 0.7) > level  # single noisy pixels do not make outline
    return out


def _opened(mask: np.ndarray) -> np.ndarray:
    """Cut thin bridges (head holder, sheets, lines) off; kept as it is where that would leave nothing."""
    import cv2

    side = 2 * max(1, round(max(mask.shape[1:]) / 128)) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    opened = np.empty_like(mask)
    for k, plane in enumerate(mask):
        opened[k] = cv2.morphologyEx(plane.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
    return opened if opened.any() else mask


def _largest_parts(mask: np.ndarray, fraction: float = 0.1) -> np.ndarray:
    """The largest 3-D connected part, and others (arms) of at least `fraction` of its size.

    Parts are labelled plane by plane and joined where neighbouring planes overlap: labels of a whole stack would take
    more memory than the volume.
    """
    from scipy import ndimage, sparse

    sizes, links, first = [], [], 0  # of the parts of planes; links: pairs of parts that overlap, by number
    below, below_first = np.zeros(mask.shape[1:], np.int32), 0
    for plane in mask:
        labels, count = ndimage.label(plane)
        sizes.append(np.bincount(labels.ravel(), minlength=count + 1)[1:])
        links.append(_overlaps(below, labels) + np.array([[below_first - 1], [first - 1]]))
        below, below_first, first = labels, first, first + count
    if first <= 1:
        return mask
    low, high = np.concatenate(links, axis=1)
    graph = sparse.coo_matrix((np.ones(low.size, bool), (low, high)), (first, first))
    _, part = sparse.csgraph.connected_components(graph, directed=False)
    total = np.bincount(part, np.concatenate(sizes))
    large = (total >= fraction * total.max())[part]
    kept, first = np.empty_like(mask), 0
    for k, plane in enumerate(mask):
        labels, count = ndimage.label(plane)
        kept[k] = np.concatenate([[False], large[first : first + count]])[labels]
        first += count
    return kept


def _overlaps(below: np.ndarray, above: np.ndarray) -> np.ndarray:
    """(2, n) int64: which labels of two planes lie on each other, 0 (nothing) left out."""
    both = (below > 0) & (above > 0)
    pairs = np.stack([below[both], above[both]]).astype(np.int64)
    if pairs.shape[1]:
        pairs = pairs[:, np.diff(pairs, axis=1, prepend=0).any(axis=0)]  # once for a run along a row
    return np.unique(pairs, axis=1)


def _filled(plane: np.ndarray, radius: int, ndimage) -> np.ndarray:
    """Close gaps of the outline up to `radius` pixels (nostrils, orbits), fill what is inside."""
    import cv2

    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    padded = np.pad(plane.astype(np.uint8), 2 * radius)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[2 * radius : -2 * radius, 2 * radius : -2 * radius]
    return ndimage.binary_fill_holes(closed > 0)


def _boxes(coarse: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    scale = np.array([shape[1] / coarse.shape[1], shape[2] / coarse.shape[2]])
    boxes = np.zeros((len(coarse), 4), np.int64)
    for k, plane in enumerate(coarse):
        rows, cols = np.flatnonzero(plane.any(1)), np.flatnonzero(plane.any(0))
        if rows.size:
            boxes[k, :2] = np.floor(rows[0] * scale[0]), np.ceil((rows[-1] + 1) * scale[0])
            boxes[k, 2:] = np.floor(cols[0] * scale[1]), np.ceil((cols[-1] + 1) * scale[1])
    return boxes
