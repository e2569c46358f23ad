"""Suite *features*: VGG-19 by precision, against the same network in float64."""

from __future__ import annotations

import numpy as np
import torch

from ..color.lab import lightness_to_gray
from ..features.vgg19 import VGG19
from ..features.weights import find_weights, load_weights
from ..matching.analogy import PATCH_RADIUS, unit
from ..matching.fields import exact
from ..progress import Progress
from .pairs import Section, make_pair
from .tables import TIME_COLUMNS, Suite, Table, timed

COLUMNS = ("features", "precision", "layer", "relative_error", "same_match", *TIME_COLUMNS)
NOTES = [
    "relative_error: |F - F64| / |F64| over a layer of one slice (a quick run: its central quarter), F64 the same network in "
    "float64.",
    "same_match: share of body positions at layer 3 whose exhaustive match is the one found with float64 features.",
    "seconds: layers 5 to 3 of one slice of 256 x 256.",
]


def run(section: Section, quick: bool, seed: int, progress: Progress) -> Suite:
    """Extract one slice in every precision that the processor takes."""
    found = find_weights("vgg19")
    if found is None:
        return Suite(failures=[("features of VGG-19", "no weights here")])
    table = Table(COLUMNS)
    suite = Suite({"features": table}, notes=list(NOTES))
    suite.failures.append(
        ("8-bit against float weights", "one file of weights at a time; the error is against its own values")
    )
    progress(0.0, "features by precision")
    weights = load_weights(found.path)
    suite.notes.append(f"Weights: {weights.source}.")
    whole = torch.from_numpy(make_pair(section, "as it is", seed).grey.astype(np.float32))[None, None]
    grey = lightness_to_gray(section.lab[..., 0]) * section.mask
    cut = np.s_[..., 64:192, 64:192] if quick else np.s_[...]
    plane, other = whole[cut], torch.from_numpy(grey.astype(np.float32))[None, None][cut]
    mask = torch.nn.functional.avg_pool2d(torch.from_numpy(section.mask[cut].astype(np.float32))[None], 4)[0] > 0.5
    layers = (5, 4, 3) if quick else (5, 4, 3, 2, 1)
    best = _reference_features(weights, plane, layers), _reference_features(weights, other, (3,))
    wanted = _matches(best[0][3], best[1][3], mask)
    for dtype in ("float32", "bfloat16"):
        network = VGG19(weights, dtype=dtype)
        _, seconds = timed(lambda n=network: n.extract(whole, (5, 4, 3)), 3 if quick else 5)
        got, got_other = network.extract(plane, layers), network.extract(other, (3,))
        same = float((_matches(got[3], got_other[3], mask) == wanted)[mask].float().mean())
        for layer in layers:
            error = float((got[layer].double() - best[0][layer]).norm() / best[0][layer].norm())
            timing = {"same_match": same, **seconds.columns()} if layer == 3 else {}
            table.add(features="vgg19", precision=dtype, layer=layer, relative_error=error, **timing)
    return suite


def _reference_features(weights, plane: torch.Tensor, layers) -> dict[int, torch.Tensor]:
    """The network from its definition in float64: three planes, means taken off, nothing folded."""
    if weights.preprocessing == "oxford":
        means = torch.tensor((103.939, 116.779, 123.68), dtype=torch.float64).view(1, 3, 1, 1)
        x = plane.double().expand(-1, 3, -1, -1) * 255 - means
    else:
        means = torch.tensor((0.485, 0.456, 0.406), dtype=torch.float64).view(1, 3, 1, 1)
        x = (plane.double() - means) / torch.tensor((0.229, 0.224, 0.225), dtype=torch.float64).view(1, 3, 1, 1)
    found = {}
    with torch.no_grad():
        for block, depth in enumerate((2, 2, 4, 4, 1), start=1):
            for index in range(1, depth + 1):
                kernel, bias = (weights.tensor(f"conv{block}_{index}.{part}").double() for part in ("weight", "bias"))
                x = torch.relu(torch.nn.functional.conv2d(x, kernel, bias, padding=1))
                if index == 1:
                    found[block] = x
            x = torch.nn.functional.max_pool2d(x, 2)
    return {layer: found[layer] for layer in layers}


def _matches(target: torch.Tensor, reference: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    field = exact.search(unit(target), unit(reference), PATCH_RADIUS[3], mask[None], mask, False)[0]
    return field[0]
