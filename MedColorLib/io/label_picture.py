"""Label pictures: PNG files whose values are labels, read as they are stored, without any conversion of colour.

Picture readers turn palettes into colours and stretch grey of 1, 2 or 4 bits to 8. Labels are the stored numbers; so the
file's palette is replaced in memory by one that shows every index as itself before the picture is decoded.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from ..errors import InputError
from .voxel_data import MAX_DEFLATE_RATIO

_MAGIC = b"\x89PNG\r\n\x1a\n"
_GREY, _PALETTE = 0, 3  # colour types of the PNG specification that hold one number per pixel
MAX_PIXELS = 178_956_970  # as of photographs, on which they are drawn
_KEPT = (b"IDAT", b"IEND")


def read_label_picture(path: str | os.PathLike) -> np.ndarray:
    """Read a PNG of grey or palette values as labels.

    Returns:
        (h, w) uint8, or uint16 of a picture with 16 bits.

    Raises:
        InputError: missing, unreadable, not a PNG, or with colour channels.
    """
    import cv2

    from .quiet import quiet_cv2

    name = os.path.basename(path)
    if not os.path.isfile(path):
        raise InputError(f"reference labels: no file {path}")
    try:
        with open(path, "rb") as stream:
            data = stream.read()
    except OSError as error:
        raise InputError(
            f"reference labels {name}: cannot be read ({error.strerror}); check the permissions"
        ) from error
    plain = _with_plain_values(data, name)
    with quiet_cv2():
        picture = cv2.imdecode(np.frombuffer(plain, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InputError(f"reference labels {name}: the PNG is damaged; save it again")
    return np.ascontiguousarray(picture if picture.ndim == 2 else picture[..., 0])


def has_whole_chunks(data: bytes | memoryview) -> bool:
    """Whether every chunk of a PNG ends inside the file: OpenCV takes memory for as much as a chunk says it holds."""
    at = len(_MAGIC)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        if data[at + 4 : at + 8] == b"IEND":
            return length == 0
        at += 12 + length
    return False


def chunk_before_pixels(stream: BinaryIO, kind: bytes, length: int) -> bytes | None:
    """The content of a PNG's first chunk of that kind and length ahead of its pixels; None: there is none."""
    stream.seek(len(_MAGIC))
    while len(head := stream.read(8)) == 8 and head[4:] not in _KEPT:
        size = int.from_bytes(head[:4], "big")
        if head[4:] == kind and size == length:
            content = stream.read(length)
            return content if len(content) == length else None
        stream.seek(size + 4, os.SEEK_CUR)
    return None


def _with_plain_values(data: bytes, name: str) -> bytes:
    """The same PNG without ancillary chunks, palette or few-bit grey shown through a palette where entry n is n."""
    if not data.startswith(_MAGIC):
        raise InputError(f"reference labels {name}: not a PNG; save the labels as PNG, grey or with a palette")
    chunks = list(_chunks(data))
    if not chunks or chunks[0][0] != b"IHDR" or len(chunks[0][1]) != 13:
        raise InputError(f"reference labels {name}: the PNG is damaged; save it again")
    header = chunks[0][1]
    width, height = struct.unpack(">II", header[:8])
    if width * height > MAX_PIXELS:
        raise InputError(
            f"reference labels {name}: {width} x {height} pixels, more than {MAX_PIXELS // 10**6} megapixels"
        )
    bits, kind = header[8], header[9]
    columns, rows = struct.unpack(">II", header[:8])
    packed = sum(len(content) for what, content in chunks if what == b"IDAT")
    if bits not in (1, 2, 4, 8, 16) or rows * columns * bits // 8 > packed * MAX_DEFLATE_RATIO:
        raise InputError(f"reference labels {name}: the PNG is damaged; save it again")
    if kind not in (_GREY, _PALETTE):
        raise InputError(f"reference labels {name}: a colour picture; save the labels as PNG, grey or with a palette")
    parts = [_MAGIC]
    if bits < 16:
        numbers = bytes(n for index in range(1 << bits) for n in (index,) * 3)
        parts += [_chunk(b"IHDR", header[:9] + bytes([_PALETTE]) + header[10:]), _chunk(b"PLTE", numbers)]
    else:
        parts.append(_chunk(b"IHDR", header))
    return b"".join([*parts, *(_chunk(what, content) for what, content in chunks if what in _KEPT)])


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = len(_MAGIC)
    while at + 12 <= len(data):
        size = struct.unpack(">I", data[at : at + 4])[0]
        yield data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        at += 12 + size


def _chunk(what: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + what + content + struct.pack(">I", zlib.crc32(what + content))
