"""Warnings of references that cannot be of the part of the body that the scan shows; see `matching.wrong_reference`."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..matching.wrong_reference import REMEDY, Outline, doubts, outline
from ..scan.slices import sample_slices

if TYPE_CHECKING:
    from .engine import ReferenceOnGrid
    from .prepare import Prepared

log = logging.getLogger("MedColorLib")

TELLING_MM = 60.0  # of body along the stack; a thin slab of a symmetric part looks alike whichever way up


def reference_warnings(prepared: Prepared, references: Sequence[ReferenceOnGrid], choice: dict[int, int]) -> list[dict]:
    """What the report says, and the log with it; empty where nothing speaks against the references.

    Args:
        references: as they lie, in the order of `prepared.references`. choice: slice -> index of its reference.

    Returns:
        One entry for each doubtful reference: name, first and last slice that it is for, why, and the remedy.
    """
    found = []
    best = max((references[index].lie.margin for index in set(choice.values())), default=0.0)
    if len(prepared.body.slices) * prepared.slice_spacing_mm < TELLING_MM:
        best = float("inf")  # which way up says nothing
    for index in sorted(set(choice.values())):
        own = [k for k, chosen in choice.items() if chosen == index]
        picture, lie = prepared.references[index], references[index].lie
        slices = [_outline_of(prepared, k) for k in sample_slices(own)]
        # of several, one that fits says that the others lie as they should: they may be of other levels
        why = doubts([one for one in slices if one], outline(picture.mask, picture.mask.shape), lie, best)
        if why:
            found.append(
                {"reference": picture.name, "slices": [own[0], own[-1]], "why": "; ".join(why), "remedy": REMEDY}
            )
    for entry in found:
        log.warning("%s", warning_text(entry))
    return found


def warning_text(entry: dict) -> str:
    """One entry of `reference_warnings` as a sentence."""
    first, last = entry["slices"]
    where = f"slices {first} to {last}" if last > first else f"slice {first}"
    return f"reference {entry['reference']} does not seem to show what {where} show: {entry['why']}; {entry['remedy']}"


def _outline_of(prepared: Prepared, k: int) -> Outline | None:
    """Outline of a slice in millimetres; None of an empty one."""
    j0, j1, i0, i1 = prepared.body.boxes[k]
    mask = prepared.body.plane(k)[j0:j1, i0:i1] > 0.5
    if not mask.any():
        return None
    row_mm, column_mm = (float(prepared.volume.spacing_mm[2 - axis]) for axis in prepared.order.axes[1:])
    return outline(mask, ((j1 - j0) * row_mm, (i1 - i0) * column_mm))
