"""Libraries that can be fetched: the Visible Human Male, photographs of head, thorax and abdomen, from the National
Library of Medicine's server.

The server lists each part of the body on a page of its own (`PNG_format/head/index.html` ...) with the exact size of each
picture; the photographs are called a_vm1001.png (vertex) and so on towards the feet, one every millimetre, 2048 x 1216
pixels of 0.33 mm. No checksums are published. So each file is checked against its listed size, every chunk of the PNG
against its CRC, and the SHA-256 seen at the first download is kept and asked for at every later one.
"""

from __future__ import annotations

import logging
import re
import struct
import time
import urllib.error
import urllib.request
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from urllib.parse import urljoin, urlsplit

from ..errors import Cancelled, InputError, MedColorError, SettingsError
from ..features.download import Subject, connect, connection_errors, download
from .library import FETCHED, LibraryWriter

log = logging.getLogger("MedColorLib")

MAX_PHOTOGRAPH_BYTES = 12 << 20  # 2048 x 1216 x 3 bytes without any compression are 7.5 MB
_MAX_PAGE_BYTES = 4 << 20
_WAITS_S = (1.0, 4.0, 16.0)  # before a photograph is asked for again
_TOLERATED = 0.1  # share of the photographs that may be missing or damaged on the server
_LOOPBACK = ("127.0.0.1", "::1", "localhost")


@dataclass(frozen=True)
class Source:
    """Where a library comes from.

    Attributes:
        url: folder of the parts. parts: their names, from the head down.
        pattern: file names; group 1 is the photograph's number. first: the number at position 0.
        spacing_mm: between neighbouring numbers. mm_per_pixel, shape (rows, columns): of a photograph.
    """

    title: str
    url: str
    parts: tuple[str, ...]
    pattern: str
    first: int
    spacing_mm: float
    mm_per_pixel: float
    shape: tuple[int, int]
    credit: str
    licence: str


SOURCES = {
    FETCHED[0]: Source(
        "Visible Human Male, head, thorax and abdomen",
        "https://data.lhncbc.nlm.nih.gov/public/Visible-Human/Male-Images/PNG_format/",
        ("head", "thorax", "abdomen"),
        r"a_vm(\d{4})\.png",
        1001,
        1.0,
        0.33,
        (1216, 2048),
        "Courtesy of the U.S. National Library of Medicine",
        "no licence needed since 2019; NLM asks for the credit and does not endorse what is made of the images",
    )
}


@dataclass(frozen=True)
class Photograph:
    """One file on the server: its number, address and exact size in bytes."""

    number: int
    url: str
    size: int

    @property
    def name(self) -> str:
        """File name."""
        return self.url.rsplit("/", 1)[1]


def list_photographs(
    name: str, step_mm: int = 5, parts: Sequence[str] | None = None, url: str | None = None
) -> list[Photograph]:
    """Ask the server which photographs there are, and choose one every `step_mm`; nothing else is fetched.

    Args:
        name: key of SOURCES.
        step_mm: 1 to 100.
        parts: some of the source's; None: all.
        url: a mirror's folder instead of the source's; https, or http on this machine.

    Raises:
        SettingsError: no such source, part, step or kind of URL.
        InputError: no connection, or a page that lists no photograph.
    """
    source = _source(name)
    parts = tuple(parts or source.parts)
    unknown = [part for part in parts if part not in source.parts]
    if unknown or not 1 <= step_mm <= 100:
        raise SettingsError(f"library fetch: parts are {', '.join(source.parts)}, the step is 1 to 100 mm")
    base = (url or source.url).rstrip("/") + "/"
    _check_url(base)
    subject = _subject(name)
    step = max(1, round(step_mm / source.spacing_mm))
    found: dict[int, Photograph] = {}
    for part in parts:
        page = urljoin(base, f"{part}/index.html")
        listed = _listed(_page(page, subject), source.pattern)
        if not listed:
            raise InputError(f"{page}: lists no photograph; the server has changed, or something stands in between")
        for number, (file, size) in listed.items():
            if (number - source.first) % step == 0 and number not in found:  # parts overlap
                address = urljoin(page, file)
                found[number] = Photograph(number, address, _size_of(address, subject) if size is None else size)
    return [found[number] for number in sorted(found)]


def missing_photographs(name: str, photographs: Sequence[Photograph]) -> list[Photograph]:
    """Those that are not yet prepared in the library."""
    library = _writer(name)
    return [p for p in photographs if not _done(library, p)]


