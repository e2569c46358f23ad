"""One file over HTTP: taken up again where it broke off, bounded in size, checked, never half there under its name."""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import logging
import os
import re
import shutil
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Callable

from ..errors import Cancelled, MedColorError, SettingsError, WeightsError

_logger = logging.getLogger("MedColorLib")
_CHUNK_BYTES = 1 << 18
_TIMEOUT_S = 30.0
_BARREN_ATTEMPTS = 3  # connections in a row that bring nothing before giving up


@dataclass(frozen=True)
class Subject:
    """What is being downloaded, for messages, and how the server is reached.

    Attributes:
        noun: in the plural. error: what is raised.
        otherwise: what a user without a connection can do instead.
        opener: decides which redirects are followed.
    """

    noun: str = "weights"
    error: type[MedColorError] = WeightsError
    otherwise: str = "copy the file from another machine and point MEDCOLOR_WEIGHTS to it"
    opener: urllib.request.OpenerDirector = field(default_factory=urllib.request.build_opener)


def download(
    url: str,
    target: Path,
    *,
    size: int,
    sha256: str | None,
    subject: Subject | None = None,
    progress: Callable[[int, int], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Path:
    """Download a file of known size and hash to `target`, by way of `target` + ".part".

    Args:
        url: http or https.
        target: file to make; its folder is made too.
        size: bytes, exactly.
        sha256: 64 hexadecimal digits; None where nobody knows it, and then the caller has to check what came.
        subject: weights, where nothing else is said.
        progress: called with (bytes present, size).
        cancelled: asked between chunks of 256 KiB.

    Raises:
        SettingsError: another kind of URL.
        WeightsError, or the subject's: offline, HTTP error, another size or hash (what came is deleted), disk full or not
            writable.
        Cancelled: the .part file stays, and the next call goes on from there.
    """
    subject = subject or Subject()
    if urllib.parse.urlsplit(url).scheme not in ("http", "https"):
        raise SettingsError(f"{subject.noun} URL {url!r}: only http and https are supported")
    part = target.with_name(target.name + ".part")
    _make_room(part, size, subject)

    def on_bytes(present: int) -> None:
        if cancelled is not None and cancelled():
            raise Cancelled(f"download of {url}")
        if progress is not None:
            progress(present, size)

    barren = 0
    while (present := _size_of(part)) < size:
        if barren == _BARREN_ATTEMPTS:
            raise subject.error(
                f"{url}: the connection ended {barren} times after {present} of {size} bytes; run the same command "
                "again to go on from there"
            )
        _receive(url, part, size, on_bytes, subject)
        barren = barren + 1 if _size_of(part) <= present else 0
    _check(url, part, size, sha256, subject)
    os.replace(part, target)
    return target


def _size_of(part: Path) -> int:
    return part.stat().st_size if part.exists() else 0


def _make_room(part: Path, size: int, subject: Subject) -> None:
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(part.parent).free
    except OSError as error:
        raise _unwritable(part, error, subject) from error
    if free < size - _size_of(part):
        raise subject.error(
            f"{part.parent}: {free >> 20} MiB free, {(size - _size_of(part)) >> 20} MiB needed; make room, or move the "
            "cache folder"
        )


def _unwritable(part: Path, error: OSError, subject: Subject) -> MedColorError:
    return subject.error(f"{part}: cannot be written ({error.strerror}); make the folder writable or make room there")


def _receive(url: str, part: Path, size: int, on_bytes: Callable[[int], None], subject: Subject) -> None:
    """Append to the .part file what one connection brings."""
    with connection_errors(url, subject):
        headers = {"Range": f"bytes={_size_of(part)}-"} if _size_of(part) else {}
        with connect(url, subject, headers) as response:
            start = _checked_start(url, response, _size_of(part), size, subject)
            try:
                with part.open("r+b" if part.exists() else "wb") as file:
                    file.truncate(start)
                    file.seek(start)
                    _copy(response, file, size, on_bytes)
            except OSError as error:
                raise _unwritable(part, error, subject) from error


@contextlib.contextmanager
def connection_errors(url: str, subject: Subject) -> Iterator[None]:
    """Refusals and failures of the network as the subject's error; the cause tells which it was."""
    try:
        yield
    except urllib.error.HTTPError as error:
        error.close()
        raise subject.error(
            f"{url}: the server answers {error.code} {error.reason}; try later, or another URL"
        ) from error
    except (OSError, http.client.HTTPException) as error:  # URLError, timeouts and TLS failures are OSErrors
        reason = getattr(error, "reason", None) or error
        raise subject.error(
            f"{url}: no connection ({reason}); check the network and the proxy settings (https_proxy), or "
            f"{subject.otherwise}"
        ) from error


def connect(url: str, subject: Subject, headers: dict[str, str], method: str = "GET") -> http.client.HTTPResponse:
    """Open a URL; see `connection_errors` for what may go wrong."""
    headers = {"User-Agent": "MedColor", "Accept-Encoding": "identity", **headers}
    return subject.opener.open(urllib.request.Request(url, headers=headers, method=method), timeout=_TIMEOUT_S)


def _checked_start(url: str, response: http.client.HTTPResponse, start: int, size: int, subject: Subject) -> int:
    """Return the position at which the body continues the file: 0 from a server that knows no ranges."""
    length = response.headers.get("Content-Length")
    if response.status == 206:
        match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", response.headers.get("Content-Range", ""))
        if not match or int(match[1]) != start:
            raise subject.error(f"{url}: the server sent another range than asked for; delete the .part file and retry")
        total = match[2]
    else:
        start, total = 0, length or "*"
    if total not in ("*", None) and int(total) != size:
        raise subject.error(
            f"{url}: the file there has {total} bytes instead of {size}: not the expected {subject.noun}"
        )
    return start


def _copy(response: http.client.HTTPResponse, file: BinaryIO, size: int, on_bytes: Callable[[int], None]) -> None:
    while file.tell() < size:
        on_bytes(file.tell())
        try:
            chunk = response.read(min(_CHUNK_BYTES, size - file.tell()))
        except (OSError, http.client.HTTPException) as error:  # a broken connection: what came is kept
            _logger.info("connection lost at byte %d: %s", file.tell(), error)
            return
        if not chunk:
            return
        file.write(chunk)
    on_bytes(file.tell())


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _check(url: str, part: Path, size: int, sha256: str | None, subject: Subject) -> None:
    found_size, found = _size_of(part), sha256_of(part)
    if (found_size, found) != (size, sha256 or found):
        part.unlink()
        raise subject.error(
            f"{url}: what came is not the expected file ({found_size} bytes, SHA-256 {found}; expected {size} bytes, "
            f"SHA-256 {sha256 or 'unknown'}) and was deleted; fetch it again, or from another URL"
        )
