"""Libraries of references: named folders in the cache, prepared once to body-cut pictures, with an index that says where
each came from.

A library is `library.json` and PNG pictures: cut to their tissue, at most 1024 pixels long, black where there is no
tissue and nowhere else (dark tissue is at least 1), in the order of the body where it is known. `library_folder` turns
what a user names, a folder or a library, into a folder.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import logging
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import Cancelled, InputError, OutputError, SettingsError
from ..features.download import sha256_of
from ..io.usable import usable
from ..io.voxel_data import natural_key
from .given_mask import read_mask
from .photograph import Frame, Reference, prepare_reference
from .pictures import Picture, load_picture, pictures_in
from .tissue_mask import find_tissue

log = logging.getLogger("MedColorLib")

INDEX = "library.json"
LONG_SIDE_PX = 1024  # four times the raster on which slices are matched
MAX_PICTURE_BYTES = 512 << 20
FETCHED = ("visible-human-male",)  # names of those that a server has, see `visible_human.SOURCES`
_MARGIN_PX = 8  # of black around the tissue: whoever cuts the picture again sees its background
_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")
_INSIDE = re.compile(r"(?!\.)[^/\\:\0]+")  # names of files in a folder, on any system
_PICTURE = re.compile(r"[A-Za-z0-9._-]*-[0-9a-f]{8}\.png")


def libraries_folder() -> Path:
    """Where libraries lie: `libraries` in MedColor's cache folder."""
    from ..features.weights import cache_folder

    return cache_folder() / "libraries"


def find_library(name: str) -> Path | None:
    """Folder of the library `name`, or None."""
    folder = libraries_folder() / name
    return folder if _NAME.fullmatch(name) and (folder / INDEX).is_file() else None


def library_folder(library: str | Path) -> Path:
    """Folder of a library given as a folder or by its name; the folder wins.

    Raises:
        InputError: neither exists.
    """
    path = Path(library)
    if path.is_dir():
        return path
    found = find_library(str(library))
    if found is None:
        reason = "a file, not a folder" if path.exists() else f"no such folder, and {no_library(str(library))}"
        raise InputError(f"library {library}: {reason}; name a folder of colour pictures or a library")
    return found


def no_library(name: str) -> str:
    """Half a sentence for messages: that there is no library `name`, and which there are."""
    names = [row["name"] for row in list_libraries()]
    there = f"there are {', '.join(names)}" if names else "there is none yet"
    fetch = f"; run `medcolor library fetch {name}` to get it" if name in FETCHED else ""
    return f"no library is called {name} ({there}){fetch}"


def list_libraries() -> list[dict]:
    """Name, title, credit, licence, pictures, bytes and completeness of each library, by name."""
    folder = libraries_folder()
    rows = []
    for entry in sorted(folder.iterdir()) if folder.is_dir() else ():
        if find_library(entry.name) is None:
            continue
        try:
            index = read_index(entry)
        except InputError as error:
            log.warning("%s", error)
            continue
        size = sum(file.stat().st_size for file in entry.iterdir() if file.is_file())
        known = {key: index[key] for key in ("title", "credit", "licence", "complete")}
        rows.append({"name": entry.name, **known, "pictures": len(index["pictures"]), "bytes": size})
    return rows


def remove_library(name: str) -> None:
    """Delete a library from the cache: its index and the pictures that MedColor prepared. Other files stay, and are named.

    Raises:
        InputError: no such library. OutputError: it cannot be deleted, or is a link to elsewhere.
    """
    folder = libraries_folder() / name
    if not _NAME.fullmatch(name) or not folder.is_dir():
        raise InputError(f"library {name}: {no_library(name)}")
    if folder.is_symlink():
        raise OutputError(f"library {name}: {folder} is a link, which is not followed; delete the link yourself")
    if not (folder / INDEX).is_file():
        raise OutputError(f"library {name}: {folder} holds no {INDEX}, it is none of MedColor's; delete it yourself")
    try:
        for file in _own_files(folder):
            file.unlink()
        others = [file.name for file in folder.iterdir()]
        if not others:
            folder.rmdir()
    except OSError as error:
        raise OutputError(f"library {name}: cannot be deleted ({error.strerror})") from error
    if others:
        log.warning("library %s: %d files that are not MedColor's stay in %s", name, len(others), folder)


