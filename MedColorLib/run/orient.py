"""Stage *orient*: which way up the references lie; each is turned to lie as the scan does."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..matching.orientation import SURE, WAYS, Lie, common_way, find_way, mirrored_in_all
from ..scan.slices import sample_slices
from .on_grid import ReferenceOnGrid
from .prepare import Prepared

if TYPE_CHECKING:
    from ..device import Each

log = logging.getLogger("MedColorLib")

NEAR_MM = 80.0  # a head's height beyond the slices asked for: the photograph's level may lie there
MANY_REFERENCES = 7  # more are taken for one series, whose pictures all lie the same way

OnGrid = Callable[[Sequence[int]], "tuple[np.ndarray, np.ndarray]"]  # slices -> greys, masks (N, H, W)


def turn_references(prepared: Prepared, references: Sequence[ReferenceOnGrid], on_grid: OnGrid, each: Each) -> None:
    """Find out how they lie, each for itself, or many (a series of photographs) together, and turn them in place.

    The plan says which were turned, and which way is a guess; guesses are said in the log, too.
    """
    few = references if len(references) <= MANY_REFERENCES else sample_slices(references)
    lies = _lies(prepared, few, on_grid, each)
    if len(few) < len(references):
        lies = [common_way(lies)] * len(references)
    for reference, lie in zip(references, lies):
        if lie.guess:
            log.warning(
                "reference %s lies %s; compare the result, and turn the picture if it is wrong",
                reference.name,
                lie.describe(),
            )
        elif lie.way != "as it is":
            log.info("reference %s lies %s", reference.name, lie.way)
        reference.turn(lie)
    guesses = [f"{r.name} {r.lie.describe()}" for r in references if r.lie.guess]
    named = [f"{r.name} {r.way}" for r in references if r.way != "as it is" and not r.lie.guess]
    texts = guesses + named
    if texts:
        more = [f"and {len(texts) - MANY_REFERENCES} more"] if len(texts) > MANY_REFERENCES else []
        prepared.plan.steps["orientation"] = "; ".join([*texts[:MANY_REFERENCES], *more])


def _lies(prepared: Prepared, references: Sequence[ReferenceOnGrid], on_grid: OnGrid, each: Each) -> list[Lie]:
    """How each lies: seen from the slices asked for and, where these do not tell, from others of the body, too."""

    def seen_from(slices: Sequence[int], lies: Sequence[Lie], doubted: Callable[[Lie], bool]) -> list[Lie]:
        """How those that are in doubt lie by other slices; the others as they are."""
        if not any(map(doubted, lies)) or len(slices) == len(prepared.plan.slices):
            return list(lies)
        planes = on_grid(sample_slices(slices))
        return [find_way(*planes, r.grey, r.mask, each) if doubted(lie) else lie for lie, r in zip(lies, references)]

    planes = on_grid(sample_slices(prepared.plan.slices))
    lies = [find_way(*planes, r.grey, r.mask, each) for r in references]
    near = seen_from(_slices_near(prepared), lies, lambda lie: lie.margin <= SURE)
    lies = [max(both, key=lambda lie: lie.margin) for both in zip(lies, near)]
    whole = seen_from([int(k) for k in prepared.body.slices], lies, lambda lie: WAYS[lie.way][1])
    return [mirrored_in_all(*both) for both in zip(lies, whole)]


def _slices_near(prepared: Prepared) -> list[int]:
    """The slices to be coloured and the body's others within NEAR_MM: more levels, so that one is like the photograph."""
    chosen, reach = prepared.plan.slices, round(NEAR_MM / prepared.slice_spacing_mm)
    return [int(k) for k in prepared.body.slices if chosen[0] - reach <= k <= chosen[-1] + reach]
