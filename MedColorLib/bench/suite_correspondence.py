"""Suite *correspondence*: nearest-neighbour fields by search, iterations and precision, against exhaustive search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, unfold

from ..color.lab import lightness_to_gray
from ..features import Extractor
from ..matching.analogy import PATCH_RADIUS, SEARCH_RADIUS, unit
from ..matching.fields import exact, patchmatch, windowed
from ..matching.fields.field import upsample
from ..progress import Progress
from . import deconvolution
from .pairs import SIZE_PX, Pair, Section, make_pair
from .tables import TIME_COLUMNS, Suite, Table, timed

COLUMNS = (
    "section", "remap", "features", "layer", "method", "start", "iterations",
    "energy_ratio", "end_point_px", "end_point_median_px", *TIME_COLUMNS,
)  # fmt: skip

NOTES = [
    "One layer by itself: unit features of the target against the reference's, patches as in the pipeline.",
    "energy_ratio: mean patch distance 2 - 2 <F, F'> inside the body, recomputed in float64 from the field, over that of an "
    "exhaustive search written out in the plainest way; 1 is exact. It must not be below 1.",
    "Pairs are warped, not mirrored: a body is nearly symmetric, and its other side is no wrong answer.",
    "end_point_px: distance between the position found and the true one, in pixels of the 256 x 256 raster.",
    "start: the exhaustive field of the next coarser layer brought up, or chance.",
]
_CHUNK = 256  # rows of the similarity matrix at a time: 16 MB at layer 2


@dataclass(frozen=True)
class Layer:
    """One layer of a pair: unit features (1, C, h, w), masks and the true positions in the reference's layer."""

    number: int
    target: Tensor
    reference: Tensor
    target_mask: Tensor
    reference_mask: Tensor
    true_rows: Tensor
    true_cols: Tensor


def run(sections: list[Section], extractors: list[Extractor], quick: bool, seed: int, progress: Progress) -> Suite:
    """Search layers 4 and 3 (and 2 in a full run) of some pairs by every method."""
    suite = Suite({"fields": Table(COLUMNS)}, notes=list(NOTES))
    remaps = ("as it is",) if quick else ("as it is", "strong")
    jobs = [(s, r, e, n) for s in sections for r in remaps for e in extractors for n in (4, 3)]
    if not quick and extractors[0].name != "embedded":  # which has no layer 2; all with all there takes half a minute
        jobs.append((sections[0], remaps[0], extractors[0], 2))
    for number, (section, remap, extractor, layer) in enumerate(jobs):
        progress(number / len(jobs), f"correspondence, {section.name}, {extractor.name}, layer {layer}")
        pair = make_pair(section, remap, seed, mirror=False)
        _measure(suite, pair, extractor, layer, quick, seed)
    if any(extractor.name == "vgg19" for extractor in extractors):
        deconvolution.run(suite, sections[0], quick, seed, progress)
    return suite


def _measure(suite: Suite, pair: Pair, extractor: Extractor, number: int, quick: bool, seed: int) -> None:
    coarse, layer = layers_of(pair, extractor, (number + 1, number))
    radius = PATCH_RADIUS[number]
    best = exhaustive(layer.target, layer.reference, layer.reference_mask, radius)
    least = energy(layer, best, radius)
    parent = exhaustive(coarse.target, coarse.reference, coarse.reference_mask, PATCH_RADIUS[number + 1])
    start = upsample(parent, tuple(layer.reference.shape[2:]), coarse.reference.shape[3])
    keys = {"section": pair.section.name, "remap": pair.remap, "features": extractor.name, "layer": number}
    for method, origin, iterations, call in _methods(layer, start, radius, quick, seed):
        field, seconds = timed(call, 2)
        mean, median = _end_point(layer, field)
        ratio = energy(layer, field, radius) / least
        if ratio < 1 - 1e-4:  # better than exhaustive: one of the two is wrong
            suite.failures.append(
                (f"time of {method}, layer {number}", f"energy {ratio:.4f} of an exhaustive search's")
            )
            continue
        columns = {"energy_ratio": ratio, "end_point_px": mean, "end_point_median_px": median}
        keys_of_row = {**keys, "method": method, "start": origin, "iterations": iterations}
        suite.tables["fields"].add(**keys_of_row, **columns, **seconds.columns())


