"""Stage *reference*: a colour photograph becomes tissue colours and a mask that tells tissue from everything else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..scan.grid import Grid, continue_outwards, to_grid

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")  # of files in a folder of references


@dataclass(frozen=True)
class Frame:
    """The part of a picture that was kept: `shape` (h, w) of the whole picture, (first, behind the last) row and column."""

    shape: tuple[int, int]
    rows: tuple[int, int]
    cols: tuple[int, int]

    @classmethod
    def around(cls, mask: np.ndarray) -> Frame:
        """The bounding box of a mask (h, w), which must not be empty."""
        rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        return cls(mask.shape, (int(rows[0]), int(rows[-1]) + 1), (int(cols[0]), int(cols[-1]) + 1))

    def cut(self, picture: np.ndarray) -> np.ndarray:
        """That part of a picture (h, w[, c]); a contiguous copy."""
        return np.ascontiguousarray(picture[slice(*self.rows), slice(*self.cols)])


@dataclass(frozen=True)
class Reference:
    """A prepared colour reference, cut to its tissue.

    Attributes:
        rgb: (h, w, 3) uint8 sRGB, cropped to the tissue's bounding box.
        mask: (h, w) bool, True where the pixel is tissue.
        name: label for reports (file name without folder).
        removed: fraction of the photograph that is not tissue.
        group: the folder, library or colour volume that it is one of many of, for the plan.
        credit: whom to name with a result.
        frame: which part of its picture it is; None where that is not known.
    """

    rgb: np.ndarray
    mask: np.ndarray
    name: str
    removed: float
    group: str = ""
    credit: str = ""
    frame: Frame | None = None


def read_picture(path: str) -> np.ndarray:
    """Read a colour picture as (h, w, 3) uint8 sRGB.

    Raises:
        InputError: missing, unreadable, or a grey picture (a reference must have colour).
    """
    import os

    import cv2

    from ..io.pictures import quiet_cv2

    name = os.path.basename(path)
    if not os.path.isfile(path):
        raise InputError(f"reference: no file {path}")
    try:
        with open(path, "rb") as stream:
            data = np.frombuffer(stream.read(), np.uint8)
    except OSError as error:
        raise InputError(f"reference {name}: cannot be read ({error.strerror}); check the permissions") from error
    with quiet_cv2():
        picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if picture is None:
        raise InputError(f"reference {name}: not a picture that can be read; use PNG, JPEG or TIFF")
    if picture.ndim == 2:
        raise InputError(f"reference {name}: a grey picture; the reference must be a colour photograph (RGB)")
    if picture.dtype not in (np.uint8, np.uint16):
        raise InputError(f"reference {name}: {picture.dtype} channels; save it with 8 or 16 bits per channel")
    if picture.dtype == np.uint16:
        picture = np.rint(picture / 65535 * 255).astype(np.uint8)
    if picture.shape[2] == 4:  # transparent is not tissue: the mask takes black at the border as background
        picture = np.where(picture[..., 3:] > 127, picture[..., :3], 0).astype(np.uint8)
    return np.ascontiguousarray(picture[..., ::-1])


def prepare_reference(rgb: np.ndarray, name: str = "reference") -> Reference:
    """Cut the tissue out of a photograph.

    Removes what is not tissue in the Visible Human photographs: blue gelatin (also inside the sinuses), tray, labels and
    the grey scale; and a plain background of any one colour in atlases and drawings.

    Args:
        rgb: (h, w, 3) uint8 sRGB.

    Raises:
        InputError: wrong shape or type, no colour in it, or less than 1 % tissue.
    """
    rgb = np.asarray(rgb)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise InputError(f"reference {name}: expected an RGB picture (h, w, 3) of uint8, got {rgb.dtype} {rgb.shape}")
    if int(np.ptp(rgb.astype(np.int16), axis=2).max()) <= 2:
        raise InputError(f"reference {name}: the picture has no colour; use a colour photograph")
    mask = tissue_mask(rgb)
    fraction = float(mask.mean())
    if fraction < 0.01:
        raise InputError(
            f"reference {name}: no tissue found ({100 * fraction:.1f} % of the picture); "
            "use a section on a plain or blue background that fills the picture"
        )
    frame = Frame.around(mask)
    return Reference(frame.cut(rgb), frame.cut(mask), name, 1 - fraction, frame=frame)


def on_grid(reference: Reference, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grey 0..1 (H, W), L*a*b* (H, W, 3) and tissue mask (H, W) of a prepared reference on the grid."""
    from ..color.lab import lightness_to_gray, srgb_to_lab

    # background colour must not bleed into the outline when pixels are averaged
    lab = continue_outwards(srgb_to_lab(reference.rgb.astype(np.float64) / 255), reference.mask)
    mask = to_grid(reference.mask, grid) > 0.5
    lab = continue_outwards(to_grid(lab, grid), mask)
    grey = (lightness_to_gray(lab[..., 0].astype(np.float64)) * mask).astype(np.float32)
    return grey, lab, mask


