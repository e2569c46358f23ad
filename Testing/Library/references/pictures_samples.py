"""What the tests of picture files share: how a picture is stored, and how far one is from another."""

from __future__ import annotations

import struct

import numpy as np

SHAPE = (40, 60)
# What a decoder of the format may change; the way it is stored may not.
LOSSY = {".jpg": 8, ".webp": 6, ".avif": 8}
# The transposition that stores a picture so that EXIF's number turns it back (EXIF 2.3, table 6).
STORED = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.transpose(1, 0, 2),
    6: np.rot90,
    7: lambda a: a[::-1, ::-1].transpose(1, 0, 2),
    8: lambda a: np.rot90(a, -1),
}
D50 = (0.9642, 1.0, 0.8249)
SRGB_D50 = np.array([[0.4361, 0.2225, 0.0139], [0.3851, 0.7169, 0.0971], [0.1431, 0.0606, 0.7141]])


def matrix_profile(primaries, gamma: float, name: str, space: bytes = b"RGB ") -> bytes:
    """An ICC profile, version 2, of three primaries (rows: XYZ of D50) and one gamma."""
    s15 = lambda values: b"".join(struct.pack(">i", round(v * 65536)) for v in values)  # noqa: E731
    text = name.encode()
    description = b"desc" + bytes(4) + struct.pack(">I", len(text) + 1) + text + b"\0" + bytes(4 + 4 + 2 + 1 + 67)
    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256))
    tags = {b"desc": description, b"cprt": b"text" + bytes(4) + b"none\0", b"wtpt": b"XYZ " + bytes(4) + s15(D50)}
    for letter, xyz in zip(b"rgb", primaries):
        tags[bytes([letter]) + b"XYZ"] = b"XYZ " + bytes(4) + s15(xyz)
        tags[bytes([letter]) + b"TRC"] = curve
    at, table, data = 128 + 4 + 12 * len(tags), b"", b""
    for tag, content in tags.items():
        table += tag + struct.pack(">II", at + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    header = struct.pack(">I4sI4s4s4s", at + len(data), b"none", 0x02100000, b"mntr", space, b"XYZ ")
    header += bytes(12) + b"acsp" + bytes(28) + s15(D50)
    return header.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + data


def far(picture, expected) -> float:
    """Largest difference in levels; infinite where the shapes differ."""
    if picture.shape != expected.shape:
        return np.inf
    return float(np.abs(picture.astype(int) - expected.astype(int)).max())
