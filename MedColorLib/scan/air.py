"""Stage *body*: what air is in this scan, from the border of its pictures, its padding and its noise.

A split of all values into two classes separates fat from brain as readily as air from tissue. Air is known by other things:
it reaches the border of the picture or what was not measured there, nothing is darker, and it is constant or noise. Where
nothing like that is there, there is no air in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .reduced import Scale, flood_level, measured_scale, raster, reduced

_SIDE = 128  # pixels of the raster on which levels are measured: noise is averaged, skin is still there
_SLICES = 32
_POINTS = 60_000  # of all rasters that levels are taken from
_HU_TISSUE = -400.0  # between foam and sheets (below) and fat (above)
_HU_LUNG = -910.0  # lung that the picture cuts is above, air and foam below
_HU_CLEAR = -200.0
_BRIGHTEST = 0.12  # of the tissue's level: air above it needs the statistics of noise
_STARTS = (99.5, 97, 90, 75)  # percentiles tried as the tissue's level: metal above it, or little tissue amid much air


@dataclass(frozen=True)
class Air:
    """Where air ends and tissue begins; values in the scan's units.

    Attributes:
        scale: what the values mean.
        threshold: above it is no air, on the reduced raster; -inf where there is no air but what is missing.
        edge: above it single voxels beside the body belong to it.
        strong: above it, unlike below, a patch need not be solid to be no noise.
        clear: above it is tissue (or a table) beyond doubt.
        lung: dark regions at the border whose median is above it are no air; None: all are.
        plates: whether a table, a holder or sheets may be in the picture.
        text: for people.
        dim: air is the noise of magnitudes, and ghosts of it are below this; None: it is not.
    """

    scale: Scale
    threshold: float
    edge: float
    strong: float
    clear: float
    lung: float | None
    plates: bool
    text: str
    dim: float | None = None

    @property
    def is_absent(self) -> bool:
        """Whether the body fills all that was measured."""
        return self.threshold == -np.inf


@dataclass(frozen=True)
class _Points:
    """Pixels of the rasters of slices all along the stack, in greys of the scale.

    Attributes:
        level: flood level. grey: averaged grey. voxel: grey of a single voxel there. rim: next to the border or the void.
        void_share: share of pixels with the lowest value of all.
    """

    level: np.ndarray
    grey: np.ndarray
    voxel: np.ndarray
    rim: np.ndarray
    void_share: float


@dataclass(frozen=True)
class _Cluster:
    """Air as found, in greys: its middle, the threshold, the level of tissue above the middle."""

    middle: float
    threshold: float
    tissue: float
    noise: bool


def find_air(array: np.ndarray, pixel_mm: tuple[float, float] = (1.0, 1.0)) -> Air:
    """Find what air is; see the module.

    Args:
        array: (k, j, i) scalars. Read plane by plane.
        pixel_mm: distances between rows and between columns.
    """
    scale, sample = measured_scale(array)
    if scale.low == scale.high:
        return _no_air(scale)
    if _is_hounsfield(sample):
        text = f"CT in Hounsfield units, air below {_HU_TISSUE:g}"
        return Air(scale, _HU_TISSUE, _HU_TISSUE, _HU_TISSUE, _HU_CLEAR, _HU_LUNG, True, text)
    if array.dtype.kind == "f":
        scale, sample = _with_cut(array, scale, sample)
    lowest = float(np.percentile(sample, 0.1, method="lower"))
    constant = np.mean(sample == lowest) > 0.01
    void = scale.grey_of(lowest)
    is_magnitude = sample.min() >= 0 and not constant  # zero means no signal
    points = _points(array, scale, void if constant else None, raster(array.shape, pixel_mm, _SIDE))
    zero = scale.grey_of(0.0) if is_magnitude else void
    found = _noise(points, zero, None if constant else is_magnitude)
    if found is None and is_magnitude and lowest > 0:  # an offset: zero means nothing
        found = _noise(points, void, False, offset=True)
    if found is None and points.void_share >= 0.01:
        tissue = float(np.percentile(points.grey, 75)) - void if points.grey.size else 1.0
        found = _Cluster(void, void + 0.02 * tissue, tissue, False)
    if found is None:
        return _no_air(scale)
    air = _as_air(scale, found, points, sample, lowest)
    return replace(air, dim=air.edge) if sample.min() >= 0 and not air.plates else air


def _no_air(scale: Scale) -> Air:
    rest = "what is not padding or cut out" if scale.missing else "the whole picture"
    text = f"no air found at the border: {rest} is body"
    return Air(scale, -np.inf, -np.inf, -np.inf, -np.inf, None, False, text)


def in_hounsfield(array: np.ndarray) -> bool:
    """Whether the values of a scan (k, j, i) are Hounsfield units."""
    scale, sample = measured_scale(array)
    return scale.low != scale.high and _is_hounsfield(sample)


def _is_hounsfield(sample: np.ndarray) -> bool:
    """Air at -1000 and soft tissue near 0; or, without air, mostly soft tissue with fat below 0, not clipped there."""
    lowest = np.percentile(sample, 0.5)
    if lowest < -1500 or sample.max() > 40_000:
        return False
    size = np.abs(sample)
    soft = np.mean((sample > -200) & (sample < 250))
    if np.mean((sample > -1100) & (sample < -930)) > 0.01 and soft > 0.003 and np.median(size) > 15:
        return True
    clipped = np.mean(sample == sample.min()) >= 0.02
    return bool(lowest < -20 and soft > 0.5 and not clipped and np.percentile(size, 90) > 60)


def _with_cut(array: np.ndarray, scale: Scale, sample: np.ndarray) -> tuple[Scale, np.ndarray]:
    """Whether the borders hold one exact value amid the others: a normalised scan was cut out on it."""
    if (sample == np.rint(sample)).all():  # not normalised; noise has few values there
        return scale, sample
    edges = []
    for plane in array[_some(array)]:
        edges += [plane[0], plane[-1], plane[:, 0], plane[:, -1]]
    edge = np.concatenate([np.asarray(e, np.float64) for e in edges])
    edge = edge[np.isfinite(edge)]
    if not edge.size:
        return scale, sample
    values, counts = np.unique(edge, return_counts=True)
    value = float(values[counts.argmax()])
    if counts.max() < 0.5 * edge.size or np.mean(sample < value) < 0.02:
        return scale, sample
    rest = sample[sample != value]
    low, high = 2 * np.percentile(rest / 2, (0.5, 99.5))
    return (replace(scale, low=float(low), high=float(high), cut=value), rest) if low < high else (scale, sample)


def _some(array: np.ndarray) -> slice:
    """Slices all along the stack."""
    step = max(1, len(array) // _SLICES)
    return slice(step // 2 if len(array) > step else 0, None, step)


def _points(array: np.ndarray, scale: Scale, void: float | None, size: tuple[int, int]) -> _Points:
    import cv2

    levels, greys, voxels, rims, voids, total = [], [], [], [], 0, 0
    for plane in array[_some(array)]:
        grey, missing = reduced(plane, scale, size, 0.8)
        measured = np.ones(grey.shape, bool) if missing is None else ~missing
        empty = measured & (grey <= void + 2e-4) if void is not None else np.zeros(grey.shape, bool)
        near_void = cv2.dilate(empty.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0  # partial volume
        kept = measured & ~near_void
        inner = cv2.erode(
            kept.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
        )
        rows, cols = (((np.arange(n) + 0.5) * size / n).astype(int) for n, size in zip(grey.shape, plane.shape))
        levels.append(flood_level(grey, missing)[kept])
        greys.append(grey[kept])
        voxels.append(np.nan_to_num(scale.grey(plane[np.ix_(rows, cols)])[kept]))
        rims.append(inner[kept] == 0)
        voids, total = voids + np.count_nonzero(empty), total + np.count_nonzero(measured)
    step = -(-sum(level.size for level in levels) // _POINTS) or 1
    parts = (np.concatenate(part)[::step] for part in (levels, greys, voxels, rims))
    return _Points(*parts, void_share=voids / max(total, 1))


def _noise(points: _Points, zero: float, is_magnitude: bool | None, offset: bool = False) -> _Cluster | None:
    """The darkest cluster of flood levels that is air."""
    if points.level.size < 50:
        return None
    found = []
    for percentile in _STARTS:
        cluster = _darkest(points, zero, float(np.percentile(points.grey, percentile)) - zero)
        if cluster is not None and _is_air(points, cluster, zero, is_magnitude, offset):
            found.append(cluster)
    return min(found, key=lambda cluster: cluster.middle) if found else None


def _darkest(points: _Points, zero: float, tissue: float) -> _Cluster | None:
    """Median and spread of the darkest flood levels, until the threshold that follows from them selects themselves."""
    chosen = points.level[points.level <= zero + 0.35 * tissue]
    if chosen.size < max(10, 0.01 * points.level.size):
        return None
    middle = half_sample_mode(chosen)
    spread = 1.4826 * float(np.median(np.abs(chosen - middle)))
    for _ in range(15):
        body = points.grey[points.level > middle + max(6 * spread, 0.012 * tissue)]
        if body.size >= 20:
            tissue = float(np.percentile(body, 75)) - middle
        # six sigma of the averaged noise; not above a tenth of tissue, unless the noise itself is
        threshold = middle + min(max(6 * spread, 0.03 * tissue), max(0.1 * tissue, 2.5 * spread))
        chosen = points.level[points.level <= threshold]
        if chosen.size < 10:
            return None
        before = middle, spread
        middle = float(np.median(chosen))
        spread = 1.4826 * float(np.median(np.abs(chosen - middle)))
        if before == (middle, spread):
            break
    return _Cluster(middle, threshold, tissue, True) if tissue > 3 * spread else None


def _is_air(points: _Points, cluster: _Cluster, zero: float, is_magnitude: bool | None, offset: bool) -> bool:
    """Air reaches the border, and is next to nothing beside tissue, or noise.

    Args:
        zero: the lowest grey that there is, or that of no signal.
        is_magnitude: whether noise lies above zero (MR), else it lies around its middle; None where zero is a constant
            background: what is brighter than that and noisy may be fat in a narrow window.
        offset: whether `zero` is the darkest voxel of magnitudes, which may be tissue: then it has to be noise.
    """
    air = points.level <= cluster.threshold
    if not points.rim.any() or air[points.rim].mean() < 0.05 or air.mean() < 0.02:
        return False
    level = (cluster.middle - zero) / cluster.tissue
    if level <= _BRIGHTEST and not offset:
        return True
    voxels = points.voxel[air] - zero
    spread = max(float(voxels.std()), 1e-9)
    distance = float(voxels.mean()) / spread  # from zero: 1.91 for one coil; 3.1 from the darkest voxel in a thousand
    white = spread / max(float(points.grey[air].std()), 1e-9)  # averaging lowers noise, not structure
    expected = 1.4 < distance < 2.6 if is_magnitude else distance < 4
    return is_magnitude is not None and level < (_BRIGHTEST if offset else 0.4) and white > 1.6 and expected


def half_sample_mode(values: np.ndarray) -> float:
    """Mode of (n,) numbers: the densest half, again and again (Bickel and Fruehwirth 2006)."""
    values = np.sort(values[:: max(1, values.size // 20_000)])
    while values.size > 8:
        half = values.size // 2 + 1
        start = int(np.argmin(values[half - 1 :] - values[: values.size - half + 1]))
        if half == values.size:
            break
        values = values[start : start + half]
    return float(np.median(values))


def _as_air(scale: Scale, found: _Cluster, points: _Points, sample: np.ndarray, lowest: float) -> Air:
    tissue = np.sort(points.voxel[points.level > found.threshold]) - found.middle
    clipped = not found.noise and lowest == 0 and np.mean(sample == sample.max()) > 0.003
    soft = None if clipped else _soft_tissue(tissue, bool(np.mean(sample == sample.max()) > 0.003))
    if soft is not None and found.threshold < found.middle + 0.5 * soft:
        threshold = scale.value(found.middle + 0.55 * soft)
        clear = scale.value(found.middle + 0.8 * soft)
        return Air(scale, threshold, threshold, threshold, clear, None, True, f"CT, air below {threshold:.4g}")
    threshold = scale.value(found.threshold)
    edge, strong = (scale.value(max(found.threshold, found.middle + share * found.tissue)) for share in (0.25, 0.1))
    clear = scale.value(found.middle + max(2 * (found.threshold - found.middle), 0.2 * found.tissue))
    if not found.noise:  # an exact background: a pixel is tissue where half of its voxels are something else
        scale = replace(scale, cut=lowest, missing=True)
    kind = "noise around" if found.noise else "the constant"
    text = f"air is {kind} {scale.value(found.middle):.4g}, tissue above {threshold:.4g}"
    return Air(scale, threshold, edge, strong, clear, None, not found.noise, text)


def _soft_tissue(tissue: np.ndarray, is_clipped: bool) -> float | None:
    """The level of soft tissue above air if this is a CT in other units: half of the body within a few per cent of it.

    Muscle, organs and fat lie within 0.9 to 1.06 of the way from air to water, next to nothing between them and lung, and
    bone far above (or clipped). No magnitude MR is like that.

    Args:
        tissue: (n,) greys above air, ascending. is_clipped: whether the highest value is a clipped one.
    """
    if tissue.size < 200:
        return None
    centres = np.quantile(tissue, np.linspace(0.05, 0.98, 120))
    centres = centres[centres > 0]
    if not centres.size:
        return None
    counts = np.searchsorted(tissue, 1.08 * centres) - np.searchsorted(tissue, 0.92 * centres)
    soft = float(centres[counts.argmax()])
    narrow = counts.max() / max(np.count_nonzero(tissue >= 0.35 * soft), 1)
    between = np.mean((tissue > 0.35 * soft) & (tissue < 0.75 * soft))
    bone = np.mean(tissue > 1.4 * soft)
    return soft if narrow >= 0.5 and between <= 0.1 and (bone >= 0.005 or is_clipped) else None
