"""Stage *body*: which voxels belong to the patient, which slices are empty, where to crop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..progress import check
from .air import Air, find_air
from .ghosts import take_ghosts
from .parts import BODY, CLEAR, PLATE, TISSUE, filled, mark_body, mark_plates, without_mottle
from .reduced import raster, reduced, resized

_WORK_SIDE = 256  # in-plane pixels at which the outline is found; finer adds noise and time, not outline
WARN_FROM = 0.02  # of what is not air, left out of the body: in a slice or in all
_SMALLEST = 0.002  # of the picture: less is not worth a warning


@dataclass(frozen=True)
class LeftOutside:
    """What is not air and yet was left out of the body.

    Attributes:
        share: of all that is not air, 0..1.
        plates: the part of `share` that was taken for a table, a holder or wires.
        of_slice: (k,) float, the same share slice by slice; 0 where next to nothing was left out.
    """

    share: float
    plates: float
    of_slice: np.ndarray

    @property
    def slices(self) -> list[int]:
        """Slices k with a share of 2 % or more."""
        return [int(k) for k in np.flatnonzero(self.of_slice >= WARN_FROM)]

    def describe(self) -> str:
        """For the plan and the report."""
        text = f"left out of the body: {100 * self.share:.1f} % of what is not air"
        if self.plates >= 0.0005:
            text += f" ({100 * self.plates:.1f} % as table, holder or wires)"
        return text

    def warning(self) -> str | None:
        """What to say and do where 2 % or more were left out; None where less was."""
        if self.share < WARN_FROM and not self.slices:
            return None
        where = f"; 2 % or more in slices {ranges_text(self.slices)}" if self.slices else ""
        return f"{self.describe()}{where}; if tissue is missing, give the body as a mask or take all (--body all)"


@dataclass(frozen=True)
class Body:
    """Body mask at reduced resolution and what follows from it.

    Attributes:
        coarse: (k, h, w) bool at reduced in-plane resolution.
        shape: (k, j, i) of the volume.
        threshold: value above which single voxels at the outline belong to the body; -inf where all of them do.
        boxes: (k, 4) int, [j0, j1, i0, i1) per slice in full pixels; all zero where the slice is empty.
        text: how air and body were told apart, for people.
        left_outside: what is not air and was left out; None where the body was not sought but given.
        given: (k, j, i) label volume in the order of the stack that is the body where it is not 0, or None.
    """

    coarse: np.ndarray
    shape: tuple[int, int, int]
    threshold: float
    boxes: np.ndarray
    text: str = ""
    left_outside: LeftOutside | None = None
    given: np.ndarray | None = None

    @property
    def slices(self) -> np.ndarray:
        """Indices k of slices that hold body."""
        return np.flatnonzero(self.boxes[:, 1] > self.boxes[:, 0])

    def plane(self, k: int) -> np.ndarray:
        """(j, i) float32 0..1: coverage by the body, smooth at the outline; 0.5 is the outline."""
        import cv2

        if self.given is not None:
            return (self.given[k] != 0).astype(np.float32)
        _, rows, cols = self.shape
        return cv2.resize(self.coarse[k].astype(np.float32), (cols, rows), interpolation=cv2.INTER_LINEAR)

    def painted(self, k: int, values: np.ndarray) -> np.ndarray:
        """(j, i) bool: where slice k is coloured: its body, and tissue within a coarse pixel or a slice of it.

        The outline is found on a coarse raster; rendered as it is, skin would show its steps. Voxels around it that are
        above the threshold belong to the body, too. A body that was given is coloured as it is.

        Args:
            values: (j, i) of the slice.
        """
        import cv2

        if self.given is not None:
            return self.given[k] != 0
        near = self.coarse[max(k - 1, 0) : k + 2].any(axis=0).astype(np.uint8)
        wide = cv2.dilate(near, np.ones((3, 3), np.uint8)).astype(np.float32)
        _, rows, cols = self.shape
        rim = cv2.resize(wide, (cols, rows), interpolation=cv2.INTER_LINEAR) > 0.5
        return (self.plane(k) > 0.5) | (rim & (values > self.threshold))


def find_body(array: np.ndarray, pixel_mm: tuple[float, float] = (1.0, 1.0)) -> Body:
    """Outline the patient: all that is not air, without table and noise, cavities filled slice by slice.

    What air is comes from the border of the pictures, see `air`. Air inside the outline (lungs, sinuses) counts as body, so
    that it is not mistaken for background; it stays black by its luminance. Parts that are not joined stay.

    Args:
        array: (k, j, i) scalars, rows and columns in the transverse plane. Read plane by plane.
        pixel_mm: distances between rows and between columns; their ratio matters.

    Raises:
        InputError: nothing stands out of the background.
    """
    air = find_air(array, pixel_mm)
    flags = _flags(array, air, raster(array.shape, pixel_mm, _WORK_SIDE))
    ghosts = take_ghosts(flags, array, air)
    if air.is_absent:
        for plane in flags:
            plane[(plane & TISSUE) > 0] |= BODY
    else:
        if air.plates:
            mark_plates(flags)
        mark_body(flags, air.plates)
        _fill(flags)
    coarse = np.empty(flags.shape, bool)
    for out, plane in zip(coarse, flags):
        out[:] = (plane & BODY) > 0
    if not coarse.any():
        raise InputError(
            "body: nothing stands out of the background; check the volume, or take all of it as body (--body all)"
        )
    text = air.text + (f"; ghosts beside the body, {100 * ghosts:.1f} % of what is brighter, are air" if ghosts else "")
    return Body(coarse, array.shape, air.edge, _boxes(coarse, array.shape), text, _left_outside(flags))


def whole_body(shape: tuple[int, int, int]) -> Body:
    """Everything is body, as the user asked."""
    coarse = np.ones((shape[0], *raster(shape, (1.0, 1.0), _WORK_SIDE)), bool)
    return Body(coarse, shape, -np.inf, _boxes(coarse, shape), "all of the picture, as given")


def given_body(labels: np.ndarray, name: str) -> Body:
    """The body is where a label volume is not 0.

    Args:
        labels: (k, j, i) in the order of the stack.

    Raises:
        InputError: it is 0 everywhere.
    """
    shape = labels.shape
    size = raster(shape, (1.0, 1.0), _WORK_SIDE)
    coarse = np.empty((shape[0], *size), bool)
    boxes = np.zeros((shape[0], 4), np.int64)
    for k, plane in enumerate(labels):
        inside = plane != 0
        coarse[k] = resized(inside.astype(np.float32), size) >= 0.5
        boxes[k] = _box(inside, (1, 1))
    if not boxes.any():
        raise InputError(f"body: the mask {name} is 0 everywhere; it has to be 1 (or another label) where the body is")
    return Body(coarse, shape, np.inf, boxes, f"mask {name}, as given", given=labels)


def ranges_text(numbers: list[int], most: int = 12) -> str:
    """ "0 to 3, 7, 9 to 12" of ascending whole numbers; at most `most` of such ranges."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    parts = [f"{first} to {last}" if last > first else f"{first}" for first, last in runs[:most]]
    rest = sum(last - first + 1 for first, last in runs[most:])
    return ", ".join(parts) + (f" and {rest} more" if rest else "")


