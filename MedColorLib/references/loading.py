"""Stage *references*: what a user names, pictures, folders, libraries, colour volumes, becomes prepared references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..io.voxel_data import natural_key
from ..volume import ColorVolume
from .color_sections import COLOR_SUFFIXES, read_sections, sections
from .exposure import expose
from .given_mask import mask_beside, masks_for, read_mask
from .library import find_library, no_library, read_index, read_reference, shrunk
from .photograph import PICTURE_SUFFIXES, Reference, prepare_reference

MANY = 16  # of more references, none is kept with a shorter side over SIDE_OF_MANY_PX: 700 then take 1 GB instead of 5
SIDE_OF_MANY_PX = 384  # half again the raster on which slices are matched
_NAMED = 7  # pictures of one group that the plan names one by one


def load_references(
    references: Sequence, exposure: str | float = "auto", masks: Sequence[str | None] | None = None
) -> tuple[Reference, ...]:
    """Prepare references: cut to their tissue, in their usual brightness.

    Args:
        references: paths of colour pictures, of folders (all pictures in them, in natural order) or of colour volumes
            (sampled by transverse slice); names of libraries (`library list`); (h, w, 3) uint8 RGB arrays;
            `ColorVolume`s. A path wins over a library of the same name. One of them may stand alone. Of an array
            (h, w, 4) the fourth channel says what is tissue (above 127).
        exposure: "auto", "off" or a gain; see `exposure`.
        masks: for each of the references a picture of its tissue (for a folder a folder of them), or None or "auto".

    Raises:
        InputError: none given, or one that cannot be used.
    """
    if isinstance(references, (str, Path, np.ndarray, ColorVolume)):
        references = [references]
    prepared: list[Reference] = []
    for number, (item, mask) in enumerate(zip(references, masks_for(masks, len(references)))):
        prepared += _of(item, number, mask)
    if not prepared:
        raise InputError("references: none given; name at least one colour picture (-r REF)")
    return tuple(expose(prepared, exposure))


def _of(item, number: int, mask: Path | None) -> list[Reference]:
    if isinstance(item, np.ndarray):
        return [_of_array(item, f"reference {number + 1}", mask)]
    if mask is not None and (isinstance(item, ColorVolume) or not Path(item).exists() or _is_volume(item)):
        raise InputError(
            f"reference mask {mask.name}: only for photographs, and folders of them; colour volumes and libraries are cut"
        )
    if isinstance(item, ColorVolume):
        return sections(item.rgb, item.ijk_to_ras, item.name)
    path = Path(item)
    if path.is_dir():
        return _of_files(_pictures(path), path.name, mask)
    if _is_volume(path):
        return read_sections(path)
    library = None if path.exists() else find_library(str(item))
    if library is not None:
        return _of_library(library)
    if not path.exists() and not path.suffix:
        raise InputError(f"reference: no file {path}, and {no_library(str(item))}")
    return [read_reference(path, mask)]


def _is_volume(path) -> bool:
    return Path(path).name.lower().endswith(COLOR_SUFFIXES)


def _of_array(picture: np.ndarray, name: str, mask: Path | None) -> Reference:
    tissue = None if mask is None else read_mask(mask, picture.shape[:2])
    if picture.ndim == 3 and picture.shape[2] == 4:
        picture, tissue = picture[..., :3], picture[..., 3] > 127 if tissue is None else tissue
    return prepare_reference(picture, name, tissue)


def _pictures(folder: Path) -> list[Path]:
    found = [p for p in folder.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES]
    if not found:
        raise InputError(f"reference folder {folder.name}: holds no picture (PNG, JPEG or TIFF)")
    return sorted(found, key=natural_key)


def _of_files(files: list[Path], group: str, masks: Path | None = None) -> list[Reference]:
    found = []
    for file in files:
        reference = replace(read_reference(file, masks and mask_beside(masks, file)), group=group)
        shape = reference.mask.shape
        found.append(shrunk(reference, SIDE_OF_MANY_PX * max(shape) / min(shape)) if len(files) > MANY else reference)
    return found


def _of_library(folder: Path) -> list[Reference]:
    index = read_index(folder)
    files = [folder / entry["file"] for entry in index["pictures"]]
    if not files:
        raise InputError(f"library {folder.name}: it holds no picture yet; run the command that made it again")
    state = "" if index["complete"] else ", not complete"
    group = f"library {folder.name}{state}"
    return [
        replace(
            reference,
            removed=entry["removed"],
            credit=index["credit"],
            white=tuple(entry.get("white", (1.0, 1.0, 1.0))),
        )
        for reference, entry in zip(_of_files(files, group), index["pictures"])
    ]


def describe_references(references: Sequence[Reference]) -> str:
    """One line for the plan: each picture by name, or, of many in one folder, library or volume, their number."""
    parts = []
    for group, of_group in groupby(references, key=lambda reference: reference.group):
        members = list(of_group)
        if not group or len(members) <= _NAMED:
            parts += [f"{r.name} ({'; '.join([_removed([r]), *_exposure([r]), *r.notes])})" for r in members]
            continue
        noted = sum(bool(r.notes) for r in members)
        notes = [f"{noted} with a note, see the report"] if noted else []
        about = "; ".join([_removed(members), *_exposure(members), *notes])
        parts.append(f"{len(members)} of {group}, {members[0].name} to {members[-1].name} ({about})")
    return "; ".join(parts + sorted({r.credit for r in references if r.credit}))


def _removed(references: Sequence[Reference]) -> str:
    low, high = (100 * fold(r.removed for r in references) for fold in (min, max))
    return f"{low:.0f} {f'to {high:.0f} ' if len(references) > 1 else ''}% removed as not tissue"


def _exposure(references: Sequence[Reference]) -> list[str]:
    """Of a series all have the same."""
    text = references[0].exposure.describe()
    return [f"exposure {text}"] if text else []
