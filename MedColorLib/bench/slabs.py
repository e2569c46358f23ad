"""Coherence: how far the colours of neighbouring slices differ where their grey values agree, with and without averaging."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..color.difference import ciede2000
from ..color.lab import srgb_to_lab
from ..errors import MedColorError
from ..parameters import Settings
from ..progress import Progress
from ..run.prepare import Prepared, prepare
from ..volume import Volume
from .pairs import SECTIONS
from .regions import CT_FILE
from .tables import Suite, Table

COLUMNS = ("volume", "features", "slices", "voxels", "with_coherence", "slice_by_slice", "ratio")
MR_FOLDER = "mr_head_t1_dicom"
_CT_SLICES, _MR_SLICES = (110, 134), (14, 34)
_LEVEL = 1 / 255  # of the window: neighbouring voxels count as equal up to half of it

NOTES = [
    "coherence: mean CIEDE2000 between the colours of neighbouring slices, at voxels inside both bodies whose display grey "
    "agrees within half a grey level of 255: with the default's averaging along the stack, and with coherence_mm = 0; ratio: "
    "how many times less. Results are 8-bit, so that equal colours may differ by rounding.",
]


@dataclass(frozen=True)
class Slab:
    """A piece of a volume and its reference (path or (h, w, 3) uint8)."""

    name: str
    volume: Volume
    reference: object


def load_slabs(data: Path | None, quick: bool) -> list[Slab]:
    """A slab of the phantom, and in a full run slabs of the real CT and MR where they are."""
    from ..io.files import read_volume
    from ..phantom import sample

    volume, reference = sample()
    found = [Slab("phantom", _cut(volume, (20, 28) if quick else (12, 36)), reference)]
    if quick:
        return found
    head = None if data is None else data / SECTIONS["head"]
    if head is None or not head.is_file():
        return found
    for name, file, slices in (("CT head", CT_FILE, _CT_SLICES), ("MR head", MR_FOLDER, _MR_SLICES)):
        if (data / file).exists():
            found.append(Slab(name, _cut(read_volume(data / file), slices), str(head)))
    return found


def _cut(volume: Volume, slices: tuple[int, int]) -> Volume:
    first, stop = slices
    shift = np.eye(4)
    shift[2, 3] = first
    return Volume(volume.array[first:stop], volume.ijk_to_ras @ shift, volume.window, volume.name)


def run(suite: Suite, data: Path | None, quick: bool, progress: Progress) -> None:
    """Add the table `coherence` to the suite."""
    table = Table(COLUMNS)
    suite.notes.extend(NOTES)
    listed = load_slabs(data, quick)
    if not quick and len(listed) < 3:
        suite.failures.append(
            ("coherence on the CT and the MR", "they or the photograph of the head are not here (--data)")
        )
    settings = Settings(preset="draft", features="embedded") if quick else Settings()
    for number, slab in enumerate(listed):
        progress(number / len(listed), f"coherence, {slab.name}")
        try:
            measure(table, slab, settings)
        except MedColorError as error:
            suite.failures.append((f"coherence on {slab.name}", str(error)))
    if table.rows:
        suite.tables["coherence"] = table


def measure(table: Table, slab: Slab, settings: Settings) -> None:
    """Colour a slab twice and add a row."""
    from ..pipeline import colorize

    prepared = prepare(slab.volume, [slab.reference], settings)
    pairs = equal_voxels(prepared)
    colored = colorize(slab.volume, [slab.reference], settings)
    alone = colorize(slab.volume, [slab.reference], replace(settings, coherence_mm=0.0))
    means = [flicker(prepared.order.view(result.rgb), pairs) for result in (colored, alone)]
    table.add(
        volume=slab.name,
        features=prepared.plan.features,
        slices=len(prepared.plan.slices),
        voxels=int(pairs.sum()),
        with_coherence=means[0],
        slice_by_slice=means[1],
        ratio=means[1] / means[0] if means[0] > 0 else None,
    )


def equal_voxels(prepared: Prepared) -> np.ndarray:
    """(n - 1, rows, cols) bool: inside the body in a slice and the next, with the same display grey in both."""
    view, window = prepared.view, prepared.window
    grey = np.clip((view.astype(np.float32) - window.low) / (window.high - window.low), 0, 1)
    body = np.stack([prepared.body.painted(k, plane) for k, plane in enumerate(view)])
    return (np.abs(np.diff(grey, axis=0)) <= _LEVEL / 2) & body[1:] & body[:-1]


def flicker(rgb: np.ndarray, pairs: np.ndarray) -> float:
    """Mean CIEDE2000 between neighbouring slices of (n, rows, cols, 3) uint8 at the voxels of `pairs` (n - 1, rows, cols)."""
    total = 0.0
    for k, where in enumerate(pairs):
        before, after = (srgb_to_lab(rgb[n][where].astype(np.float64) / 255) for n in (k, k + 1))
        total += float(ciede2000(before, after).sum())
    return total / max(int(pairs.sum()), 1)
