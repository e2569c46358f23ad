"""What a folder holds: DICOM slices, wherever they lie in it, or pictures."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from .dicom import is_dicom
from .pictures import PICTURE_ENDINGS
from .plain_pictures import PLAIN_ENDINGS

# of grey volumes, and of the colour volumes that are references
VOLUME_ENDINGS = (".nrrd", ".nhdr", ".mha", ".mhd", ".nii", ".nii.gz")


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


def _volumes_beside(files: list[Path]) -> tuple[str, ...]:
    """The note on volume files, which a folder does not stand for."""
    endings = Counter(end for file in files for end in VOLUME_ENDINGS if file.name.lower().endswith(end))
    if not endings:
        return ()
    shown = ", ".join(f"{count} {ending}" for ending, count in sorted(endings.items()))
    return (f"volume files in the folder itself ({shown}) were not looked at; give one of them by its name",)


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
    slices = {*dicom}
    pictures = [file for file in pictures if file not in slices]  # slices go by any name
    beside = _volumes_beside(files)
    if dicom and (here or len(dicom) >= len(pictures)):
        notes = (f"{len(pictures)} PNG or TIFF pictures beside the DICOM files were left out",) if pictures else ()
        return FolderContents("dicom", tuple(dicom), (*notes, *beside))
    if pictures:
        notes = (f"{len(dicom)} DICOM files in folders below were left out; give their folder",) if dicom else ()
        return FolderContents("pictures", tuple(pictures), (*notes, *beside))
    plain = [file for file in files if file.suffix.lower() in PLAIN_ENDINGS]
    if plain:
        return FolderContents("pictures", tuple(plain), beside)
    raise InputError("the folder holds neither DICOM slices nor PNG, TIFF, BMP or JPEG slices")


def _is_dicom(file: Path) -> bool:
    try:
        return is_dicom(file)
    except OSError:  # not ours to read
        return False