def fetch_library(
    name: str,
    photographs: Sequence[Photograph],
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    wait: Callable[[float], None] = time.sleep,
) -> dict:
    """Download what is missing, one photograph at a time, and prepare it; the photograph itself is not kept.

    Args:
        photographs: from `list_photographs`.
        wait: takes seconds; called before a request is repeated.

    Returns:
        The library's index; `left_out` says what could not be had or shows no tissue.

    Raises:
        InputError: the connection is gone (what is done is kept, the next call goes on from there), a photograph differs
            from the one fetched before, or more than a tenth are missing or damaged.
        OutputError: the cache folder cannot be written. Cancelled: as without a connection.
    """
    source, library = _source(name), _writer(name)
    bad = 0
    for number, photograph in enumerate(photographs):
        if _done(library, photograph):
            continue

        def on_bytes(present: int, size: int, number=number, photograph=photograph) -> None:
            if progress is not None:
                text = f"{photograph.name}, {number + 1} of {len(photographs)}"
                progress((number + present / max(size, 1)) / len(photographs), text)

        if cancelled is not None and cancelled():
            raise Cancelled(f"library fetch {name}")
        bad += not _fetch_one(library, source, _subject(name), photograph, on_bytes, cancelled, wait)
        if bad > max(2, _TOLERATED * len(photographs)):
            why = library.index["left_out"][-1]["why"]
            raise InputError(f"library fetch: {bad} photographs are missing or damaged on the server, the last: {why}")
    return library.finish()


def _fetch_one(library, source, subject, photograph, on_bytes, cancelled, wait) -> bool:
    """Download, check, prepare. False where the server does not have it or has it damaged."""
    known = library.entry(photograph.name) or {}
    target = library.folder / f".{photograph.name}"
    options = {"size": photograph.size, "sha256": None, "subject": subject, "progress": on_bytes}
    try:
        if not 0 < photograph.size <= MAX_PHOTOGRAPH_BYTES:
            raise _Damaged(f"{photograph.url}: {photograph.size} bytes cannot be a photograph")
        for last in (False, True):  # a rest of another version of the file spoils the first attempt only
            part = target.with_name(target.name + ".part")
            if part.is_file() and part.stat().st_size > photograph.size:
                part.unlink()
            _patient(lambda: download(photograph.url, target, **options, cancelled=cancelled), wait)
            try:
                check_png(target.read_bytes(), source.shape)
                break
            except ValueError as error:
                target.unlink()
                if last:
                    raise _Damaged(f"{photograph.url}: {error}") from error
    except MedColorError as error:
        if not isinstance(error, _Damaged) and _status(error) not in (403, 404, 410):
            raise
        library.leave_out(photograph.name, str(error))
        return False
    try:
        _check_same(library, known, photograph, target)
        position = (photograph.number - source.first) * source.spacing_mm
        library.add_file(target, photograph.name, position_mm=position, mm_per_pixel=source.mm_per_pixel)
    finally:
        target.unlink(missing_ok=True)
    return True


