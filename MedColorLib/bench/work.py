"""How much work a stage is, counted by formula from the shapes: operations and bytes that must be moved.

With k the side of a convolution's kernel, P positions of a layer (those of target and reference are as many), C numbers a
position in the pairs that are matched, r the patch radius, G pixels of the raster, and N pixels of the slice:

| stage | operations | bytes |
| --- | --- | --- |
| features, VGG-19 | 18 Cin Cout h w a convolution | each convolution's input, output and kernel, once |
| features, embedded | 2 k^2 Cin Cout h w a convolution | as VGG-19's |
| similarity product | 2 C P^2 | 8 C P, and three times 4 P^2 (written, turned into float32) |
| the same of whole patches (own features in bfloat16) | 18 C P1 P2, P1 and P2 inside the masks | 18 C (P1 + P2) + 2 P1 P2 |
| box sum | 4 r P^2 | two axes: a copy (8 P^2) and 2 r sums in place (12 P^2 each) |
| argmax | 2 P^2 comparisons, both directions | four passes of 4 P^2 (two maxima, a mask read, written); of patches 4 P1 P2 |
| colour | 96 G sums, 32 G + 32 N reading, 36 G smoothing, 60 N conversion | 1152 G + 144 N |
| prepare, writing | not counted | the arrays read, once |
"""

from __future__ import annotations

from dataclasses import dataclass

from ..matching.analogy import PATCH_RADIUS

_CHANNELS, _DEPTHS = (64, 128, 256, 512, 512), (2, 2, 4, 4, 1)
# Convolutions of `features.contrast_net`: channels in, channels out, side of the kernel, pixels of the picture per position.
_OWN_CONVOLUTIONS = (
    (12, 32, 3, 4), (32, 48, 3, 16), *((48, 48, 3, 16),) * 2,  # stem and quarter
    (48, 64, 3, 64), *((64, 64, 3, 64),) * 3, (128, 64, 1, 64),  # eighth
    (112, 64, 3, 16), (112, 32, 1, 16),  # joined, head
)  # fmt: skip
_OWN_COARSEST = ((64, 64, 3, 256),) * 3


@dataclass(frozen=True)
class Work:
    """Operations (a multiplication and an addition are two; None: not counted), bytes, and the type of the numbers."""

    operations: float | None
    moved: float
    kind: str = "float32"


def formulas() -> str:
    """The table above as one sentence."""
    meaning = " ".join(__doc__.split("\n\n")[1].split())
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in __doc__.splitlines() if line[:1] == "|"]
    counted = (f"{stage}: {operations} operations; bytes: {moved}" for stage, operations, moved in rows[2:])
    return f"{meaning} {'. '.join(counted)}."


def vgg19_work(pixels: int, kind: str) -> Work:
    """Layers 1 to 5 of a slice of `pixels`; the first convolution has two planes and is float32."""
    operations, moved, size = 0.0, 0.0, 2 if kind == "bfloat16" else 4
    inputs = 2
    for layer, (outputs, depth) in enumerate(zip(_CHANNELS, _DEPTHS)):
        area = pixels / 4**layer
        for _ in range(depth):
            operations += 18 * inputs * outputs * area
            moved += ((inputs + outputs) * area + 9 * inputs * outputs) * (4 if inputs == 2 else size)
            inputs = outputs
    return Work(operations, moved, kind)


def own_work(pixels: int, context: float) -> Work:
    """The own features of a slice of `pixels`; without `context` the coarsest level is left out."""
    operations, moved = 0.0, 0.0
    for inputs, outputs, kernel, share in _OWN_CONVOLUTIONS + (_OWN_COARSEST if context else ()):
        area = pixels / share
        operations += 2 * kernel**2 * inputs * outputs * area
        moved += 4 * ((inputs + outputs) * area + kernel**2 * inputs * outputs)
    return Work(operations, moved)


def matching_work(positions: dict[int, int], channels: dict[int, int]) -> dict[str, Work]:
    """Stage -> work of the exhaustive search, both directions.

    Args:
        positions: layer -> P. channels: layer -> C.
    """
    product = box = argmax = Work(0.0, 0.0)
    for layer, count in positions.items():
        pairs, radius = float(count) ** 2, PATCH_RADIUS[layer]
        product = _plus(product, 2 * channels[layer] * pairs, 8 * channels[layer] * count + 12 * pairs)
        box = _plus(box, 4 * radius * pairs, 2 * (8 + 24 * radius) * pairs)
        argmax = _plus(argmax, 2 * pairs, 16 * pairs)
    return {"similarity product": product, "box sum": box, "argmax": argmax}


def patches_work(count: float, count2: float, channels: int) -> dict[str, Work]:
    """Stage -> work of the search by products of whole patches of 3 x 3. count, count2: P1, P2."""
    pairs, numbers = count * count2, 9 * channels
    product = Work(2 * numbers * pairs, 2 * numbers * (count + count2) + 2 * pairs, "bfloat16")
    return {"similarity product": product, "argmax": Work(2 * pairs, 4 * pairs)}


def color_work(raster: int, pixels: int) -> Work:
    """Regression, remainder and conversion of one slice."""
    return Work(164.0 * raster + 92.0 * pixels, 1152.0 * raster + 144.0 * pixels)


def _plus(work: Work, operations: float, moved: float) -> Work:
    return Work(work.operations + operations, work.moved + moved, work.kind)
