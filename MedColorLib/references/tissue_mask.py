"""Stage *tissue mask*: which pixels of a photograph are tissue; everything else (`surroundings`, rulers, labels) is not."""

from __future__ import annotations

import numpy as np

from ..color.lab import RGB_TO_XYZ, linear_to_xyz, srgb_to_linear, xyz_to_lab
from .surroundings import (
    Surroundings,
    dilated,
    distance_to,
    find_surroundings,
    of_no_tissue,
    opened,
    rectangularity,
    solid,
    without_hue,
)

LONG_SIDE_PX = 320  # on which the tissue is found; its outline is then as sharp as a slice on the raster
SMALLEST_PART = 0.008  # of the largest part's pixels: a finger beside a trunk is kept, a crumb is not
SMALLEST_POCKET = 9  # pixels of the reduced picture
MOST_POCKETS = 0.08  # of the body; more is tissue as pale as its surroundings
FILLS = "no surroundings found: tissue fills the picture"


def tissue_mask(rgb: np.ndarray) -> np.ndarray:
    """(h, w) bool, True on tissue; see `find_tissue`."""
    return find_tissue(rgb)[0]


def find_tissue(rgb: np.ndarray) -> tuple[np.ndarray, str]:
    """Tell tissue from everything else in a photograph.

    Args:
        rgb: (h, w, 3) uint8 sRGB.

    Returns:
        (h, w) bool, True on tissue, and a note for people where something had to be assumed (else ""). Several parts of
        tissue are all kept. Holes inside are tissue (vessels, airways) unless they have a hue that no tissue has and the
        picture is not drawn on paper, where veins are blue.
    """
    import cv2

    scale = min(1.0, LONG_SIDE_PX / max(rgb.shape[:2]))
    size = tuple(max(1, round(n * scale)) for n in rgb.shape[1::-1])
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) if scale < 1 else rgb
    lab = _usual_lab(small)
    if min(lab.shape[:2]) < 8:
        return np.ones(rgb.shape[:2], bool), FILLS
    around = find_surroundings(lab)
    if not around.found:
        mask, note = ~opened(of_no_tissue(lab), 3), FILLS
    else:
        mask, note = _parts(_without_pockets(lab, around), lab), ""
    return cv2.resize(mask.astype(np.float32), rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR) > 0.5, note


def _usual_lab(rgb: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 L*a*b* of the picture as bright as usual, so that a dark one is not black all over."""
    import cv2

    linear = srgb_to_linear(rgb)
    luminance = linear @ RGB_TO_XYZ[1].astype(np.float32)
    if min(luminance.shape) >= 5:
        luminance = cv2.medianBlur(luminance, 5)
    gain = np.clip(0.8 / max(float(np.percentile(luminance, 99.5)), 1e-3), 0.7, 6).astype(np.float32)
    return xyz_to_lab(linear_to_xyz(np.minimum(linear * gain, 1)))


def _without_pockets(lab: np.ndarray, around: Surroundings) -> np.ndarray:
    """What is left of the picture: solid, but without pockets of gelatin and its rim."""
    body = solid(around.outside)
    colors = lab[around.seeds]
    paper = without_hue(colors) & (colors[:, 0] > 70)
    if paper.mean() < 0.8:
        strange = of_no_tissue(lab)
        gelatin = strange & (_large(strange, SMALLEST_POCKET) | dilated(around.outside, 5))
        # pixels next to gelatin are mixed with its hue: a rim one pixel wide goes as well
        mixed = dilated(gelatin, 3) & (lab[..., 2] < 6) & of_no_tissue(colors.mean(axis=0))
        body &= ~(gelatin | mixed)
    return opened(body & ~_seen_through(body, lab, around), 3)


def _large(mask: np.ndarray, pixels: int) -> np.ndarray:
    """The parts of a mask of at least so many pixels: also the line of gelatin between an arm and the trunk."""
    from scipy import ndimage

    labels, _ = ndimage.label(mask, structure=np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= pixels)[labels]


def _seen_through(body: np.ndarray, lab: np.ndarray, around: Surroundings) -> np.ndarray:
    """Where white paper or a grey table is seen through the section: pockets that look like it. Dark ones are lumina."""
    alike = without_hue(lab) & (lab[..., 0] > 40) & (distance_to(lab, around.seeds) < 3)
    pockets = opened(body & alike, 5)
    return pockets if pockets.sum() < MOST_POCKETS * body.sum() else np.zeros_like(body)


def _parts(body: np.ndarray, lab: np.ndarray) -> np.ndarray:
    """The parts of `body` that are tissue; the largest of all is kept if none is."""
    from scipy import ndimage

    labels, count = ndimage.label(body)
    if not count:
        return body
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    large = np.flatnonzero(sizes >= SMALLEST_PART * sizes.max() / 2)
    tissue = [i for i in large if _is_tissue(labels == i, lab)] or [sizes.argmax()]
    largest = sizes[tissue].max()
    keep = [i for i in tissue if sizes[i] >= SMALLEST_PART * largest]
    return np.isin(labels, keep)


def _is_tissue(part: np.ndarray, lab: np.ndarray) -> bool:
    """False of rulers, labels, grey scales and tools: without warmth, lemon yellow, or a plain rectangle."""
    colors = lab[part]
    median = np.median(colors, axis=0)
    chroma, hue = np.hypot(median[1], median[2]), np.degrees(np.arctan2(median[2], median[1]))
    if median[1] <= 0.5 or chroma <= 4 or (hue > 95 and chroma > 30):
        return False
    filled, slender = rectangularity(part)
    plain = (np.linalg.norm(colors - median, axis=1) < 10).mean()
    return not ((filled > 0.88 and plain > 0.6) or (filled > 0.8 and slender > 6))
