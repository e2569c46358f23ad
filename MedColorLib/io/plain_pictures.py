"""BMP and JPEG slices, by Pillow: of folders that hold no better ones."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from .grey import grey_of
from .voxel_data import IS_COLOR, check_size

if TYPE_CHECKING:
    from PIL import Image

PLAIN_ENDINGS = (".bmp", ".jpg", ".jpeg")
_KINDS = {"P": "palette pictures", "RGBA": "RGB with transparency", "LA": "grey with transparency"}
_ORIENTATION = 0x0112


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=("BMP", "JPEG")) as image:
                yield image
    except (InputError, MemoryError):
        raise
    except Exception as error:  # decoders promise nothing
        raise InputError("not a readable BMP or JPEG image, or cut short; copy or export it again") from error


def plain_size(path: Path) -> tuple[int, int]:
    """(columns, rows)."""
    with _opened(path) as image:
        return image.size


def read_plain(path: Path, max_bytes: int, notes: set[str]) -> np.ndarray:
    """(rows, columns) uint8, grey.

    Args:
        notes: gets what was decided.

    Raises:
        InputError: colour, damaged, or more than `max_bytes`.
    """
    with _opened(path) as image:
        check_size((*image.size[::-1], len(image.getbands())), np.dtype("u1"), max_bytes)
        if image.format == "JPEG":
            notes.add("JPEG slices have lost fine detail; PNG or TIFF keep it")
        if image.getexif().get(_ORIENTATION, 1) not in (0, 1):
            notes.add("the orientation in the header of the pictures is not applied to slices")
        mode = image.mode
        if mode in ("1", "L"):
            return np.asarray(image.convert("L"))
        if mode not in ("P", "RGB", "RGBA", "LA"):
            raise InputError(IS_COLOR)
        picture = np.asarray(image.convert("RGB") if mode == "P" else image)
    return grey_of(picture, _KINDS.get(mode, "RGB pictures"), notes)