def check_png(data: bytes, shape: tuple[int, int]) -> None:
    """Check that a file is a whole PNG of a given shape (rows, columns): signature, CRC of every chunk, nothing missing.

    Raises:
        ValueError: what is wrong.
    """
    if data[:8] != b"\x89PNG\r\n\x1a\n":
        raise ValueError(f"not a PNG (it begins with {data[:12]!r})")
    at, kind = 8, b""
    while at + 12 <= len(data):
        (length,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        content, end = data[at + 4 : at + 8 + length], at + 12 + length
        if end > len(data) or zlib.crc32(content) != struct.unpack(">I", data[end - 4 : end])[0]:
            raise ValueError(f"damaged PNG (chunk {kind!r} at byte {at})")
        if at == 8 and (kind != b"IHDR" or length != 13):
            raise ValueError("damaged PNG (no header)")
        if at == 8 and struct.unpack(">II", content[4:12]) != shape[::-1]:
            columns, rows = struct.unpack(">II", content[4:12])
            raise ValueError(f"{columns} x {rows} pixels instead of {shape[1]} x {shape[0]}")
        at = end
    if kind != b"IEND" or at != len(data):
        raise ValueError("PNG cut short")


class _Damaged(InputError):
    """What the server has is not the photograph."""


def _source(name: str) -> Source:
    if name not in SOURCES:
        raise SettingsError(f"library fetch: {name!r} is not one of {', '.join(SOURCES)}")
    return SOURCES[name]


def _writer(name: str) -> LibraryWriter:
    source = _source(name)
    about = {"title": source.title, "credit": source.credit, "licence": source.licence, "source": source.url}
    return LibraryWriter(name, **about, order="from the head to the feet")


def _done(library: LibraryWriter, photograph: Photograph) -> bool:
    entry = library.entry(photograph.name)
    without_tissue = entry is not None and "file" not in entry and "sha256" in entry
    return without_tissue or library.has(photograph.name)


def _check_same(library, known: dict, photograph: Photograph, target: Path) -> None:
    from ..features.download import sha256_of

    if known.get("sha256") not in (None, sha256_of(target)):
        raise InputError(
            f"{photograph.url}: differs from the file of this name that was fetched before (SHA-256 {known['sha256']}); "
            f"run `medcolor library remove {library.folder.name}` to begin anew"
        )


def _subject(name: str) -> Subject:
    otherwise = f"download the pictures elsewhere and run `medcolor library add FOLDER --name {name}`"
    return Subject("photograph", InputError, otherwise, urllib.request.build_opener(_SameHost))


class _SameHost(urllib.request.HTTPRedirectHandler):
    """Follows redirects only to the same host and only by https (or as the first address, on this machine)."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):
        """See the base class."""
        old, new = urlsplit(req.full_url), urlsplit(newurl)
        if (new.scheme, new.hostname, new.port) != (old.scheme, old.hostname, old.port):
            fp.close()  # else the connection stays open until Python comes to clear it away
            raise urllib.error.URLError(f"redirected to {new.scheme}://{new.netloc}, which is not followed")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _check_url(url: str) -> None:
    parts = urlsplit(url)
    if parts.scheme != "https" and not (parts.scheme == "http" and parts.hostname in _LOOPBACK):
        raise SettingsError(f"library fetch: {url}: only https is supported (http on this machine)")


def _page(url: str, subject: Subject) -> str:
    with connection_errors(url, subject), connect(url, subject, {}) as response:
        data = response.read(_MAX_PAGE_BYTES + 1)
    if len(data) > _MAX_PAGE_BYTES:
        raise InputError(f"{url}: more than {_MAX_PAGE_BYTES >> 20} MiB cannot be the list of photographs")
    return data.decode("utf-8", "replace")


def _listed(page: str, pattern: str) -> dict[int, tuple[str, int | None]]:
    """Number -> (file name, bytes or None) of each link of a page; the size is the number in a cell of class `size`."""
    found: dict[int, tuple[str, int | None]] = {}
    for row in re.split(r"(?i)(?=<a\s)", page):
        link = re.match(rf"""(?i)<a\s[^>]*href\s*=\s*["']?(?:\./)?({pattern})["'\s>]""", row)
        if link:
            size = re.search(r"""(?i)<td[^>]*class\s*=\s*["']?size["']?[^>]*>\s*(\d+)\s*<""", row)
            found[int(link[2])] = (link[1], int(size[1]) if size else None)
    return found


def _size_of(url: str, subject: Subject) -> int:
    """Bytes of a file that the page gives no size for; 0 where the server does not say."""
    try:
        with connection_errors(url, subject), connect(url, subject, {}, method="HEAD") as response:
            return int(response.headers.get("Content-Length") or 0)
    except InputError as error:
        if _status(error) not in (403, 404, 410):
            raise
        return 0


def _status(error: MedColorError) -> int | None:
    return error.__cause__.code if isinstance(error.__cause__, urllib.error.HTTPError) else None


def _patient(action: Callable[[], object], wait: Callable[[float], None]) -> None:
    """Repeat after a while what failed because of the network or because the server is busy."""
    for seconds in (*_WAITS_S, None):
        try:
            action()
            return
        except MedColorError as error:
            cause = error.__cause__
            refused = isinstance(cause, urllib.error.HTTPError)
            passing = cause.code in (429, 500, 502, 503, 504) if refused else isinstance(cause, _NETWORK)
            if seconds is None or not passing:
                raise
            log.info("again in %g s: %s", seconds, error)
            wait(seconds)


_NETWORK = (urllib.error.URLError, ConnectionError, TimeoutError, HTTPException)