def _own_files(folder: Path) -> list[Path]:
    """What MedColor wrote: by the index, or by its names where the index is damaged; the index comes last. No links."""
    try:
        names = {entry["file"] for entry in read_index(folder)["pictures"]}
    except InputError:
        names = {file.name for file in folder.glob("*.png") if _PICTURE.fullmatch(file.name)}
    names |= {file.name for file in folder.glob(".*.part")}
    files = [folder / name for name in sorted(names)]
    return [*(file for file in files if file.is_file() and not file.is_symlink()), folder / INDEX]


def add_library(
    folder: str | Path,
    name: str | None = None,
    credit: str = "",
    licence: str = "",
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> tuple[str, dict]:
    """Prepare a folder of photographs, atlas plates or painted slices as a library; what is there already is kept.

    Args:
        folder: its pictures, subfolders included, in the natural order of their paths, which is taken as the order
            along the body.
        name: small letters, digits, `.`, `_` and `-`; by default made of the folder's name.
        credit, licence: shown with every result.

    Returns:
        Name and index of the library; `left_out` in the index says what could not be used and why.

    Raises:
        InputError: no folder, no picture, or none that can be used.
        SettingsError: no such name. OutputError: the cache folder cannot be written.
        Cancelled: what was prepared is kept, and the next call goes on from there.
    """
    folder = usable(folder, "library add")
    if not folder.is_dir():
        raise InputError(f"library add: no folder {folder}")
    name = checked_name(name if name is not None else re.sub(r"[^a-z0-9._-]+", "-", folder.resolve().name.lower()))
    files = pictures_in(folder, below=True)
    if not files:
        raise InputError(f"library add: {folder.name} holds no picture (PNG, JPEG, TIFF ...)")
    library = LibraryWriter(name, title=folder.resolve().name, credit=credit, licence=licence)
    for number, file in enumerate(files):
        if cancelled is not None and cancelled():
            raise Cancelled(f"library add {name}")
        if progress is not None:
            progress(number / len(files), f"picture {number + 1} of {len(files)}")
        library.add_file(file, file.relative_to(folder).as_posix())
    index = library.finish()
    if not index["pictures"]:
        remove_library(name)
        why = index["left_out"][0]["why"]
        raise InputError(f"library add: none of {len(files)} pictures in {folder.name} can be used; the first: {why}")
    return name, index


def checked_name(name: str) -> str:
    """The name itself.

    Raises:
        SettingsError: it cannot be the name of a library.
    """
    if not _NAME.fullmatch(name):
        raise SettingsError(f"library name {name!r}: use 1 to 64 small letters, digits, '.', '_' or '-'")
    return name


def read_index(folder: Path) -> dict:
    """`library.json` of a library.

    Raises:
        InputError: missing or damaged, or it names a picture that lies elsewhere.
    """
    again = f"run `medcolor library remove {folder.name}` and make it again"
    try:
        index = json.loads((folder / INDEX).read_text(encoding="utf-8"))
        _check_index(index)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(f"library {folder.name}: its {INDEX} is missing or damaged; {again}") from error
    for name in (entry["file"] for entry in index["pictures"]):
        if not _lies_inside(folder, name):
            raise InputError(f"library {folder.name}: its {INDEX} names {name!r}, which lies outside of it; {again}")
    return index


def _lies_inside(folder: Path, name: str) -> bool:
    try:
        return bool(_INSIDE.fullmatch(name)) and not (folder / name).is_symlink()
    except OSError:  # longer than any file's name
        return False


def _check_index(index: dict) -> None:
    """Raises KeyError, TypeError or ValueError for what is no index of ours."""
    texts = [index[key] for key in ("title", "credit", "licence")]
    for entry in index["pictures"]:
        texts += [entry["file"], entry["source"], entry["sha256"], entry["sha256_prepared"]]
        if not 0 <= float(entry["removed"]) <= 1:
            raise ValueError("removed")
    for entry in index["left_out"]:
        texts += [entry["source"], entry["why"]]
    if not all(isinstance(text, str) for text in texts) or not isinstance(index["complete"], bool):
        raise TypeError("texts")


def _is_library(folder: Path) -> bool:
    """Whether pictures in a folder are prepared ones: an index of ours is there, not any file of that name."""
    try:
        state = (folder / INDEX).stat()
    except OSError:
        return False
    return _has_index(folder, state.st_mtime_ns, state.st_size)


@functools.lru_cache(maxsize=8)  # time and size are in the key: a changed index is looked at anew
def _has_index(folder: Path, modified_ns: int, size: int) -> bool:
    try:
        read_index(folder)
    except InputError:
        return False
    return True


def read_reference(path: Path, mask: Path | None = None) -> Reference:
    """Read and cut one colour picture; pictures of a library are cut already.

    Args:
        mask: a picture that says what is tissue; None: its own transparency, or else it is found.

    Raises:
        InputError: not readable, no colour, no tissue.
    """
    picture = load_picture(path)
    if not _is_library(path.parent):
        return _prepared(picture, path.stem, None if mask is None else read_mask(mask, picture.shape))
    rgb, mask = picture.rgb, picture.rgb.any(axis=2)
    if not mask.any():
        raise InputError(f"reference {path.name}: the picture is black; make the library again")
    frame = Frame.around(mask)
    return Reference(frame.cut(rgb), frame.cut(mask), path.stem, 1 - float(mask.mean()), frame=frame)


def _prepared(picture: Picture, name: str, given: np.ndarray | None = None) -> Reference:
    """Cut the tissue out; the frame is that of the whole picture, before it was made smaller.

    Args:
        given: (H, W) bool, the tissue on the whole picture, upright; it outweighs transparency.
    """
    tissue, notes = None, picture.notes
    if given is not None:
        tissue = same_places(given, picture.rgb.shape[:2])
    elif picture.opaque is not None:
        tissue, note = find_tissue(picture.rgb)
        tissue, notes = tissue & picture.opaque, (*notes, *([note] if note else []))
    reference = prepare_reference(picture.rgb, name) if tissue is None else prepare_reference(picture.rgb, name, tissue)
    return replace(reference, frame=reference.frame.scaled(picture.shape), notes=(*notes, *reference.notes))


def same_places(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A mask (H, W) in another size (h, w): what lies at the middle of each pixel."""
    rows, cols = (((np.arange(n) + 0.5) * size / n).astype(int) for n, size in zip(shape, mask.shape))
    return mask[np.ix_(rows, cols)]


def shrunk(reference: Reference, long_side: float) -> Reference:
    """The reference at most `long_side` pixels long; colours at the outline are averaged over tissue only."""
    import cv2

    scale = long_side / max(reference.mask.shape)
    if scale >= 1:
        return reference
    size = tuple(max(1, round(n * scale)) for n in reference.mask.shape[::-1])
    cover = cv2.resize(reference.mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    colors = (reference.rgb * reference.mask[..., None]).astype(np.float32)
    total = cv2.resize(colors, size, interpolation=cv2.INTER_AREA)
    rgb = np.rint(np.clip(total / np.maximum(cover, 1e-6)[..., None], 0, 255)).astype(np.uint8)
    mask = cover > 0.5
    return replace(reference, rgb=rgb, mask=mask)


class LibraryWriter:
    """Writes a library picture by picture; after each, the index on disk is whole, so that work can be taken up again."""

    def __init__(self, name: str, **about: str) -> None:
        """Open the library `name`, or begin it; `about`: title, credit, licence, order, source.

        Nothing is written before the first picture. From there on the library is not complete until `finish`.

        Raises:
            InputError: the library is there and damaged. The methods raise OutputError: the cache folder cannot be written.
        """
        self.folder = libraries_folder() / name
        self.index = {"format": 1, "title": name, "credit": "", "licence": "", "pictures": [], "left_out": []}
        if (self.folder / INDEX).is_file():
            self.index = read_index(self.folder)
        self.index.update({key: value for key, value in about.items() if value}, complete=False)

    def entry(self, source: str) -> dict | None:
        """What is known of a source picture: an entry of `pictures`, or of `left_out`."""
        return next((e for e in self.index["pictures"] + self.index["left_out"] if e["source"] == source), None)

    def has(self, source: str) -> bool:
        """Whether the prepared picture of `source` is there and whole."""
        entry = self.entry(source)
        if entry is None or "file" not in entry:
            return False
        path = self.folder / entry["file"]
        return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == entry["sha256_prepared"]

    def add_file(self, path: Path, source: str, **known) -> None:
        """Prepare one picture and enter it; one that cannot be used is entered as left out, with the reason.

        Args:
            source: its name in the index.
            known: more for the index; `mm_per_pixel` is that of the file and becomes that of the prepared picture.
        """
        try:
            if path.stat().st_size > MAX_PICTURE_BYTES:
                raise InputError(f"{path.name}: more than {MAX_PICTURE_BYTES >> 20} MiB; reduce the picture first")
            digest = sha256_of(path)
        except OSError as error:
            return self.leave_out(source, f"{path.name}: cannot be read ({error.strerror})")
        except InputError as error:
            return self.leave_out(source, str(error))
        if self.has(source) and self.entry(source)["sha256"] == digest:
            return None
        try:
            reference = _prepared(load_picture(path), path.name)
        except InputError as error:
            return self.leave_out(source, str(error), sha256=digest)
        prepared = shrunk(reference, LONG_SIDE_PX)
        if known.get("mm_per_pixel"):
            rows, height = reference.frame.rows, prepared.mask.shape[0]
            known["mm_per_pixel"] *= (rows[1] - rows[0]) / height
        file = re.sub(r"[^A-Za-z0-9._-]+", "-", source.rsplit(".", 1)[0]).strip(".-") + f"-{digest[:8]}.png"
        data = _png(prepared)
        self._write(self.folder / file, data)
        self._forget(source)
        entry = {"file": file, "source": source, "sha256": digest, "removed": round(reference.removed, 4), **known}
        if reference.white != (1.0, 1.0, 1.0):
            entry["white"] = [round(factor, 4) for factor in reference.white]
        self.index["pictures"].append({**entry, "sha256_prepared": hashlib.sha256(data).hexdigest()})
        return self._save()

    def leave_out(self, source: str, why: str, **known) -> None:
        """Enter a picture that cannot be used."""
        log.warning("left out of the library: %s", why)
        self._forget(source)
        self.index["left_out"].append({"source": source, "why": why, **known})
        self._save()

    def finish(self) -> dict:
        """Sort the pictures by their sources' natural order, mark the library as complete, and return its index."""
        self.index["pictures"].sort(key=lambda entry: natural_key(Path(entry["source"])))
        self.index["complete"] = True
        self._save()
        return self.index

    def _forget(self, source: str) -> None:
        for part in ("pictures", "left_out"):
            self.index[part] = [entry for entry in self.index[part] if entry["source"] != source]

    def _save(self) -> None:
        self._write(self.folder / INDEX, (json.dumps(self.index, indent=1) + "\n").encode())

    def _write(self, path: Path, data: bytes) -> None:
        temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(data)
            os.replace(temporary, path)
        except OSError as error:
            raise OutputError(
                f"library {self.folder.name}: cannot be written in the cache folder ({error.strerror}); make room there"
            ) from error
        finally:
            with contextlib.suppress(OSError):  # most often because it is not there
                temporary.unlink()


def _png(reference: Reference) -> bytes:
    """PNG of a prepared reference in a margin: black outside the tissue, at least 1 inside."""
    import cv2

    rgb = np.where(reference.mask[..., None], np.maximum(reference.rgb, 1), 0).astype(np.uint8)
    rgb = np.pad(rgb, ((_MARGIN_PX, _MARGIN_PX), (_MARGIN_PX, _MARGIN_PX), (0, 0)))
    return cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))[1].tobytes()
