"""Is all of the patient coloured, and nothing else? Real volumes, by a rule that shares nothing with finding the body.

Clear tissue: for each volume a level was read off its pictures that no air, noise, ghost or foam reaches (in Hounsfield
units -200, elsewhere well above the brightest background seen). Voxels count whose mean over 3 x 3 in their slice lies above
it and into which a disc fits (3 x 3 pixels; in CT 12 mm across, so that table, sheets, wires and holders fall out), in 3-D
connected parts of at least 0.2 % of all such voxels. The share of them that is not coloured is `left_black`; `worst` is that
of the worst slice among those with at least a twentieth of the fullest slice's clear tissue.

Beside the body: coloured voxels above the level below which nobody sees them (`visible`), outside clear tissue with its holes
filled in each slice and 5 mm around it: table, headrest, sheets, noise and ghosts. As a share of all coloured voxels.

Large volumes are looked at on every second or third row and column.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import MedColorError
from ..parameters import Settings
from ..progress import Progress
from ..run.patient import choose_body
from ..scan.planes import planes_of
from ..scan.slices import slice_order
from ..volume import Volume
from .tables import Suite, Table

COLUMNS = ("volume", "slices", "clear", "left_black", "worst", "beside_body", "seconds_a_slice")
LEFT_BLACK_TARGET, WORST_TARGET, BESIDE_TARGET = 0.01, 0.05, 0.01
_SIDE = 256  # pixels that are looked at along rows and columns, about
_PLATE_MM, _AROUND_MM = 12.0, 5.0
_PART = 0.002
_FULL = 0.05

NOTES = [
    "outline: clear tissue (a level read off each volume's pictures, opened by a disc, in 3-D parts of at least 0.2 %) that is "
    "not coloured, of the volume and of the worst slice; and coloured voxels that can be seen beyond 5 mm around clear tissue "
    "with its holes filled (table, headrest, noise, ghosts), as a share of all that is coloured. The rule knows nothing of how "
    "the body is found.",
]


@dataclass(frozen=True)
class Level:
    """What is clear tissue in a volume, and what can be seen; values as the file has them."""

    clear: float
    visible: float
    is_ct: bool = False


REAL = {
    "vhf_head_ct.nrrd": Level(48, 30, is_ct=True),
    "chest_ct.nrrd": Level(-200, -500, is_ct=True),
    "brain_mr_gd_dicom": Level(150, 75),
    "brain_pd_dicom": Level(110, 55),
    "heart_mr.nrrd": Level(40, 20),
    "head_mr_t2.nii.gz": Level(240, 120),
    "head_mr_t1_3d.nii.gz": Level(60, 30),
    "brain_mr_flair_stripped.nii.gz": Level(40, 20),
    "mr_head_t1_dicom": Level(130, 65),
}
_PHANTOM = {"ct": Level(-200, -500, is_ct=True), "mr": Level(50, 30)}


def run(suite: Suite, data: Path | None, quick: bool, progress: Progress) -> None:
    """Add the table `outline` to the suite: the phantoms, and in a full run the real volumes that are here."""
    table = suite.tables["outline"] = Table(COLUMNS)
    suite.notes.extend(NOTES)
    missing = [] if quick else [name for name in REAL if data is None or not (data / name).exists()]
    if missing:
        suite.failures.append(("outline of real volumes", f"not here (--data): {', '.join(missing)}"))
    volumes = list(_volumes(None if quick else data))
    for number, (name, load, level) in enumerate(volumes):
        progress(number / len(volumes), f"outline, {name}")
        try:
            measure(table, name, load(), level)
        except MedColorError as error:
            suite.failures.append((f"outline of {name}", str(error)))


def _volumes(data: Path | None) -> Iterator[tuple]:
    from ..io.files import read_volume
    from ..phantom import sample

    for modality, level in _PHANTOM.items():
        yield f"phantom {modality.upper()}", lambda modality=modality: sample(modality)[0], level
    for name, level in REAL.items():
        if data is not None and (data / name).exists():
            yield name.split(".")[0], lambda path=data / name: read_volume(path), level


def measure(table: Table, name: str, volume: Volume, level: Level) -> None:
    """Find the body of a volume and add its row."""
    order = slice_order(volume.ijk_to_ras)
    view = planes_of(order.view(volume.array))
    started = time.perf_counter()
    body = choose_body(view, volume, Settings(), order)
    seconds = time.perf_counter() - started
    step = -(-max(view.shape[1:]) // _SIDE)
    every = np.s_[::step, ::step]
    values = np.stack([plane[every] for plane in view])
    painted = np.stack([body.painted(k, view[k])[every] for k in range(len(view))])
    pixel_mm = tuple(step * float(volume.spacing_mm[2 - axis]) for axis in order.axes[1:])
    clear = clear_tissue(values, level, pixel_mm)
    shares = left_black(clear, painted)
    table.add(
        volume=name,
        slices=len(view),
        clear=float(clear.mean()),
        left_black=shares[0],
        worst=shares[1],
        beside_body=beside_body(values, clear, painted, level, pixel_mm),
        seconds_a_slice=seconds / len(view),
    )


def clear_tissue(values: np.ndarray, level: Level, pixel_mm: tuple[float, float]) -> np.ndarray:
    """(k, h, w) bool of (k, h, w) values; see the module."""
    from scipy import ndimage

    disc = _disc(_PLATE_MM / 2, pixel_mm) if level.is_ct else np.ones((3, 3), bool)
    bright = np.empty(values.shape, bool)
    for plane, out in zip(values, bright):
        above = ndimage.uniform_filter(np.nan_to_num(plane.astype(np.float32)), 3) > level.clear
        margin = max(disc.shape)
        out[:] = ndimage.binary_opening(np.pad(above, margin, mode="edge"), disc)[margin:-margin, margin:-margin]
    labels, _ = ndimage.label(bright)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= max(1, _PART * sizes.sum()))[labels]


def left_black(clear: np.ndarray, painted: np.ndarray) -> tuple[float, float]:
    """Share of clear tissue that is not coloured, in the volume and in the worst slice, 0..1."""
    count, lost = clear.sum((1, 2)), (clear & ~painted).sum((1, 2))
    full = count >= max(1, _FULL * count.max())
    return float(lost.sum() / max(count.sum(), 1)), float((lost[full] / count[full]).max(initial=0))


def beside_body(
    values: np.ndarray, clear: np.ndarray, painted: np.ndarray, level: Level, pixel_mm: tuple[float, float]
) -> float:
    """Share of coloured voxels that are seen and lie beyond clear tissue, its holes and 5 mm around it, 0..1."""
    from scipy import ndimage

    disc = _disc(_AROUND_MM, pixel_mm)
    margin, beside = max(disc.shape), 0
    for plane, tissue, colored in zip(values, clear, painted):
        closed = ndimage.binary_closing(np.pad(tissue, margin), disc)
        around = ndimage.binary_dilation(ndimage.binary_fill_holes(closed), disc)[margin:-margin, margin:-margin]
        beside += np.count_nonzero(colored & ~around & (plane > level.visible))
    return beside / max(np.count_nonzero(painted), 1)


def _disc(radius_mm: float, pixel_mm: tuple[float, float]) -> np.ndarray:
    reach = [max(1, round(radius_mm / side)) for side in pixel_mm]
    rows, cols = np.ogrid[-reach[0] : reach[0] + 1, -reach[1] : reach[1] + 1]
    return (rows * pixel_mm[0]) ** 2 + (cols * pixel_mm[1]) ** 2 <= max(radius_mm, *pixel_mm) ** 2
