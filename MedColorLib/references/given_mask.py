"""Masks that a user gives: pictures that say which pixels of a photograph are tissue."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..io.pictures import quiet_cv2

FIND = "auto"  # in place of a mask: find the tissue
_LABELS_BELOW = 32  # grey pictures whose values are all smaller hold labels, not brightness
_PALETTE = 3  # colour type of the PNG specification


def masks_for(masks: Sequence[str | os.PathLike | None] | None, count: int) -> list[Path | None]:
    """One mask, or None where the tissue is to be found, for each of `count` references.

    Raises:
        InputError: another number of masks.
    """
    if not masks:
        return [None] * count
    if len(masks) != count:
        raise InputError(
            f"reference masks: {len(masks)} for {count} references; give one for each, in their order, or the word {FIND}"
        )
    return [None if mask is None or str(mask) == FIND else Path(mask) for mask in masks]


def mask_beside(mask: Path, picture: Path) -> Path | None:
    """The mask of one picture of a folder: that of the same name in a folder of masks; None where there is none.

    Raises:
        InputError: a single mask for many pictures.
    """
    if not mask.is_dir():
        raise InputError(
            f"reference mask {mask.name}: the reference is a folder; give a folder of masks of the same names"
        )
    found = sorted(file for file in mask.iterdir() if file.stem == picture.stem and file.is_file())
    return found[0] if found else None


def read_mask(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """(h, w) bool, True on tissue.

    A picture with transparency counts where it is not transparent; a palette where the index is not 0; labels (grey values
    all below 32) where they are not 0; other grey and colour where it is brighter than half.

    Args:
        shape: (h, w) of the photograph.

    Raises:
        InputError: missing, unreadable, of another size, or nothing in it.
    """
    import cv2

    if not path.is_file():
        raise InputError(f"reference mask: no file {path}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"reference mask {path.name}: cannot be read ({error.strerror}); check the permissions"
        ) from error
    with quiet_cv2():
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if picture is None:
        raise InputError(f"reference mask {path.name}: not a picture that can be read; save it as PNG")
    mask = _palette_mask(path) if data[:4] == b"\x89PNG" and data[25:26] == bytes([_PALETTE]) else _mask_of(picture)
    if mask.shape != tuple(shape):
        raise InputError(
            f"reference mask {path.name}: {mask.shape[1]} x {mask.shape[0]} pixels, the photograph has {shape[1]} x "
            f"{shape[0]}; draw the mask on the photograph itself"
        )
    if not mask.any():
        raise InputError(f"reference mask {path.name}: marks no pixel as tissue; paint tissue white, the rest black")
    return mask


def _palette_mask(path: Path) -> np.ndarray:
    from ..io.label_picture import read_label_picture

    return read_label_picture(path) > 0


def _mask_of(picture: np.ndarray) -> np.ndarray:
    most = np.iinfo(picture.dtype).max if picture.dtype.kind in "ui" else 1.0
    if picture.ndim == 3 and picture.shape[2] in (2, 4) and picture[..., -1].min() < most:
        return picture[..., -1] > most / 2
    grey = picture if picture.ndim == 2 else picture[..., :3].max(axis=2)
    return grey > 0 if grey.max(initial=0) < _LABELS_BELOW else grey > most / 2
