"""DICOM files opened: what is one, and its header by `pydicom`, bounded in time and memory before it is read."""

from __future__ import annotations

import io
import itertools
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import MissingPackageError
from .quiet import quiet_package

DICOM_ENDINGS = (".dcm", ".dicom", ".ima")
NATIVE = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.2")  # implicit, explicit, big endian
PIXEL_TAGS = {0x7FE00010: None, 0x7FE00008: "f4", 0x7FE00009: "f8"}  # the type of numbers that are no integers
_DEFLATED = "1.2.840.10008.1.2.1.99"
_MAX_ELEMENTS = 20_000
_MAX_READS = 2_000_000
_MAX_DEFLATED = 1 << 30  # bytes


def is_dicom(path: Path) -> bool:
    """True for a file that is DICOM by its ending, its first bytes, or (without a preamble) its first element.

    The directory of a medium is none: it holds no image.
    """
    if path.name.upper() == "DICOMDIR":
        return False
    if path.suffix.lower() in DICOM_ENDINGS:
        return True
    with path.open("rb") as file:
        head = file.read(132)
    return head[128:] == b"DICM" or _begins_with_an_element(head)


def _begins_with_an_element(head: bytes) -> bool:
    """Group 0002 or 0008, and a length that an element there may have; explicit or implicit."""
    if len(head) < 132 or head[:2] not in (b"\x02\x00", b"\x08\x00") or head[3] != 0:
        return False
    explicit = head[4:6].isalpha() and head[4:6].isupper()
    length = int.from_bytes(head[6:8] if explicit else head[4:8], "little")
    end = 8 + length
    return length <= 64 and length % 2 == 0 and head[end : end + 2] in (b"\x02\x00", b"\x08\x00")


@contextmanager
def quiet_pydicom() -> Iterator[None]:
    """Keep remarks on odd headers off stderr: what matters of them is checked here and noted.

    Raises:
        MissingPackageError: pydicom is not installed.
    """
    try:
        import pydicom  # noqa: F401
    except ImportError as error:
        raise MissingPackageError("DICOM needs the package pydicom: pip install pydicom") from error
    with quiet_package("pydicom"):
        yield


def read_header(path: Path) -> tuple:
    """(data set without its pixels, tag, offset and length of these), see `_pixel_offset`.

    Raises:
        Exception: whatever a damaged header makes pydicom's parts raise.
    """
    import pydicom

    with _Bounded(io.FileIO(path)) as file:
        _check_beginning(file)
        header = pydicom.filereader.read_partial(file, _stop_at_pixels(), force=True)
        return (header, *_pixel_offset(file, header))


def _stop_at_pixels() -> Callable:
    """What pydicom asks before every element. A file of zeros would be millions of empty ones, and minutes of reading."""
    count = itertools.count()

    def stop(tag, _kind, _length) -> bool:
        if next(count) > _MAX_ELEMENTS:
            raise ValueError("more elements than any header")
        return tag in PIXEL_TAGS

    return stop


class _Bounded(io.BufferedReader):
    """A file that gives up after more reads than a header takes. Zeros are millions of empty elements to pydicom."""

    reads = 0

    def read(self, size: int | None = -1) -> bytes:
        """As of any file; raises ValueError."""
        self.reads += 1
        if self.reads > _MAX_READS:
            raise ValueError("more elements than any header")
        return super().read(size)


def _check_beginning(file) -> None:
    """Refuse zeros, and a file packed as a whole that unpacks to more than any image: pydicom unpacks it at once.

    Raises:
        ValueError: it does.
    """
    head = file.read(1024)
    if not any(head[132:140] if head[128:132] == b"DICM" else head[:8]):
        raise ValueError("zeros")
    if head[128:132] == b"DICM" and _DEFLATED.encode() in head:
        file.seek(144 + int.from_bytes(head[140:144], "little"))  # behind the group of the file's own words
        unpacker, total = zlib.decompressobj(-zlib.MAX_WBITS), 0
        while (data := file.read(1 << 16)) and not unpacker.eof:
            while data and total <= _MAX_DEFLATED:
                total += len(unpacker.decompress(data, 1 << 24))
                data = unpacker.unconsumed_tail
        if total > _MAX_DEFLATED:
            raise ValueError("unpacks to more than any image")
    file.seek(0)


def _pixel_offset(file, header) -> tuple[int, int, int]:
    """(tag, offset, length) of the pixels' value, or 0, -1, 0 where the file cannot be read in place."""
    syntax = syntax_of(header)
    if syntax == _DEFLATED:
        return 0x7FE00010, -1, 0
    order = "big" if syntax == NATIVE[2] else "little"
    head = file.read(12)
    tag = (int.from_bytes(head[:2], order) << 16) + int.from_bytes(head[2:4], order)
    if tag not in PIXEL_TAGS or len(head) < 12:
        return 0, -1, 0
    if head[4:6].isalpha():
        return tag, file.tell(), int.from_bytes(head[8:], order)
    return tag, file.tell() - 4, int.from_bytes(head[4:8], order)


def syntax_of(header) -> str:
    """The transfer syntax; of files without one that which `pydicom` took."""
    given = getattr(header.file_meta, "TransferSyntaxUID", None) if hasattr(header, "file_meta") else None
    if given:
        return str(given)
    implicit, little = getattr(header, "original_encoding", (True, True))
    return NATIVE[0] if implicit else NATIVE[1 if little else 2]
