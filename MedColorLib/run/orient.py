"""Stage *orient*: which way up the references lie; each is turned to lie as the scan does."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..matching.orientation import SURE, Lie, common_way, find_way, mirrored_by_both
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
    """How each lies: seen from the slices asked for and, where these do not tell, from those near them, too."""
    planes = on_grid(sample_slices(prepared.plan.slices))
    lies = [_lie(r, planes, each) for r in references]
    near = _slices_near(prepared)
    if all(lie.margin > SURE for lie in lies) or len(near) == len(prepared.plan.slices):
        return lies
    planes = on_grid(sample_slices(near))
    others = [lie if lie.margin > SURE else _lie(r, planes, each) for lie, r in zip(lies, references)]
    return [max(both, key=lambda lie: lie.margin) for both in zip(lies, others)]


def _lie(reference: ReferenceOnGrid, planes: tuple[np.ndarray, np.ndarray], each: Each) -> Lie:
    own = reference.grey, reference.mask
    return mirrored_by_both(find_way(*planes, *own, each), *planes, *own)


def _slices_near(prepared: Prepared) -> list[int]:
    """The slices to be coloured and the body's others within NEAR_MM: more levels, so that one is like the photograph."""
    chosen, reach = prepared.plan.slices, round(NEAR_MM / prepared.slice_spacing_mm)
    return [int(k) for k in prepared.body.slices if chosen[0] - reach <= k <= chosen[-1] + reach]
