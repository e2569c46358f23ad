"""Suite *sidebyside*: the same work by others' methods: a plain PatchMatch as published, and OpenCV's filters."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ..device import one_thread
from ..features import make_extractor
from ..filters import domain_transform, fgs, guided
from ..filters.fgs_parameters import lambda_schedule
from ..matching.analogy import PATCH_RADIUS, SEARCH_RADIUS
from ..matching.fields import exact
from ..matching.fields.field import upsample
from ..progress import Progress
from .pairs import SIZE_PX, Section, make_pair
from .plain_patchmatch import plain_patchmatch
from .suite_correspondence import Layer, energy, exhaustive, layers_of
from .tables import Seconds, Suite, Table, seconds_of, timed

COLUMNS = (
    "what", "beside", "condition", "error", "error_beside", "difference", "seconds", "seconds_low", "seconds_high", "runs",
    "seconds_beside", "seconds_beside_low", "seconds_beside_high", "time_ratio",
)  # fmt: skip

NOTES = [
    "time_ratio: our median over the other's, measured one after the other; below 1 ours is faster.",
    "Matching: one layer, both directions. Ours compares every patch with every patch; beside it a PatchMatch as Liao et al. "
    "2017 describe it, written plainly in NumPy and so far from the fastest possible: the errors say more than the times. error: "
    "mean patch distance inside the body over that of an exhaustive search, minus 1, the mean of both directions; 0 is exact. "
    "PatchMatch starts from the exhaustive field of the next coarser layer, brought up.",
    "Filters: a* and b* of a section on 256 x 256 pixels, L*, a* and b* on 512 x 512, float32, guided by the luminance of its "
    "warped copy in 8 bits; one thread each, in turns. difference: RMS of our result minus OpenCV's, as a share of the source's "
    "standard deviation; the guided filter without the border of two radii, where the one mirrors and the other takes what is "
    "there. The same strengths on both sides of the fast global smoother: Min et al.'s share of lambda is given to OpenCV. At "
    "lambda 900 it is outside what ours leaves to OpenCV.",
    "A time counts only where the two results agree to 1 % of the deviation, and where no field is better than exhaustive.",
]
_AGREE = 0.01


def run(section: Section, quick: bool, seed: int, progress: Progress) -> Suite:
    """Measure matching at layer 4 (and 3 in a full run), then the filters."""
    suite = Suite({"sidebyside": Table(COLUMNS)}, notes=list(NOTES))
    pair = make_pair(section, "as it is", seed, mirror=False)
    extractor = make_extractor("embedded")
    for number in (4,) if quick else (4, 3):
        progress(0.4 * (4 - number), f"side by side, matching at layer {number}")
        coarse, layer = layers_of(pair, extractor, (number + 1, number))
        measure_matching(suite, coarse, layer, (1,) if quick else (1, 4, 10), seed)
    progress(0.8, "side by side, filters")
    for method in opencv_filters(suite):
        for size in (SIZE_PX,) if quick else (SIZE_PX, 2 * SIZE_PX):
            _measure_filter(suite, method, section, seed, size)
    return suite


def turned(layer: Layer) -> Layer:
    """The same layer looked at from the reference; true positions are not known this way."""
    masks = layer.reference_mask[None], layer.target_mask[0]
    return Layer(layer.number, layer.reference, layer.target, *masks, layer.true_rows, layer.true_cols)


def measure_matching(suite: Suite, coarse: Layer, layer: Layer, iterations: tuple[int, ...], seed: int) -> None:
    """Add ours, and beside it the plain PatchMatch with each number of iterations."""
    radius = PATCH_RADIUS[layer.number]
    ways = [(coarse, layer), (turned(coarse), turned(layer))]
    least = [
        energy(side, exhaustive(side.target, side.reference, side.reference_mask, radius), radius) for _, side in ways
    ]
    masks = layer.target_mask, layer.reference_mask
    found, own = timed(lambda: exact.search(layer.target, layer.reference, radius, *masks, True), 3)
    error = _excess(ways, (found[0], found[2]), least, radius)
    for count in iterations:
        start = time.perf_counter()
        fields = [_plain(*way, count, seed) for way in ways]
        other = seconds_of([time.perf_counter() - start])  # once: seconds long, and nothing in it needs a warm-up
        beside = _excess(ways, fields, least, radius)
        condition = f"layer {layer.number}, {count} iterations"
        row = {"what": "exhaustive search, both directions", "beside": "plain PatchMatch", "condition": condition}
        if min(error, beside) < -1e-4:
            suite.failures.append(
                (f"time of matching, {condition}", "a field better than exhaustive: one of them is wrong")
            )
            continue
        suite.tables["sidebyside"].add(**row, error=error, error_beside=beside, **_times(own, other))


def _plain(coarse: Layer, layer: Layer, iterations: int, seed: int) -> torch.Tensor:
    """Field (1, h, w) by the plain PatchMatch, from the coarser layer's exhaustive field."""
    radius, number = PATCH_RADIUS[layer.number], layer.number
    parent = exhaustive(coarse.target, coarse.reference, coarse.reference_mask, PATCH_RADIUS[number + 1])
    start = upsample(parent, tuple(layer.reference.shape[2:]), coarse.reference.shape[3])[0].numpy()
    maps = (side[0].numpy() for side in (layer.target, layer.reference))
    allowed = layer.reference_mask.numpy()
    found = plain_patchmatch(*maps, start, radius, SEARCH_RADIUS[number], iterations, seed, allowed)
    return torch.from_numpy(found)[None]