def _flags(array: np.ndarray, air: Air, size: tuple[int, int]) -> np.ndarray:
    """(k, h, w) uint8 on the reduced raster: TISSUE where there is no air, CLEAR where that is beyond doubt."""
    scale = air.scale
    flags = np.zeros((len(array), *size), np.uint8)
    if air.is_absent and not scale.missing:
        flags += TISSUE | CLEAR
        return flags
    threshold, strong, clear, lung = (
        -np.inf if air.is_absent else scale.grey_of(value) if value is not None else None
        for value in (air.threshold, air.strong, air.clear, air.lung)
    )
    radius = max(1, round(max(flags.shape[1:]) / 100))
    for out, plane in zip(flags, array):
        check()
        grey, missing = reduced(plane, scale, size, 0.7)
        measured = True if missing is None else ~missing
        tissue = (grey > threshold) & measured
        if strong > threshold:
            tissue = without_mottle(tissue, (grey > strong) & measured, radius) & measured
        out[tissue] |= TISSUE
        out[tissue & (grey > clear)] |= CLEAR
        if lung is not None:
            out[_cut_lung(grey, ~tissue & measured, lung)] |= TISSUE
    return flags


def _cut_lung(grey: np.ndarray, dark: np.ndarray, lung: float) -> np.ndarray:
    """(h, w) bool: dark regions that reach the border and are lung there, cut by the picture, by their median."""
    import cv2

    found = np.zeros(dark.shape, bool)
    labels = cv2.connectedComponents(dark.astype(np.uint8), connectivity=4)[1]
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    for label in border[border > 0]:
        region = labels == label
        if np.median(grey[region]) > lung:
            found |= region
    return found


def _fill(flags: np.ndarray) -> None:
    radius = max(1, round(max(flags.shape[1:]) / 64))
    for plane in flags:
        check()
        body = (plane & BODY) > 0
        if body.any():
            plane[filled(body, radius)] |= BODY


def _left_outside(flags: np.ndarray) -> LeftOutside:
    counts = np.zeros((len(flags), 3), np.int64)  # not air, of it outside, of that plates
    for count, plane in zip(counts, flags):
        outside = (plane & (TISSUE | BODY)) == TISSUE
        count[:] = (
            np.count_nonzero(plane & (TISSUE | BODY)),
            np.count_nonzero(outside),
            np.count_nonzero(outside & ((plane & PLATE) > 0)),
        )
    total, outside, plates = (int(n) for n in counts.sum(0))
    shares = counts[:, 1] / np.maximum(counts[:, 0], 1)
    shares[counts[:, 1] < _SMALLEST * flags[0].size] = 0
    return LeftOutside(outside / max(total, 1), plates / max(total, 1), shares)


def _box(plane: np.ndarray, scale) -> tuple[int, int, int, int]:
    rows, cols = np.flatnonzero(plane.any(1)), np.flatnonzero(plane.any(0))
    if not rows.size:
        return 0, 0, 0, 0
    j0, j1 = np.floor(rows[0] * scale[0]), np.ceil((rows[-1] + 1) * scale[0])
    i0, i1 = np.floor(cols[0] * scale[1]), np.ceil((cols[-1] + 1) * scale[1])
    return int(j0), int(j1), int(i0), int(i1)


def _boxes(coarse: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    scale = shape[1] / coarse.shape[1], shape[2] / coarse.shape[2]
    return np.array([_box(plane, scale) for plane in coarse], np.int64)
