"""Masks that a user gives: pictures that say which pixels of a photograph are tissue."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..device import is_out_of_memory
from ..errors import InputError
from ..io.label_picture import read_label_picture
from ..io.quiet import quiet_package
from ..io.usable import usable
from .decoding import (
    ORIENTATION,
    checked_unknown,
    decoding,
    exif_of,
    opened,
    stored_values,
    upright,
)
from .pictures import pictures_in

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


def masks_in(folder: Path) -> dict[str, Path]:
    """Name without ending -> mask, of the masks for a folder of pictures; of two of one name the first counts.

    Raises:
        InputError: a single mask for many pictures.
    """
    if not folder.is_dir():
        raise InputError(
            f"reference mask {folder.name}: the reference is a folder; give a folder of masks of the same names"
        )
    return {file.stem: file for file in sorted(pictures_in(folder), reverse=True)}


def read_mask(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """(h, w) bool, True on tissue, turned as the header says, as the photograph is.

    A picture with transparency counts where it is not transparent; a palette where the index is not 0; labels (grey values
    all below 32) where they are not 0; other grey and colour where it is brighter than half.

    Args:
        shape: (h, w) of the photograph. A picture of another size is not decoded.

    Raises:
        InputError: missing, unreadable, of another size, or nothing in it.
    """
    if usable(path, "reference mask").is_dir():
        raise InputError(f"reference mask {path.name}: a folder, and the reference is one picture; give a picture")
    if not path.is_file():
        raise InputError(f"reference mask: no file {path}")
    try:
        with path.open("rb") as stream, quiet_package("PIL"):
            mask = _decoded(stream, path, tuple(shape))
    except InputError as error:
        raise InputError(f"reference mask {path.name}: {error}") from error
    except OSError as error:
        if is_out_of_memory(error):
            raise
        raise InputError(
            f"reference mask {path.name}: cannot be read ({error.strerror}); check the permissions"
        ) from error
    if not mask.any():
        raise InputError(f"reference mask {path.name}: marks no pixel as tissue; paint tissue white, the rest black")
    return mask


def _decoded(stream: BinaryIO, path: Path, shape: tuple[int, int]) -> np.ndarray:
    """The mask of an open file; its size is known from the header before it is decoded."""
    with decoding():
        image = opened(stream, path.name)
    if image is None:
        tags = checked_unknown(stream)
        size = (tags[256], tags[257]) if tags else shape[::-1]  # where no header tells, OpenCV's own limit holds
    else:
        size = image.size
    if sorted(size) != sorted(shape):  # what lies on its side is turned below
        raise InputError(_of_another_size(size, shape))
    if image is not None:
        tags = exif_of(image)  # which decodes a PNG, as they may follow the pixels
    turned = tags.get(ORIENTATION)
    head = stream.seek(0) or stream.read(26)
    if head[:4] == b"\x89PNG" and head[25:] == bytes([_PALETTE]):
        mask = read_label_picture(path) > 0
    else:
        mask = _mask_of(stored_values(stream))
    mask = upright(mask, turned)
    if mask.shape != shape:
        raise InputError(_of_another_size(mask.shape[::-1], shape))
    return mask


def _of_another_size(size: tuple[int, int], shape: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]} pixels, the photograph has {shape[1]} x {shape[0]}; draw the mask on the photograph itself"


def _mask_of(picture: np.ndarray) -> np.ndarray:
    most = np.iinfo(picture.dtype).max if picture.dtype.kind in "ui" else 1.0
    if picture.ndim == 3 and picture.shape[2] in (2, 4) and picture[..., -1].min() < most:
        return picture[..., -1] > most / 2
    grey = picture if picture.ndim == 2 else picture[..., :3].max(axis=2)
    return grey > 0 if grey.max(initial=0) < _LABELS_BELOW else grey > most / 2
