"""Where results go: links are followed, a file of the same name is replaced only by a whole one, write-protected ones never."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path

from .errors import OutputError

COLOR_ENDINGS = (".nrrd", ".nii.gz", ".nii")


def followed(path: str | os.PathLike) -> Path:
    """The file that `path` means: where it is a link, the file at the link's end, which need not be there yet.

    Raises:
        OutputError: a name that the system cannot take, links that lead round in a circle, a folder, a device or pipe, or a
            file that is write-protected.
    """
    try:
        path, target = Path(path), Path(os.path.realpath(path))
        with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            os.lstat(target)  # pathlib says of an impossible name that it is not there, in some versions of Python
        is_link, is_file, is_there = target.is_symlink(), target.is_file(), target.exists()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OutputError(f"{path}: cannot be the name of a file ({reason}); choose another") from error
    if is_link:
        raise OutputError(f"{path}: the link leads to no file; name another")
    if target.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file")
    if is_there and not is_file:
        raise OutputError(f"{path}: is no file but a device or a pipe; give the name of a file")
    if is_file and not os.access(target, os.W_OK):
        raise OutputError(f"{path}: is write-protected; name another file, or allow writing")
    return target


def check_output_path(path: str | os.PathLike, endings: tuple[str, ...] = COLOR_ENDINGS) -> str:
    """Find out before a long computation whether `path` can be written. Returns its ending.

    Raises:
        OutputError: unknown ending, `path` is a folder, write-protected, or its folder is missing, read-only or full.
    """
    path = Path(path)
    ending = next((ending for ending in endings if path.name.lower().endswith(ending)), None)
    if ending is None:
        raise OutputError(f"{path}: unknown file ending; use one of {', '.join(endings)}")
    target = followed(path)
    folder = target.parent if path.is_symlink() else path.parent
    if not folder.is_dir():
        raise OutputError(f"{path}: the folder {folder} does not exist; create it first")
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
    except OSError as error:
        raise OutputError(f"{path}: cannot write in {folder} ({error.strerror}); choose another folder") from error
    return ending


def leftovers(path: str | os.PathLike) -> list[Path]:
    """Unfinished files of `path` beside it: of a run that was killed, or of one that is still writing.

    Whose they are nobody can tell here, so they are for the user to delete.
    """
    target = Path(os.path.realpath(path))
    own = re.compile(rf"\.[0-9a-f]{{8}}-unfinished-{re.escape(target.name)}")
    try:
        return sorted(file for file in target.parent.iterdir() if own.fullmatch(file.name))
    except OSError:
        return []


@contextlib.contextmanager
def atomic_output(path: str | os.PathLike) -> Iterator[Path]:
    """A temporary name of the same ending; it replaces `path`, or the file that a link `path` leads to, at the end, and is
    removed on any failure.

    Raises:
        OutputError: on any `OSError` inside.
    """
    target = followed(path)
    temporary = target.with_name(f".{secrets.token_hex(4)}-unfinished-{target.name}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}); nothing was left there") from error
    finally:
        with contextlib.suppress(OSError):  # most often because it is not there
            temporary.unlink()
