"""Stage *analogy*: deep image analogy (Liao et al. 2017) between grey slices and a colour reference, coarse to fine.

With A the target and B' the reference, the latent A' (the target in the reference's looks) and B (the reference in the
target's looks) are refined layer by layer: match patches in both directions, bring the matched features one layer down,
blend them with the layer's own features, match again. All slices of a batch go through together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from ..device import fast_dtype
from .confidence import likeness
from .fields import exact, patchmatch, windowed
from .fields.field import upsample, warp
from .reconstruction import DIRECTIONS

PATCH_RADIUS = {5: 1, 4: 1, 3: 1, 2: 2, 1: 2}  # patches of 3 at layers 5, 4, 3 and 5 at layers 2, 1
SEARCH_RADIUS = {4: 6, 3: 6, 2: 4, 1: 4}
BLEND_ALPHA = {4: 0.8, 3: 0.7, 2: 0.6, 1: 0.1}
# Of squared feature lengths, as a share of the largest: below it, as with unit features of half precision (2e-3), length says
# nothing of the response.
LEAST_SPREAD = 1e-2
GROUP_WEIGHT = 11.0  # one pixel of another group costs 2 * 11^2; a patch's features and context differ by 200 at most
EXACT_LIMIT = 4096 * 4096 + 1  # entries of the similarity matrix up to which the search is exhaustive (64 MB)


@dataclass
class Match:
    """What the analogy found at its last layer.

    Attributes:
        layer: 5 (coarsest) to 1.
        field: (N, h, w) target to reference; similarity: (N, h, w), the mean over the patch of <F_A, F_B> + <F_A', F_B'>.
        reverse: (N, h2, w2) reference to target, or None when nothing reads it.
        searched: how each layer was searched, layer -> "exact", "windowed" or "patchmatch".
        likeness: (N, h5, w5), how alike matched positions look at layer 5, see `confidence.likeness`; None like `reverse`.
    """

    layer: int
    field: Tensor
    similarity: Tensor
    reverse: Tensor | None
    searched: dict[int, str]
    likeness: Tensor | None = None

    def parts(self) -> list[Match]:
        """The same, slice by slice."""
        return [self._of_tensors(lambda tensor, n=n: tensor[n : n + 1]) for n in range(len(self.field))]

    def _of_tensors(self, change: Callable[[Tensor], Tensor]) -> Match:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return Match(**{name: change(v) if isinstance(v, Tensor) else v for name, v in values.items()})


def joined(parts: Sequence[Match]) -> Match:
    """The inverse of `Match.parts`."""
    first, *_ = parts
    names = [field.name for field in fields(first) if isinstance(getattr(first, field.name), Tensor)]
    return replace(first, **{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


@dataclass(frozen=True)
class Context:
    """What joins the features at every layer: where in the body a position lies, how bright it is, and its tissue group.

    Not in the paper. The first two are unit vectors on a circle, so that their inner product is a similarity like the
    features': cos of the distance in position (over 1.2 half turns per body width) and in grey (half a turn from black to
    white). Groups are one channel each and count more than all the rest together; see `guard`.

    Attributes:
        position_weight, luminance_weight: 0 leaves the part out; 1 counts as much as the features.
        target: (N, 1, H, W) grey; reference: (1, 1, H, W) grey; may be None when the luminance weight is 0.
        groups: target (N, G, H, W) and reference (1, G, H, W), 1 where a pixel is of the group, else 0; or None.
    """

    position_weight: float
    luminance_weight: float
    target: Tensor | None
    reference: Tensor | None
    groups: tuple[Tensor, Tensor] | None = None


def deep_image_analogy(
    target: dict[int, Tensor],
    reference: dict[int, Tensor],
    target_mask: Tensor,
    reference_mask: Tensor,
    stop_layer: int,
    context: Context | None = None,
    reconstruct=None,
    fine_search: str = "windowed",
    iterations: int = 4,
    seed: int = 0,
    keep_reverse: bool = False,
) -> Match:
    """Match target slices to one reference from layer 5 down to `stop_layer`.

    Args:
        target: layer -> (N, C, h, w) features of the target slices, for layers 5 .. stop_layer.
        reference: layer -> (1, C, h2, w2).
        target_mask: (N, H, W) bool body on the full grid; reference_mask: (H2, W2) bool tissue.
        stop_layer: 5 .. 1. At the last layer the reverse field, and likeness, are left out unless `keep_reverse`.
        context: position and grey that join the features, or None (the paper).
        reconstruct: how matched features come one layer down, `f(layer, direction, coarse_warped, fine_warped) ->
            features of layer`, direction one of `reconstruction.DIRECTIONS`; None takes the reference's own finer features
            warped by the upsampled field.
        fine_search: how layers are searched whose similarity would not fit: "windowed" (exhaustive around the start) or
            "patchmatch" (the paper's).
        iterations, seed: of PatchMatch.
    """
    generator = torch.Generator().manual_seed(seed)
    field = reverse = alike = None
    searched = {}
    for layer in range(5, stop_layer - 1, -1):
        a, b = target[layer], reference[layer]
        if layer == 5:
            pair = (torch.cat([unit(a)] * 2, 1), torch.cat([unit(b)] * 2, 1))
        else:
            coarse_shapes = tuple(target[layer + 1].shape[2:]), tuple(reference[layer + 1].shape[2:])
            field, reverse, pair = _descend(layer, target, reference, field, reverse, coarse_shapes, reconstruct)
        if context is not None:
            pair = _with_context(pair, context)
        masks = _mask_at(target_mask, a.shape[2:]), _mask_at(reference_mask[None], b.shape[2:])[0]
        both = keep_reverse or layer > stop_layer
        if layer == 5 or a.shape[2] * a.shape[3] * b.shape[2] * b.shape[3] <= EXACT_LIMIT:
            searched[layer] = "exact"
            sides = (side.to(_product_dtype(side, context)) for side in pair)
            field, similarity, reverse, _ = exact.search(*sides, PATCH_RADIUS[layer], *masks, both)
        else:
            searched[layer] = fine_search
            refine = _fine_search(fine_search, layer, iterations, generator)
            field, similarity = refine(*pair, field, masks[1])
            reverse = _refine_reverse(refine, *pair, reverse, masks[0]) if both else None
        if layer == 5 and keep_reverse:
            alike = likeness(unit(a), unit(b), field, *masks)
    return Match(stop_layer, field, similarity, reverse, searched, alike)


def unit(features: Tensor) -> Tensor:
    """Features of length 1 per pixel; a zero vector stays zero (it matches nothing better than anything else).

    The length is taken in float32, so that half precision neither overflows nor underflows.
    """
    values = features.float()
    return values / values.norm(dim=1, keepdim=True).clamp_min(1e-12)


def response_weight(features: Tensor, alpha: float) -> Tensor:
    """Weight of a layer's own features, W = alpha * sigmoid(300 (m - 0.05)), m the squared magnitude scaled to 0..1.

    (N, 1, h, w). It needs features whose length says how strongly the network responds, such as VGG-19's: 40 to 96 % of a body's
    positions are strong there. Features of one length (a spread below LEAST_SPREAD, which rounding alone may give) say
    nothing of it: all positions count as strong, W = alpha. Were they all weak, W = 0, nothing of the slice's own would
    remain in the latent image: on pairs 2.6 instead of 1.6 CIEDE2000. Self-similarity, of length 1 to 2, is strong
    everywhere by the formula.
    """
    magnitude = features.float().square().sum(1, keepdim=True)
    low, high = magnitude.amin((2, 3), keepdim=True), magnitude.amax((2, 3), keepdim=True)
    span = high - low
    scaled = torch.where(
        span > LEAST_SPREAD * high, (magnitude - low) / span.clamp_min(1e-30), torch.ones_like(magnitude)
    )
    return alpha * torch.sigmoid(300 * (scaled - 0.05))


def _descend(layer, target, reference, field, reverse, coarse_shapes, reconstruct):
    """Fields and blended feature pairs of `layer` from the matches of `layer + 1`."""
    a, b = target[layer], reference[layer]
    coarse_a, coarse_b = coarse_shapes
    fine_field = upsample(field, tuple(b.shape[2:]), coarse_b[1])[:, : a.shape[2], : a.shape[3]]
    fine_reverse = upsample(reverse, tuple(a.shape[2:]), coarse_a[1])[:, : b.shape[2], : b.shape[3]]
    from_reference, from_target = warp(b, fine_field), warp(a, fine_reverse)
    if reconstruct is not None:
        from_reference = reconstruct(layer, DIRECTIONS[0], warp(reference[layer + 1], field), from_reference)
        from_target = reconstruct(layer, DIRECTIONS[1], warp(target[layer + 1], reverse), from_target)
    own_a, own_b = response_weight(a, BLEND_ALPHA[layer]), response_weight(b, BLEND_ALPHA[layer])
    latent_a = own_a * a + (1 - own_a) * from_reference
    latent_b = own_b * b + (1 - own_b) * from_target
    pair_b = [unit(latent_b), unit(b).expand(len(latent_b), -1, -1, -1)]
    return fine_field, fine_reverse, (torch.cat([unit(a), unit(latent_a)], 1), torch.cat(pair_b, 1))


def _with_context(pair, context: Context):
    a, b = pair
    parts_a, parts_b = [a], [b]
    if context.position_weight > 0:  # sqrt 2: the features stand in the pair twice, their context once
        scale = context.position_weight * 2**0.5
        parts_a.append(scale * _position(a.shape[2:], a).expand(len(a), -1, -1, -1))
        parts_b.append(scale * _position(b.shape[2:], b).expand(len(b), -1, -1, -1))
    if context.luminance_weight > 0:
        scale = context.luminance_weight * 2**0.5
        parts_a.append(scale * _on_circle(adaptive_avg_pool2d(context.target, a.shape[2:]), 1.0))
        reference = _on_circle(adaptive_avg_pool2d(context.reference, b.shape[2:]), 1.0)
        parts_b.append(scale * reference.expand(len(b), -1, -1, -1))
    if context.groups is not None:
        scale = GROUP_WEIGHT * 2**0.5
        own, other = (unit(adaptive_avg_pool2d(g, side.shape[2:])) for g, side in zip(context.groups, pair))
        parts_a.append(scale * own)
        parts_b.append(scale * other.expand(len(b), -1, -1, -1))
    return torch.cat(parts_a, 1), torch.cat(parts_b, 1)


def _position(shape, like: Tensor) -> Tensor:
    """(1, 4, h, w): row and column of the body's box as points on circles, unit length together."""
    rows = torch.linspace(0, 1, shape[0], device=like.device, dtype=like.dtype).view(1, 1, -1, 1).expand(1, 1, *shape)
    cols = torch.linspace(0, 1, shape[1], device=like.device, dtype=like.dtype).view(1, 1, 1, -1).expand(1, 1, *shape)
    return torch.cat([_on_circle(rows, 1.2), _on_circle(cols, 1.2)], 1) * 0.5**0.5


def _on_circle(values: Tensor, half_turns: float) -> Tensor:
    angle = values * (half_turns * torch.pi)
    return torch.cat([torch.cos(angle), torch.sin(angle)], 1)


def _product_dtype(features: Tensor, context: Context | None) -> torch.dtype:
    """bfloat16 where the hardware multiplies it: three times faster, 0.001 CIEDE2000 on the pairs of the benchmark.

    Not with groups, whose weight leaves bfloat16 no digits for the features.
    """
    grouped = context is not None and context.groups is not None
    return torch.float32 if grouped else fast_dtype(features.device)


def _mask_at(mask: Tensor, shape) -> Tensor:
    """(N, h, w) bool: more than half covered; where that leaves nothing (tiny bodies), any coverage."""
    cover = adaptive_avg_pool2d(mask.float()[:, None], tuple(shape))[:, 0]
    small = cover > 0.5
    return torch.where(small.flatten(1).any(1)[:, None, None], small, cover > 0)


def _fine_search(name: str, layer: int, iterations: int, generator: torch.Generator):
    """Function `refine(target, reference, field, reference_mask) -> (field, similarity)`."""
    radius = PATCH_RADIUS[layer]
    if name == "windowed":
        return lambda *pair: windowed.refine(*pair, radius)
    return lambda *pair: patchmatch.refine(*pair, radius, SEARCH_RADIUS[layer], iterations, generator)


def _refine_reverse(refine, target, reference, reverse, target_masks):
    """Search from the reference to each slice; slice by slice, since each has its own mask."""
    fields = [
        refine(reference[n : n + 1], target[n : n + 1], reverse[n : n + 1], target_masks[n])[0]
        for n in range(len(target))
    ]
    return torch.cat(fields)
