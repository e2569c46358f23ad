"""A head made by formula: CT, MR and photographs of one anatomy, whose truth is known. For the demo, a first run and tests.

Not a patient and not a photograph, but laid out as a head is: skin, fat, muscles, skull with marrow, folded brain, eyes,
sinuses, jaw and neck. Made with NumPy alone: it is the first thing that a fresh Slicer shows, before any package is
installed. The same bits come out on every machine.
"""

from __future__ import annotations

import numpy as np

from ..volume import Volume
from .photograph import section, section_labels
from .scans import labels, scan
from .tissues import TISSUES

__all__ = [
    "SERIES_LEVELS",
    "SERIES_SHAPE",
    "TISSUES",
    "labels",
    "sample",
    "scan",
    "section",
    "section_labels",
    "series",
]

SERIES_LEVELS = (-0.8, -0.45, -0.3, 0.2, 0.5)  # jaw, eyes, midbrain, ventricles, vault
SERIES_SHAPE = (80, 144, 126)


def sample(modality: str = "ct", seed: int = 0) -> tuple[Volume, np.ndarray]:
    """A grey volume and a colour section of it.

    Args:
        modality: "ct" (HU, int16) or "mr" (T1-like, uint16).

    Returns:
        Volume (48, 128, 112) of 4 x 1.6 x 1.6 mm; (264, 248, 3) uint8 RGB section at eye level in blue gelatin, whose
        anatomy is stretched by a few per cent against the volume's, as a photograph's is.
    """
    return scan(modality, seed), section(seed=seed)


def series(modality: str = "mr", seed: int = 0) -> tuple[Volume, list[np.ndarray]]:
    """A finer grey volume and colour sections through all of it, from the jaw up.

    Args:
        modality: "ct" or "mr", as for `sample`.

    Returns:
        Volume (80, 144, 126) of 2.4 x 1.4 x 1.4 mm; five sections of (264, 248, 3) uint8 RGB, at SERIES_LEVELS.
    """
    return scan(modality, seed, SERIES_SHAPE), [section(level, seed) for level in SERIES_LEVELS]
