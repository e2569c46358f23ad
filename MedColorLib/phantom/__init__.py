"""A head made by formula: CT, MR and a photograph of one anatomy, whose truth is known. For the demo, a first run and tests.

Not a patient and not a photograph, but laid out as a head is: skin, fat, muscles, skull with marrow, folded brain, eyes,
sinuses, jaw and neck. Made with NumPy alone: it is the first thing that a fresh Slicer shows, before any package is
installed. The same bits come out on every machine.
"""

from __future__ import annotations

import numpy as np

from ..volume import Volume
from .photograph import section
from .scans import labels, scan
from .tissues import TISSUES

__all__ = ["TISSUES", "labels", "sample", "section"]


def sample(modality: str = "ct", seed: int = 0) -> tuple[Volume, np.ndarray]:
    """A grey volume and a colour section of it.

    Args:
        modality: "ct" (HU, int16) or "mr" (T1-like, uint16).

    Returns:
        Volume (48, 128, 112) of 4 x 1.6 x 1.6 mm; (264, 248, 3) uint8 RGB section at eye level in blue gelatin, whose
        anatomy is stretched by a few per cent against the volume's, as a photograph's is.
    """
    return scan(modality, seed), section(seed=seed)
