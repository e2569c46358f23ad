"""Stage *intensity*: from scanner values to display grey 0..1, and from one grey distribution to another."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError, SettingsError
from ..progress import check

_SAMPLE_LIMIT = (
    1_000_000  # voxels looked at for percentiles: standard error of the rank 0.01 %, bounded time and memory
)


# In CT fat and muscle are 150 HU apart, bone and air 2000: in a window that shows all, features and the relation of colour and
# grey can hardly tell fat from muscle. These values get at least this share of the greys that both work with.
SOFT_TISSUE_HU, SOFT_TISSUE_SHARE = (-250.0, 400.0), 0.6
FAT_TO_MUSCLE_HU = 150.0


@dataclass(frozen=True)
class Window:
    """Values from `low` (shown black) to `high` (shown white), and where they come from.

    Attributes:
        tones: rising display greys 0..1, and as many tones 0..1: what matching and the relation of colour and grey see instead.
            Empty: the display grey itself.
        hounsfield: whether the values are Hounsfield units.
    """

    low: float
    high: float
    source: str
    tones: tuple[tuple[float, ...], tuple[float, ...]] | tuple[()] = ()
    hounsfield: bool = False

    def describe(self) -> str:
        """One line for the plan."""
        text = f"{self.low:g} to {self.high:g} ({self.source})"
        if self.tones:
            low, high = SOFT_TISSUE_HU
            text += f"; {100 * SOFT_TISSUE_SHARE:.0f} % of the greys that are matched are soft tissue, {low:g} to {high:g} HU"
        return text

    @property
    def coarse_noise(self) -> float:
        """In CT a third of what lies between fat and muscle, in tones: up to there noise is looked for that is coarse; else 0."""
        if not self.hounsfield:
            return 0.0
        low, high = SOFT_TISSUE_HU
        slope = SOFT_TISSUE_SHARE / (high - low) if self.tones else 1 / (self.high - self.low)
        return FAT_TO_MUSCLE_HU / 3 * slope

    def tone(self, grey: np.ndarray) -> np.ndarray:
        """Tones float32 of display grey 0..1."""
        return np.interp(grey, *self.tones).astype(np.float32) if self.tones else grey

    def shown(self, tone: np.ndarray) -> np.ndarray:
        """Display grey float32 of tones 0..1."""
        return np.interp(tone, *self.tones[::-1]).astype(np.float32) if self.tones else tone


AS_SHOWN = Window(0.0, 1.0, "display grey")


def of_hounsfield(window: Window) -> Window:
    """The window of a scan in Hounsfield units: with tones, where soft tissue has too little room in it."""
    window = replace(window, hounsfield=True)
    halves = np.array(SOFT_TISSUE_HU) / 2 - window.low / 2  # the difference of extremes stays finite
    ends = np.clip(halves / (window.high / 2 - window.low / 2), 0, 1)
    share = float(ends[1] - ends[0])
    if not 0 < share < SOFT_TISSUE_SHARE:
        return window
    low = float(ends[0]) * (1 - SOFT_TISSUE_SHARE) / (1 - share)
    knots = np.array([(0, 0), (ends[0], low), (ends[1], low + SOFT_TISSUE_SHARE), (1, 1)])
    knots = knots[np.append(np.diff(knots[:, 0]) > 0, True)]  # where soft tissue reaches an end, the end stands once
    greys, tones = knots.T.tolist()
    return replace(window, tones=(tuple(greys), tuple(tones)))


def strided(array: np.ndarray, limit: int = _SAMPLE_LIMIT, mask: np.ndarray | None = None) -> np.ndarray:
    """Values of at most `limit` evenly strided voxels, float64, 1-D. Deterministic.

    They are taken plane by plane: neither a transposed view nor the voxels inside `mask` (same shape, bool) are copied
    as a whole.
    """
    array = array if hasattr(array, "flags") else np.asarray(array)
    total = array.size if mask is None else int(np.count_nonzero(mask))
    step = -(-total // limit) | 1  # odd: does not stay in the same columns of a row of 2^n
    if array.ndim < 2 or (mask is None and array.flags.c_contiguous):
        return (array if mask is None else array[mask]).reshape(-1)[::step].astype(np.float64)
    sample = np.empty(-(-total // step))
    passed = taken = 0
    for n, plane in enumerate(array):
        flat = plane.reshape(-1) if mask is None else plane[mask[n]]
        values = flat[-passed % step :: step]
        sample[taken : taken + values.size] = values
        passed, taken = passed + flat.size, taken + values.size
    return sample


def finite_sample(array: np.ndarray, limit: int = _SAMPLE_LIMIT, mask: np.ndarray | None = None) -> np.ndarray:
    """The finite ones of `strided`."""
    values = strided(array, limit, mask)
    return values[np.isfinite(values)]


def check_values(array: np.ndarray, name: str) -> str | None:
    """Refuse a volume that carries no picture; say what was found where part of it is not finite.

    Returns:
        A note for the report when some voxels are NaN or infinite (they are treated as air), else None.

    Raises:
        InputError: no finite voxel, or all finite voxels equal.
    """
    bad = 0
    low, high = np.inf, -np.inf
    for plane in array:
        check()
        good = plane if plane.dtype.kind in "iub" else plane[np.isfinite(plane)]
        bad += plane.size - good.size
        if good.size:
            low, high = min(low, float(good.min())), max(high, float(good.max()))
    if low > high:
        raise InputError(f"{name}: no voxel has a finite value; check the export or the rescale values of the file")
    if low == high:
        raise InputError(f"{name}: every voxel has the value {low:g}; there is nothing to colour")
    return f"{bad} voxels are not finite and are treated as air" if bad else None


def choose_window(
    array: np.ndarray,
    body: np.ndarray | None = None,
    given: tuple[float, float] | None = None,
    proposed: tuple[float, float] | None = None,
    percentiles: tuple[float, float] = (0.5, 99.5),
) -> Window:
    """Choose the window: given values, else the file's own (DICOM), else robust percentiles inside the body.

    Args:
        array: (k, j, i) scalars.
        body: boolean mask of the same shape, or None for the whole volume.
        given: (low, high) asked for by the user.
        proposed: (low, high) that the file proposes. Ignored, and said so, when it shows fewer than 5 % of the body's
            values between its ends: scanners write windows for other series, too.
        percentiles: robust ends used when nothing else is there.

    Raises:
        SettingsError: a given window that is empty, reversed, not finite, or beside all values.
        InputError: the body holds a single value.
    """
    if given is not None:
        low, high = float(given[0]), float(given[1])
        if not (np.isfinite([low, high]).all() and low < high):
            raise SettingsError(f"window: expected finite LO < HI, got {low:g} {high:g}")
        _check_overlap(finite_sample(array, mask=body), low, high)
        return Window(low, high, "given")
    sample = finite_sample(array, mask=body)
    if sample.size == 0:
        raise InputError("window: the body holds no finite value; give a window (LO HI)")
    note = ""
    if proposed is not None and np.isfinite(proposed).all() and proposed[0] < proposed[1]:
        inside = np.mean((sample > proposed[0]) & (sample < proposed[1]))
        if inside >= 0.05:
            return Window(float(proposed[0]), float(proposed[1]), "file (DICOM window)")
        note = "; the file's window shows next to nothing of the body"
    low, high = 2 * np.percentile(sample / 2, percentiles)  # halves: interpolation between extremes stays finite
    if low == high:  # e.g. a two-valued mask with a rare second value
        low, high = sample.min(), sample.max()
    if low == high:
        raise InputError(f"window: the body holds the single value {low:g}; give a window (LO HI)")
    return Window(float(low), float(high), f"percentiles {percentiles[0]:g} and {percentiles[1]:g} of the body{note}")


def _check_overlap(sample: np.ndarray, low: float, high: float) -> None:
    """Refuse a window that holds none of the values (n,) and lies beside them all: everything would be one grey."""
    if sample.size and (sample.max() < low or sample.min() > high):
        grey = "black" if sample.max() < low else "white"
        raise SettingsError(
            f"window {low:g} {high:g}: everything would be {grey}, the body's values go from {sample.min():g} to "
            f"{sample.max():g}; choose a window among them, or none"
        )


def apply_window(values: np.ndarray, window: Window) -> np.ndarray:
    """Display grey 0..1 (float32) of scanner values; NaN and -inf become 0 (air), +inf becomes 1.

    Computed in float64: int16 limits, 30000 HU metal and float64 beyond float32 do not overflow.
    """
    low, high = np.float64(window.low), np.float64(window.high)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        grey = np.asarray(values, dtype=np.float64) / 2 - low / 2  # halves: the difference of extremes stays finite
        grey /= high / 2 - low / 2
    return np.nan_to_num(np.clip(grey, 0.0, 1.0), nan=0.0).astype(np.float32)


def histogram_match_curve(source: np.ndarray, target: np.ndarray, bins: int = 256) -> np.ndarray:
    """Monotone curve (bins,) that gives `source` greys (0..1) the distribution of `target` greys (0..1).

    Mid-point cumulative fractions make a distribution with one level map to the median of the other.
    Sampled at grey = index / (bins - 1); use with `apply_curve`.
    """
    if source.size == 0 or target.size == 0:
        return np.linspace(0, 1, bins)
    # each grey is shared between the two nodes that `apply_curve` will interpolate between
    position = np.clip(source, 0, 1).astype(np.float64).ravel() * (bins - 1)
    node = np.minimum(position.astype(np.int64), bins - 2)
    share = position - node
    counts = np.bincount(node, 1 - share, bins) + np.bincount(node + 1, share, bins)
    cumulated = np.cumsum(counts)
    fraction = (cumulated - counts / 2) / cumulated[-1]  # not counts.sum(), whose rounding differs: at most 1
    return np.quantile(np.clip(target, 0, 1).astype(np.float64), fraction)


def spreading_curve(grey: np.ndarray, share: float = 0.5, bins: int = 256) -> np.ndarray:
    """Strictly increasing curve (bins,) 0..1 -> 0..1 that gives grey levels room according to how often they occur.

    `share` of it is the cumulative distribution, the rest the identity. In CT most tissue lies within a few levels of a
    window that also holds bone; as the guide of a regression they would fall into one bin.
    """
    linear = np.linspace(0, 1, bins)
    if grey.size == 0:
        return linear
    counts = np.bincount(np.rint(np.clip(grey, 0, 1) * (bins - 1)).astype(np.int64).ravel(), minlength=bins)
    return (1 - share) * linear + share * (np.cumsum(counts) - counts / 2) / counts.sum()


def apply_curve(grey: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """Look `grey` (0..1; beyond, the ends of the curve) up in `curve` with linear interpolation; float32, same shape.

    The nodes are evenly spaced, so no search is needed: four times as fast as `numpy.interp`.
    """
    position = np.clip(np.asarray(grey), 0, 1) * (len(curve) - 1)
    low = np.minimum(position.astype(np.intp), len(curve) - 2)
    start, step = np.asarray(curve, np.float64)[:-1], np.diff(curve)
    return (start[low] + (position - low) * step[low]).astype(np.float32)
