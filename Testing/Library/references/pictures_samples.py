"""What the tests of picture files share: how a picture is stored, and how far one is from another."""

from __future__ import annotations

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


def far(picture, expected) -> float:
    """Largest difference in levels; infinite where the shapes differ."""
    if picture.shape != expected.shape:
        return np.inf
    return float(np.abs(picture.astype(int) - expected.astype(int)).max())
