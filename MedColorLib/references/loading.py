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
from .library import find_library, no_library, read_index, read_reference, shrunk
from .photograph import PICTURE_SUFFIXES, Reference, prepare_reference

MANY = 16  # of more references, none is kept with a shorter side over SIDE_OF_MANY_PX: 700 then take 1 GB instead of 5
SIDE_OF_MANY_PX = 384  # half again the raster on which slices are matched
_NAMED = 7  # pictures of one group that the plan names one by one


def load_references(references: Sequence) -> tuple[Reference, ...]:
    """Prepare references.

    Args:
        references: paths of colour pictures, of folders (all pictures in them, in natural order) or of colour volumes
            (sampled by transverse slice); names of libraries (`library list`); (h, w, 3) uint8 RGB arrays;
            `ColorVolume`s. A path wins over a library of the same name. One of them may stand alone.

    Raises:
        InputError: none given, or one that cannot be used.
    """
    if isinstance(references, (str, Path, np.ndarray, ColorVolume)):
        references = [references]
    prepared: list[Reference] = []
    for number, item in enumerate(references):
        prepared += _of(item, number)
    if not prepared:
        raise InputError("references: none given; name at least one colour picture (-r REF)")
    return tuple(prepared)


def _of(item, number: int) -> list[Reference]:
    if isinstance(item, np.ndarray):
        return [prepare_reference(item, f"reference {number + 1}")]
    if isinstance(item, ColorVolume):
        return sections(item.rgb, item.ijk_to_ras, item.name)
    path = Path(item)
    if path.is_dir():
        return _of_files(_pictures(path), path.name)
    if path.name.lower().endswith(COLOR_SUFFIXES):
        return read_sections(path)
    library = None if path.exists() else find_library(str(item))
    if library is not None:
        return _of_library(library)
    if not path.exists() and not path.suffix:
        raise InputError(f"reference: no file {path}, and {no_library(str(item))}")
    return [read_reference(path)]


def _pictures(folder: Path) -> list[Path]:
    found = [p for p in folder.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES]
    if not found:
        raise InputError(f"reference folder {folder.name}: holds no picture (PNG, JPEG or TIFF)")
    return sorted(found, key=natural_key)


def _of_files(files: list[Path], group: str) -> list[Reference]:
    found = []
    for file in files:
        reference = replace(read_reference(file), group=group)
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
    removed = [entry["removed"] for entry in index["pictures"]]
    found = zip(_of_files(files, group), removed)
    return [replace(reference, removed=share, credit=index["credit"]) for reference, share in found]


def describe_references(references: Sequence[Reference]) -> str:
    """One line for the plan: each picture by name, or, of many in one folder, library or volume, their number."""
    parts = []
    for group, of_group in groupby(references, key=lambda reference: reference.group):
        members = list(of_group)
        if not group or len(members) <= _NAMED:
            parts += [f"{r.name} ({100 * r.removed:.0f} % removed as not tissue)" for r in members]
            continue
        removed = [100 * r.removed for r in members]
        span = f"{min(removed):.0f} to {max(removed):.0f} % removed as not tissue"
        parts.append(f"{len(members)} of {group}, {members[0].name} to {members[-1].name} ({span})")
    return "; ".join(parts + sorted({r.credit for r in references if r.credit}))