def _excess(ways, fields, least, radius: int) -> float:
    energies = [energy(layer, field, radius) / low for (_, layer), field, low in zip(ways, fields, least)]
    return float(np.mean(energies)) - 1


def _times(own: Seconds, other: Seconds) -> dict:
    beside = {f"seconds_beside{end}": getattr(other, name) for end, name in
              (("", "median"), ("_low", "low"), ("_high", "high"))}  # fmt: skip
    return {**own.columns(), **beside, "time_ratio": own.median / other.median}


@dataclass(frozen=True)
class Beside:
    """A filter of ours and the same one in OpenCV; both take source (H, W, C) float32 and guide (H, W) uint8.

    Attributes:
        border: pixels left out of the comparison on every side.
    """

    what: str
    beside: str
    condition: str
    ours: Callable
    theirs: Callable
    border: int = 0


def opencv_filters(suite: Suite) -> Iterator[Beside]:
    """The filters that OpenCV has, too, with the parameters of the colour transfer; notes a failure where it has none."""
    try:
        from cv2 import ximgproc
    except ImportError as error:
        suite.failures.append(("OpenCV's filters", f"not installed ({error})"))
        return
    for lam, sigma in ((32.0, 200.0), (900.0, 8.0)):
        own = fgs.FgsParameters(lam, sigma)
        first = lambda_schedule(lam, own.iterations, own.schedule)[0]
        yield Beside(
            "fast global smoother", "fastGlobalSmootherFilter", f"lambda {lam:g}, sigma {sigma:g}, 3 iterations",
            lambda s, g, own=own: fgs.smooth(s, g, own),
            lambda s, g, a=first, b=sigma: ximgproc.fastGlobalSmootherFilter(g, s, a, b, num_iter=3),
        )  # fmt: skip
    box = guided.GuidedParameters()
    yield Beside(
        "guided filter", "guidedFilter", f"radius {box.radius}, eps {box.eps:g}",
        lambda s, g: guided.smooth(s, g, box),
        lambda s, g: ximgproc.guidedFilter(g, s, box.radius, box.eps),
        border=2 * box.radius,
    )  # fmt: skip
    path = domain_transform.DomainTransformParameters()
    yield Beside(
        "domain transform", "dtFilter", f"sigma {path.sigma_s:g} px and {path.sigma_r:g}, {path.iterations} iterations",
        lambda s, g: domain_transform.smooth(s, g, path),
        lambda s, g: ximgproc.dtFilter(g, s, path.sigma_s, path.sigma_r, mode=ximgproc.DTF_RF, numIters=path.iterations),
    )  # fmt: skip


def _measure_filter(suite: Suite, method: Beside, section: Section, seed: int, size: int = SIZE_PX) -> None:
    """Add a filter on (size, size): two channels on the raster's own size, else all three of L*a*b*."""
    import cv2

    lab, grey = section.lab, make_pair(section, "as it is", seed).grey
    if size != SIZE_PX:
        lab, grey = (cv2.resize(values, (size, size), interpolation=cv2.INTER_CUBIC) for values in (lab, grey))
    source = np.ascontiguousarray(lab[..., 1:] if size == SIZE_PX else lab, np.float32)
    guide = np.rint(255 * np.clip(grey, 0, 1)).astype(np.uint8)
    with one_thread():
        ours, theirs = method.ours(source, guide), method.theirs(source, guide)
        own, other = in_turns(lambda: method.ours(source, guide), lambda: method.theirs(source, guide))
    inside = np.s_[method.border : size - method.border, method.border : size - method.border]
    difference = float(np.sqrt(((ours - theirs)[inside].astype(np.float64) ** 2).mean()) / source.std())
    times = _times(own, other)
    condition = f"{method.condition}, {' x '.join(str(n) for n in source.shape)}"
    if not difference < _AGREE:
        suite.failures.append((f"time of {method.what}, {condition}", f"differs from OpenCV's by {difference:.2g}"))
        times = {}
    row = {"what": method.what, "beside": f"OpenCV {method.beside}", "condition": condition}
    suite.tables["sidebyside"].add(**row, difference=difference, **times)


def in_turns(*calls: Callable, runs: int = 15) -> list[Seconds]:
    """Times of several calls, one after the other in every turn, so that a load on the machine falls on all alike."""
    seconds: list[list[float]] = [[] for _ in calls]
    for _ in range(runs):
        for call, measured in zip(calls, seconds):
            start = time.perf_counter()
            call()
            measured.append(time.perf_counter() - start)
    return [seconds_of(measured) for measured in seconds]
