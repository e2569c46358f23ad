"""Stage *references*: what a user names, pictures, folders, libraries, colour volumes, becomes prepared references."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..io.folders import VOLUME_ENDINGS
from ..io.usable import usable
from ..volume import ColorVolume
from .color_sections import read_sections, sections
from .exposure import expose
from .given_mask import masks_for, masks_in, read_mask
from .library import LONG_SIDE_PX, find_library, no_library, read_index, read_reference, same_places, shrunk
from .photograph import Reference, prepare_reference
from .pictures import LONG_SIDE_PX as READ_SIDE_PX
from .pictures import pictures_in, reduced

log = logging.getLogger("MedColorLib")

MANY = 16  # of more references, none is kept with a shorter side over SIDE_OF_MANY_PX: 700 then take 1 GB instead of 5
SIDE_OF_MANY_PX = 384  # half again the raster on which slices are matched
_LEFT_OUT = "left out of"
_MASKS_FOR = "only for photographs, and folders of them; colour volumes and libraries are cut"
_NAMED = 7  # pictures of one group that the plan names one by one


def load_references(
    references: Sequence, exposure: str | float = "auto", masks: Sequence[str | None] | None = None
) -> tuple[Reference, ...]:
    """Prepare references: cut to their tissue, in their usual brightness, at most 1024 pixels long each.

    Args:
        references: paths of colour pictures, of folders (all pictures in them, in natural order) or of colour volumes
            (sampled by transverse slice); names of libraries (`library list`); (h, w, 3) uint8 RGB arrays;
            `ColorVolume`s. A path wins over a library of the same name. One of them may stand alone. Of an array
            (h, w, 4) the fourth channel says what is tissue (above 127).
        exposure: "auto", "off" or a gain; see `exposure`.
        masks: for each of the references a picture of its tissue (for a folder a folder of them), or None or "auto".

    Returns:
        References with different names. A picture of a folder that cannot be used is left out: the log and the notes of
        the folder's first reference say so.

    Raises:
        InputError: none given, or one that cannot be used; of a folder, none that can.
    """
    if isinstance(references, (str, os.PathLike, np.ndarray, ColorVolume)):
        references = [references]
    try:
        references = list(references)
    except TypeError as error:
        raise InputError(
            f"references: expected paths, names of libraries or arrays, got {type(references).__name__}"
        ) from error
    prepared: list[Reference] = []
    for number, (item, mask) in enumerate(zip(references, masks_for(masks, len(references)))):
        prepared += [shrunk(reference, LONG_SIDE_PX) for reference in _of(item, number, mask)]
    if not prepared:
        raise InputError("references: none given; name at least one colour picture (-r REF)")
    return tuple(expose(_told_apart(prepared), exposure))


def _of(item, number: int, mask: Path | None) -> list[Reference]:
    if isinstance(item, np.ndarray):
        return [_of_array(item, f"reference {number + 1}", mask)]
    if isinstance(item, ColorVolume):
        if mask is not None:
            raise InputError(f"reference mask {mask.name}: {_MASKS_FOR}")
        return sections(item.rgb, item.ijk_to_ras, item.name)
    if not isinstance(item, (str, os.PathLike)):
        kind = type(item).__name__
        raise InputError(f"reference {number + 1}: expected a path, the name of a library or an array, got {kind}")
    if not os.fspath(item).strip():
        raise InputError("reference: the name is empty; name a colour picture, a folder, a colour volume or a library")
    path = usable(item, "reference")
    if mask is not None and (not path.exists() or _is_volume(path)):
        raise InputError(f"reference mask {mask.name}: {_MASKS_FOR}")
    if path.is_dir():
        return _of_files(_pictures(path), path.name or path.resolve().name, mask)
    if _is_volume(path):
        return read_sections(path)
    library = None if path.exists() else find_library(str(item))
    if library is not None:
        return _of_library(library)
    if not path.exists() and not path.suffix:
        raise InputError(f"reference: no file {path}, and {no_library(str(item))}")
    return [read_reference(path, mask)]


def _is_volume(path) -> bool:
    return Path(path).name.lower().endswith(VOLUME_ENDINGS)


def _of_array(picture: np.ndarray, name: str, mask: Path | None) -> Reference:
    tissue = None if mask is None else read_mask(mask, picture.shape[:2])
    if picture.ndim == 3 and picture.shape[2] == 4:
        picture, tissue = picture[..., :3], picture[..., 3] > 127 if tissue is None else tissue
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or not picture.size:
        return prepare_reference(picture, name, tissue)  # which says what is wrong
    small = reduced(picture, READ_SIDE_PX)
    reference = prepare_reference(small, name, None if tissue is None else same_places(tissue, small.shape[:2]))
    return replace(reference, frame=reference.frame.scaled(picture.shape[:2]))


def _pictures(folder: Path) -> list[Path]:
    found = pictures_in(folder)
    if not found:
        raise InputError(f"reference folder {folder.name}: holds no picture (PNG, JPEG, TIFF ...)")
    return found


def _of_files(files: list[Path], group: str, masks: Path | None = None) -> list[Reference]:
    """References of the files that can be used; what is left out is said in the notes of the first."""
    found: list[Reference] = []
    left_out: list[str] = []
    of_name = masks_in(masks) if masks else {}
    for file in files:
        mask = of_name.get(file.stem)
        try:
            reference = replace(read_reference(file, mask), group=group)
            if masks and not mask:
                said = f"no mask of its name in {masks.name}: its tissue was found"
                reference = replace(reference, notes=(*reference.notes, said))
        except InputError as error:
            log.warning("left out of %s: %s", group, error)
            left_out.append(f"{_LEFT_OUT} {group}: {error}")
            continue
        shape = reference.mask.shape
        found.append(shrunk(reference, SIDE_OF_MANY_PX * max(shape) / min(shape)) if len(files) > MANY else reference)
    if not found:
        raise InputError(
            f"reference folder {group}: none of its {len(files)} pictures can be used; the first: "
            f"{left_out[0].partition(': ')[2]}"
        )
    found[0] = replace(found[0], notes=(*found[0].notes, *left_out))
    return found


def _of_library(folder: Path) -> list[Reference]:
    index = read_index(folder)
    entries = {Path(entry["file"]).stem: entry for entry in index["pictures"]}
    if not entries:
        raise InputError(f"library {folder.name}: it holds no picture yet; run the command that made it again")
    state = "" if index["complete"] else ", not complete"
    found = _of_files([folder / entry["file"] for entry in index["pictures"]], f"library {folder.name}{state}")
    return [_from_index(reference, entries[reference.name], index["credit"]) for reference in found]


def _from_index(reference: Reference, entry: dict, credit: str) -> Reference:
    white = tuple(entry.get("white", (1.0, 1.0, 1.0)))
    return replace(reference, removed=entry["removed"], credit=credit, white=white)


def _told_apart(references: Sequence[Reference]) -> list[Reference]:
    """The references, those of one name numbered: section, section (2), ..."""
    taken: set[str] = set()
    found = []
    for reference in references:
        name, count = reference.name, 1
        while name in taken:
            count += 1
            name = f"{reference.name} ({count})"
        taken.add(name)
        found.append(reference if count == 1 else replace(reference, name=name))
    return found


def describe_references(references: Sequence[Reference]) -> str:
    """One line for the plan: each picture by name, or, of many in one folder, library or volume, their number."""
    parts = []
    for group, of_group in groupby(references, key=lambda reference: reference.group):
        members = list(of_group)
        if not group or len(members) <= _NAMED:
            parts += [f"{r.name} ({'; '.join([_removed([r]), *_exposure([r]), *r.notes])})" for r in members]
            continue
        noted = sum(any(not note.startswith(_LEFT_OUT) for note in r.notes) for r in members)
        notes = [f"{noted} with a note, see the report"] if noted else []
        about = "; ".join([_removed(members), *_exposure(members), *notes, *_left_out(members)])
        parts.append(f"{len(members)} of {group}, {members[0].name} to {members[-1].name} ({about})")
    return "; ".join(parts + sorted({r.credit for r in references if r.credit}))


def _left_out(references: Sequence[Reference]) -> list[str]:
    """What could not be used of a folder, the first few by name."""
    texts = [note for r in references for note in r.notes if note.startswith(_LEFT_OUT)]
    return texts[:_NAMED] + (
        [f"and {len(texts) - _NAMED} more left out, see the report"] if len(texts) > _NAMED else []
    )


def _removed(references: Sequence[Reference]) -> str:
    low, high = (100 * fold(r.removed for r in references) for fold in (min, max))
    return f"{low:.0f} {f'to {high:.0f} ' if len(references) > 1 else ''}% removed as not tissue"


def _exposure(references: Sequence[Reference]) -> list[str]:
    """Of a series all have the same."""
    text = references[0].exposure.describe()
    return [f"exposure {text}"] if text else []