def tissue_mask(rgb: np.ndarray) -> np.ndarray:
    """(h, w) bool, True on tissue: not background, not blue; large, warm-coloured parts; small holes filled.

    A hole is filled only when it is not blue: dark lumina (vessels, airways) are tissue, gelatin in a sinus is not.
    """
    import cv2
    from scipy import ndimage

    scale = min(1.0, 512 / max(rgb.shape[:2]))
    size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) if scale < 1 else rgb
    lab = cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    blue = _gelatin(lab)
    solid = ~blue & ~_background(lab, blue)
    solid = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    parts = _tissue_parts(solid, lab)
    filled = ndimage.binary_fill_holes(parts) & ~cv2.dilate(blue.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(
        bool
    )
    mask = filled | (parts & ~blue)
    # pixels next to gelatin are mixed with its blue: a rim one pixel wide goes as well
    near_blue = cv2.dilate(blue.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    mask &= ~(near_blue & (lab[..., 2] < 6))
    full = cv2.resize(mask.astype(np.float32), rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR) > 0.5
    return full


def _gelatin(lab: np.ndarray) -> np.ndarray:
    """Blue pixels: clearly negative b*, hue between cyan and violet. Tissue, also grey matter, is on the yellow side."""
    _, a, b = np.moveaxis(lab, 2, 0)
    return (b < -3) & (a < -0.8 * b)


def _background(lab: np.ndarray, blue: np.ndarray) -> np.ndarray:
    """What touches the picture's border and looks like it: black tray, white paper; grown through gelatin."""
    from scipy import ndimage

    border = np.concatenate([lab[0], lab[-1], lab[:, 0], lab[:, -1]])
    dark = lab[..., 0] < 12
    candidates = blue.copy()
    if np.mean(border[:, 0] < 12) > 0.2:
        candidates |= dark
    common = np.median(border, axis=0)
    near = np.linalg.norm(lab - common, axis=2) < 6
    if np.mean(np.linalg.norm(border - common, axis=1) < 6) > 0.5:
        candidates |= near
    labels, _ = ndimage.label(candidates, structure=np.ones((3, 3)))
    touching = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return np.isin(labels, touching[touching > 0])


def _tissue_parts(solid: np.ndarray, lab: np.ndarray) -> np.ndarray:
    """The largest warm-coloured part and others of at least 4 % of it; grey scales, labels and frames are not warm."""
    from scipy import ndimage

    labels, count = ndimage.label(solid)
    if count == 0:
        return solid
    index = np.arange(1, count + 1)
    sizes = ndimage.sum_labels(solid, labels, index)
    redness = ndimage.median(lab[..., 1], labels, index)
    chroma = ndimage.median(np.hypot(lab[..., 1], lab[..., 2]), labels, index)
    touches = np.isin(index, np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    warm = (redness > 0.5) & (chroma > 4)
    order = np.where(warm & ~touches, sizes, np.where(warm, sizes * 0.5, sizes * 1e-3))
    best = order.max()
    keep = (order >= 0.04 * best) & (warm | (order == best))
    return np.concatenate([[False], keep])[labels]
