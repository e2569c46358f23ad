"""Colours that are grey: pictures whose channels are equal."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from .voxel_data import IS_COLOR


def grey_of(picture: np.ndarray, kind: str, notes: set[str]) -> np.ndarray:
    """(j, i) of a picture (j, i, channels) whose colour channels are equal; a last channel of 2 or 4 is transparency.

    Args:
        kind: what the pictures are called in the note.
        notes: gets what was decided.

    Raises:
        InputError: the channels differ.
    """
    channels = picture.shape[-1]
    colors = picture[..., : channels - 1] if channels in (2, 4) else picture
    if colors.shape[-1] not in (1, 3) or not (colors == colors[..., :1]).all():
        raise InputError(IS_COLOR)
    notes.add(f"grey saved as {kind}: the channels are equal, one of them is read")
    if channels in (2, 4) and picture[..., -1].min() != picture[..., -1].max():
        notes.add("the transparency of the pictures is left out")
    return np.ascontiguousarray(colors[..., 0])
