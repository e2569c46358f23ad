"""The icons that show the head made by formula, grey beside colour:

    python Testing/SlicerHost/icons.py MedColor/Resources/Icons

writes MedColor.png (128 x 128, for the module and the extension) and MedColorPhantom.png (for Sample Data).
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from MedColorLib.phantom import TISSUES, labels, scan, section

_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 9]
_EYES = -0.45


def module_icon() -> np.ndarray:
    """(128, 128, 4) BGRA: a section through the ventricles, cut out."""
    tissue = labels((27, 512, 448))[14]  # a little above the middle
    grey, color = (np.array([row[column] for row in TISSUES.values()], np.float32)[tissue] for column in (1, 2))
    middle = tissue.shape[1] // 2
    picture = color[..., ::-1].copy()
    picture[:, :middle] = grey[:, :middle, None] * (230 / 900)
    picture[:, middle - 2 : middle + 2] = 255
    opaque = (tissue > 0).astype(np.float32)[..., None]
    rows, cols = (np.flatnonzero(tissue.any(axis)) for axis in (1, 0))
    side = max(np.ptp(rows), np.ptp(cols)) + 8
    top, left = (rows[0] + rows[-1] - side) // 2, (cols[0] + cols[-1] - side) // 2
    cut = np.pad(np.concatenate([picture * opaque, 255 * opaque], -1), ((30, 30), (30, 30), (0, 0)))
    cut = cut[top + 30 : top + 30 + side, left + 30 : left + 30 + side]
    small = cv2.resize(cut, (128, 128), interpolation=cv2.INTER_AREA)
    small[..., :3] *= 255 / np.maximum(small[..., 3:], 1)
    return np.rint(small.clip(0, 255)).astype(np.uint8)


def sample_icon() -> np.ndarray:
    """(280, 260, 3) BGR: MR and photograph at the level of the eyes."""
    picture = section(_EYES, scale=2)[..., ::-1].copy()
    volume = scan("mr", shape=(48, 256, 224))
    grey = volume.array[round((_EYES + 1) / 2 * 47)].astype(np.float32) * (255 / 900)
    grey = np.pad(cv2.resize(grey, (448, 512), interpolation=cv2.INTER_CUBIC), ((8, 8), (24, 24)))
    middle = picture.shape[1] // 2
    picture[:, :middle] = np.rint(grey.clip(0, 255))[:, :middle, None]
    picture[:, middle - 1 : middle + 1] = 255
    small = cv2.resize(picture, (248, 264), interpolation=cv2.INTER_AREA)
    return np.pad(small, ((8, 8), (6, 6), (0, 0)))


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    cv2.imwrite(str(folder / "MedColor.png"), module_icon(), _PNG)
    cv2.imwrite(str(folder / "MedColorPhantom.png"), sample_icon(), _PNG)