def _methods(layer: Layer, start: Tensor, radius: int, quick: bool, seed: int):
    """(method, start, iterations, call that returns the field (1, h, w))."""
    pair = layer.target, layer.reference
    if layer.number > 2:  # below, the similarity of all with all is 1 GB
        yield (
            "exact, float32",
            None,
            None,
            lambda: exact.search(*pair, radius, layer.target_mask, layer.reference_mask, False)[0],
        )
        half = tuple(side.bfloat16() for side in pair)
        yield (
            "exact, bfloat16",
            None,
            None,
            lambda: exact.search(*half, radius, layer.target_mask, layer.reference_mask, False)[0],
        )
    yield "windowed", "coarser layer", None, lambda: windowed.refine(*pair, start, layer.reference_mask, radius)[0]
    chance = _random_field(layer, seed)
    sides = max(layer.reference.shape[2:])
    reach = SEARCH_RADIUS[layer.number]
    for iterations in (0, 1, 4) if quick else (0, 1, 2, 4, 8):
        yield "patchmatch", "coarser layer", iterations, _patchmatch(layer, start, radius, reach, iterations, seed)
    for iterations in (4,) if quick else (1, 4):
        yield "patchmatch", "chance", iterations, _patchmatch(layer, chance, radius, sides, iterations, seed)


def _patchmatch(layer, start, radius, reach, iterations, seed) -> Callable[[], Tensor]:
    def call() -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        pair = layer.target, layer.reference
        return patchmatch.refine(*pair, start, layer.reference_mask, radius, reach, iterations, generator)[0]

    return call


def _random_field(layer: Layer, seed: int) -> Tensor:
    allowed = torch.nonzero(layer.reference_mask.reshape(-1))[:, 0]
    shape = (1, *layer.target.shape[2:])
    return allowed[torch.randint(len(allowed), shape, generator=torch.Generator().manual_seed(seed))]


def exhaustive(target: Tensor, reference: Tensor, reference_mask: Tensor, radius: int) -> Tensor:
    """The best match by comparing every patch with every patch, written out: (1, h, w)."""
    side = 2 * radius + 1
    here, there = (unfold(values.float(), side, padding=radius)[0].T for values in (target, reference))
    forbidden = ~reference_mask.reshape(-1)
    best = [(rows @ there.T).masked_fill(forbidden, -torch.inf).argmax(1) for rows in here.split(_CHUNK)]
    return torch.cat(best).view(1, *target.shape[2:])


def energy(layer: Layer, field: Tensor, radius: int) -> float:
    """Mean patch distance 2 - 2 <F, F'> inside the body, in float64."""
    similarity = patchmatch.patch_similarity(layer.target.double(), layer.reference.double(), field, radius).double()
    return float((2 - 2 * similarity)[layer.target_mask].mean())


def _end_point(layer: Layer, field: Tensor) -> tuple[float, float]:
    """Mean and median distance to the true position, in pixels of the full raster."""
    stride = 2 ** (layer.number - 1)
    cols = layer.reference.shape[3]
    rows, columns = ((found.double() + 0.5) * stride - 0.5 for found in (field[0] // cols, field[0] % cols))
    distance = torch.hypot(rows - layer.true_rows, columns - layer.true_cols)[layer.target_mask[0]]
    return float(distance.mean()), float(distance.median())


def layers_of(pair: Pair, extractor: Extractor, numbers: tuple[int, ...]) -> list[Layer]:
    """Some layers of a pair, target and reference by themselves (nothing blended)."""
    reference_grey = lightness_to_gray(pair.section.lab[..., 0]) * pair.section.mask
    planes = [torch.from_numpy(grey.astype(np.float32))[None, None] for grey in (pair.grey, reference_grey)]
    target, reference = (extractor.extract(plane, numbers) for plane in planes)
    return [_layer(pair, number, unit(target[number]), unit(reference[number])) for number in numbers]


def _layer(pair: Pair, number: int, target: Tensor, reference: Tensor) -> Layer:
    stride = 2 ** (number - 1)

    def shrunk(plane: np.ndarray) -> Tensor:
        values = torch.from_numpy(plane.astype(np.float64))[None, None]
        return avg_pool2d(values, stride)[0, 0]

    masks = shrunk(pair.mask) > 0.5, shrunk(pair.section.mask) > 0.5
    true = (shrunk(np.clip(pair.source[..., axis], 0, SIZE_PX - 1)) for axis in (0, 1))
    return Layer(number, target.contiguous(), reference.contiguous(), masks[0][None], masks[1], *true)
