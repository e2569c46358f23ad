"""Stability of features and matching: zero vectors, constant and periodic pictures, half precision, tiny maps."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from ..features import make_extractor
from ..features.self_similarity import SelfSimilarity
from ..matching.analogy import deep_image_analogy, response_weight, unit
from ..matching.fields import exact, patchmatch, windowed
from ..matching.fields.field import average_vote, identity, upsample
from .case import Case, at_most, holds

_SIDE = 24


def cases() -> Iterator[Case]:
    """Features, then the searches, then the analogy as a whole."""
    yield from _feature_cases()
    for name, picture in (
        ("constant", torch.ones(1, 8, _SIDE, _SIDE)),
        ("periodic", _stripes()),
        ("zero", torch.zeros(1, 8, _SIDE, _SIDE)),
    ):
        yield from _search_cases(name, unit(picture))
    yield from _field_cases()
    yield from _analogy_cases()


def _stripes() -> Tensor:
    phase = torch.arange(_SIDE) * (torch.pi / 2)
    row = torch.stack([torch.cos(phase + c) for c in range(8)])
    return row[None, :, None, :].expand(1, 8, _SIDE, _SIDE).contiguous()


def _feature_cases() -> Iterator[Case]:
    def case(name, condition, expected, check):
        return Case("features", name, condition, expected, check)

    yield case("zero vector", "float32", "stays zero", at_most(lambda: unit(torch.zeros(1, 64, 3, 3)).abs().max(), 0.0))
    for dtype in (torch.float16, torch.bfloat16, torch.float32):
        for value, words in ((6e4, "6e4"), (1e-7, "1e-7")):

            def length(dtype=dtype, value=value) -> float:
                return float((unit(torch.full((1, 512, 2, 2), value, dtype=dtype)).norm(dim=1) - 1).abs().max())

            kind = str(dtype).removeprefix("torch.")
            yield case("length 1", f"{kind}, 512 values of {words}", "length 1 to 0.01", at_most(length, 0.01))
    constant = at_most(lambda: (response_weight(torch.full((1, 8, 4, 4), 3.0), 0.8) - 0.8).abs().max(), 1e-5)
    yield case("response weight", "constant map", "strong everywhere", constant)
    for name, picture in (
        ("black", torch.zeros(1, 1, 64, 64)),
        ("white", torch.ones(1, 1, 64, 64)),
        ("one bright pixel", _spot()),
    ):

        def finite(extractor, layers, picture=picture) -> bool:
            found = extractor.extract(picture, layers)
            return all(bool(torch.isfinite(unit(values)).all()) for values in found.values())

        alike = holds(lambda finite=finite: finite(SelfSimilarity(), (5, 4, 3, 2, 1)), "finite")
        yield case("self-similarity", name, "finite", alike)
        own = holds(lambda finite=finite: finite(make_extractor("embedded"), (5, 4, 3)), "finite")
        yield case("own features", name, "finite", own)
    like = at_most(lambda: torch.nan_to_num(_black_descriptor(), nan=9.0).norm() - 1, 1e-5)
    yield case("descriptor for recommendation", "black slice", "finite, length at most 1", like)


def _black_descriptor() -> Tensor:
    return make_extractor("embedded").descriptor(torch.zeros(1, 1, 64, 64))


def _spot() -> Tensor:
    picture = torch.zeros(1, 1, 64, 64)
    picture[..., 30, 30] = 1
    return picture


def _search_cases(name: str, features: Tensor) -> Iterator[Case]:
    mask = torch.zeros(_SIDE, _SIDE, dtype=torch.bool)
    mask[4:20, 4:20] = True
    start = identity(1, _SIDE, _SIDE).clamp(4 * _SIDE + 4, 19 * _SIDE + 19)
    start = torch.where(mask.reshape(-1)[start], start, torch.full_like(start, 12 * _SIDE + 12))

    def with_patchmatch(seed: int = 0) -> tuple[Tensor, Tensor]:
        generator = torch.Generator().manual_seed(seed)
        return patchmatch.refine(features, features, start, mask, 1, 6, 4, generator)

    searches = {
        "exact search": lambda: exact.search(features, features, 1, mask[None], mask, False)[:2],
        "windowed search": lambda: windowed.refine(features, features, start, mask, 1),
        "PatchMatch": with_patchmatch,
    }
    for search, call in searches.items():

        def stays_inside(call=call) -> bool:
            field, similarity = call()
            return bool(mask.reshape(-1)[field].all() and torch.isfinite(similarity).all())

        def repeats(call=call) -> bool:
            return all(torch.equal(a, b) for a, b in zip(call(), call()))

        yield Case(
            search,
            f"{name} picture",
            "24 x 24",
            "matches inside the mask, finite",
            holds(stays_inside, "inside the mask"),
        )
        yield Case(search, f"{name} picture", "run twice", "the same field", holds(repeats, "the same field"))
    if name != "periodic":
        inner = holds(lambda: torch.equal(with_patchmatch()[0][0, 6:18, 6:18], start[0, 6:18, 6:18]), "the start")
        yield Case("PatchMatch", f"{name} picture", "away from the border", "the start is kept", inner)

    def loss() -> Tensor:
        return (patchmatch.patch_similarity(features, features, start, 1) - with_patchmatch()[1]).max()

    gain = at_most(loss, 1e-6)
    yield Case("PatchMatch", f"{name} picture", "against its start", "no match is worse", gain)


def _field_cases() -> Iterator[Case]:
    def in_bounds(shape, finer) -> bool:
        field = upsample(identity(1, *shape), finer, shape[1])
        return bool(field.min() >= 0 and field.max() < finer[0] * finer[1])

    for shape, finer in (((1, 1), (1, 1)), ((1, 1), (2, 2)), ((3, 5), (5, 9)), ((3, 5), (6, 10))):
        check = holds(lambda s=shape, f=finer: in_bounds(s, f), "in bounds")
        yield Case("field", "upsampled", f"{shape} to {finer}", "in bounds", check)
    for side in (1, 2, 3, 7):
        same = at_most(lambda s=side: (average_vote(_ramp(s), identity(1, s, s), 2) - _ramp(s)).abs().max(), 1e-6)
        yield Case("vote", "identity field", f"{side} x {side}", "the picture itself, 1e-6", same)


def _ramp(side: int) -> Tensor:
    return torch.arange(side * side, dtype=torch.float32).view(1, 1, side, side) / side**2


def _analogy_cases() -> Iterator[Case]:
    extract = SelfSimilarity().extract
    layers = (5, 4, 3, 2, 1)

    def match(picture: Tensor, mask: Tensor, seed: int = 0, search: str = "windowed"):
        features = extract(picture, layers)
        return deep_image_analogy(features, features, mask[None], mask, 1, seed=seed, fine_search=search)

    whole, dot = torch.ones(48, 48, dtype=torch.bool), torch.zeros(48, 48, dtype=torch.bool)
    dot[24, 24] = True
    noise = torch.rand(1, 1, 48, 48, generator=torch.Generator().manual_seed(1))
    for name, picture, mask in (
        ("constant picture", torch.full((1, 1, 48, 48), 0.5), whole),
        ("noise", noise, whole),
        ("body of one pixel", noise, dot),
        ("no body at all", noise, torch.zeros(48, 48, dtype=torch.bool)),
    ):

        def finite(picture=picture, mask=mask) -> bool:
            found = match(picture, mask)
            return bool(
                torch.isfinite(found.similarity).all() and found.field.min() >= 0 and found.field.max() < 48 * 48
            )

        yield Case("analogy", name, "48 x 48, five layers", "a field in bounds", holds(finite, "in bounds"))
    for search in ("windowed", "patchmatch"):
        same = holds(
            lambda s=search: torch.equal(match(noise, whole, 3, s).field, match(noise, whole, 3, s).field),
            "the same field",
        )
        yield Case("analogy", "same seed", search, "the same field", same)
    itself = at_most(
        lambda: (match(noise, whole).field[0] != identity(1, 48, 48)[0]).float().mean(), 0.01, " of the positions"
    )
    yield Case("analogy", "picture against itself", "noise", "identity, 1 % of positions at most", itself)
