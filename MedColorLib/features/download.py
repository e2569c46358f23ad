"""One file over HTTP: taken up again where it broke off, bounded in size, checked, never half there under its name."""

from __future__ import annotations

import hashlib
import http.client
import logging
import os
import re
import shutil
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import BinaryIO, Callable

from ..errors import Cancelled, SettingsError, WeightsError

_logger = logging.getLogger("MedColor")
_CHUNK_BYTES = 1 << 18
_TIMEOUT_S = 30.0
_BARREN_ATTEMPTS = 3  # connections in a row that bring nothing before giving up


def download(
    url: str,
    target: Path,
    *,
    size: int,
    sha256: str,
    progress: Callable[[int, int], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Path:
    """Download a file of known size and hash to `target`, by way of `target` + ".part".

    Args:
        url: http or https.
        target: file to make; its folder is made too.
        size: bytes, exactly.
        sha256: 64 hexadecimal digits.
        progress: called with (bytes present, size).
        cancelled: asked between chunks of 256 KiB.

    Raises:
        SettingsError: another kind of URL.
        WeightsError: offline, HTTP error, another size or hash (what came is deleted), disk full or not writable.
        Cancelled: the .part file stays, and the next call goes on from there.
    """
    if urllib.parse.urlsplit(url).scheme not in ("http", "https"):
        raise SettingsError(f"weights URL {url!r}: only http and https are supported")
    part = target.with_name(target.name + ".part")
    _make_room(part, size)

    def on_bytes(present: int) -> None:
        if cancelled is not None and cancelled():
            raise Cancelled(f"download of {url}")
        if progress is not None:
            progress(present, size)

    barren = 0
    while (present := _size_of(part)) < size:
        if barren == _BARREN_ATTEMPTS:
            raise WeightsError(
                f"{url}: the connection ended {barren} times after {present} of {size} bytes; run the same command "
                "again to go on from there"
            )
        _receive(url, part, size, on_bytes)
        barren = barren + 1 if _size_of(part) <= present else 0
    _check(url, part, size, sha256)
    os.replace(part, target)
    return target


def _size_of(part: Path) -> int:
    return part.stat().st_size if part.exists() else 0


def _make_room(part: Path, size: int) -> None:
    try:
        part.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(part.parent).free
    except OSError as error:
        raise _unwritable(part, error) from error
    if free < size - _size_of(part):
        raise WeightsError(
            f"{part.parent}: {free >> 20} MiB free, {(size - _size_of(part)) >> 20} MiB needed; make room, or move the "
            "cache folder"
        )


def _unwritable(part: Path, error: OSError) -> WeightsError:
    return WeightsError(f"{part}: cannot be written ({error.strerror}); make the folder writable or make room there")


def _receive(url: str, part: Path, size: int, on_bytes: Callable[[int], None]) -> None:
    """Append to the .part file what one connection brings."""
    try:
        with _connect(url, _size_of(part)) as response:
            start = _checked_start(url, response, _size_of(part), size)
            try:
                with part.open("r+b" if part.exists() else "wb") as file:
                    file.truncate(start)
                    file.seek(start)
                    _copy(response, file, size, on_bytes)
            except OSError as error:
                raise _unwritable(part, error) from error
    except urllib.error.HTTPError as error:
        raise WeightsError(
            f"{url}: the server answers {error.code} {error.reason}; try later, or another URL"
        ) from error
    except (OSError, http.client.HTTPException) as error:  # URLError, timeouts and TLS failures are OSErrors
        reason = getattr(error, "reason", None) or error
        raise WeightsError(
            f"{url}: no connection ({reason}); check the network and the proxy settings (https_proxy), or copy the "
            "file from another machine and point MEDCOLOR_WEIGHTS to it"
        ) from error


def _connect(url: str, start: int) -> http.client.HTTPResponse:
    headers = {"User-Agent": "MedColor", "Accept-Encoding": "identity"}
    if start:
        headers["Range"] = f"bytes={start}-"
    return urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S)


def _checked_start(url: str, response: http.client.HTTPResponse, start: int, size: int) -> int:
    """Return the position at which the body continues the file: 0 from a server that knows no ranges."""
    length = response.headers.get("Content-Length")
    if response.status == 206:
        match = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", response.headers.get("Content-Range", ""))
        if not match or int(match[1]) != start:
            raise WeightsError(f"{url}: the server sent another range than asked for; delete the .part file and retry")
        total = match[2]
    else:
        start, total = 0, length or "*"
    if total not in ("*", None) and int(total) != size:
        raise WeightsError(f"{url}: the file there has {total} bytes instead of {size}: not the expected weights")
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


def _check(url: str, part: Path, size: int, sha256: str) -> None:
    found_size, found = _size_of(part), sha256_of(part)
    if (found_size, found) != (size, sha256):
        part.unlink()
        raise WeightsError(
            f"{url}: what came is not the expected file ({found_size} bytes, SHA-256 {found}; expected {size} bytes, "
            f"SHA-256 {sha256}) and was deleted; fetch it again, or from another URL"
        )
