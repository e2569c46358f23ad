"""What a folder holds: DICOM slices, wherever they lie in it, or pictures."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from .dicom import is_dicom
from .pictures import PICTURE_ENDINGS
from .plain_pictures import PLAIN_ENDINGS


@dataclass(frozen=True)
class FolderContents:
    """The files to read of a folder: `kind` is "dicom" or "pictures"; `notes` say what lies beside them."""

    kind: str
    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()


def files_in(folder: Path) -> list[Path]:
    """Files of the folder itself, without hidden ones."""
    return [file for file in folder.iterdir() if not file.name.startswith(".") and file.is_file()]


def files_below(folder: Path) -> Iterator[Path]:
    """Files of the folder and of all folders in it, without hidden ones; linked folders are not entered."""
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(parent, name) for name in names if not name.startswith(".") and Path(parent, name).is_file())


def look_into(folder: Path, below: bool = True) -> FolderContents:
    """DICOM slices in the whole tree (as on a DICOM medium), or the pictures of the folder itself where those are more.

    BMP and JPEG count where there is nothing else.

    Args:
        below: False: do not look into the folders in it.

    Raises:
        InputError: neither.
    """
    files = files_in(folder)
    pictures = [file for file in files if file.suffix.lower() in PICTURE_ENDINGS]
    dicom = [file for file in (files_below(folder) if below else files) if _is_dicom(file)]
    here = any(file.parent == folder for file in dicom)
    if dicom and (here or len(dicom) >= len(pictures)):
        notes = (f"{len(pictures)} PNG or TIFF pictures beside the DICOM files were left out",) if pictures else ()
        return FolderContents("dicom", tuple(dicom), notes)
    if pictures:
        notes = (f"{len(dicom)} DICOM files in folders below were left out; give their folder",) if dicom else ()
        return FolderContents("pictures", tuple(pictures), notes)
    plain = [file for file in files if file.suffix.lower() in PLAIN_ENDINGS]
    if plain:
        return FolderContents("pictures", tuple(plain))
    raise InputError("the folder holds neither DICOM slices nor PNG, TIFF, BMP or JPEG slices")


def _is_dicom(file: Path) -> bool:
    try:
        return is_dicom(file)
    except OSError:  # not ours to read
        return False
