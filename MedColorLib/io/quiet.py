"""Libraries that talk on stderr or end the process, kept from it."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import wraps
from pathlib import Path

from ..errors import InputError


def _shared(switch: Callable[..., AbstractContextManager]) -> Callable[..., AbstractContextManager]:
    """Thrown by the first that is inside and put back by the last, in whatever order they leave.

    Files are read by several threads, and a reader that is given up leaves when Python comes to clear it away.
    """
    lock = threading.RLock()  # of the kind that clearing away a reader may enter while this very thread holds it
    inside: dict[tuple, list] = {}

    @wraps(switch)
    @contextmanager
    def held(*names: str) -> Iterator[None]:
        with lock:
            if names not in inside:
                thrown = switch(*names)
                thrown.__enter__()
                inside[names] = [thrown, 0]
            inside[names][1] += 1
        try:
            yield
        finally:
            with lock:
                inside[names][1] -= 1
                if not inside[names][1]:
                    inside.pop(names)[0].__exit__(None, None, None)

    return held


def cv2_log():
    """Where OpenCV keeps how much it says."""
    import cv2

    return cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging  # OpenCV 4, as NumPy 1 needs it; OpenCV 5


@_shared
@contextmanager
def quiet_cv2() -> Iterator[None]:
    """Keep OpenCV's complaints about damaged files off stderr; they become an `InputError`."""
    log = cv2_log()
    level = log.getLogLevel()
    log.setLogLevel(0)  # silent
    try:
        yield
    finally:
        log.setLogLevel(level)


@_shared
@contextmanager
def quiet_itk() -> Iterator[None]:
    """Keep ITK's warnings off stderr."""
    import SimpleITK as sitk

    shown = sitk.ProcessObject.GetGlobalWarningDisplay()
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        yield
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(shown)


@_shared
@contextmanager
def quiet_stderr() -> Iterator[None]:
    """Nothing comes out of the error stream, not from C libraries either: libtiff and OpenJPEG print what they report."""
    if sys.stderr is not None:
        sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # a program without one, as on Windows
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@_shared
@contextmanager
def quiet_package(name: str) -> Iterator[None]:
    """Keep what a package (tifffile, pydicom, nibabel, PIL) says of odd files out of the log, and its warnings.

    What matters is checked and said by us. By the level, which holds for the loggers of its modules, too.
    """
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with _no_warnings():
            yield
    finally:
        logger.setLevel(level)


@_shared
@contextmanager
def _no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def itk_name(path: Path) -> Iterator[str]:
    """A name of the file that SimpleITK may be given: it ends the process at one whose bytes are not UTF-8.

    Such a file is reached through a link in a temporary folder.

    Raises:
        InputError: no link can be made here.
    """
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as folder:
            yield _linked(Path(os.path.abspath(path)), Path(folder))
    else:
        yield str(path)


def _linked(path: Path, folder: Path) -> str:
    """Through the file's folder where its own name can be spoken, so that a header finds its data beside it."""
    try:
        path.name.encode("utf-8")
        target, name = path.parent, f"folder/{path.name}"
    except UnicodeEncodeError:
        target, name = path, "file" + path.suffix.encode("ascii", "ignore").decode()
    try:
        (folder / name.split("/", 1)[0]).symlink_to(target)
    except OSError as error:
        raise InputError("the path is not UTF-8; rename it") from error
    return _checked(str(folder / name))


def _checked(name: str) -> str:
    try:
        name.encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError("neither its path nor the folder for temporary files is UTF-8; rename one of them") from error
    return name
