"""A real CT against a real photograph of the same level of the same body, compared region by region.

CT slice 122 of the Visible Human Female's head and her cryosection show the same anatomy, but not pixel by pixel. So the
median colour of a region in the result is compared with the median colour of the same region of the photograph, both cut
to their bodies and brought to one raster. Regions come from CT thresholds and from where they lie in the body's box.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import MedColorError
from ..progress import Progress
from ..scan.grid import choose_grid, to_grid
from ..volume import Volume
from .matched import Matched
from .pairs import SIZE_PX, Section
from .suite_pipeline import Variant, methods
from .tables import Suite, Table

CT_FILE, CT_SLICE = "vhf_head_ct.nrrd", 122
COLUMNS = ("features", "method", "smoother", "gamma", "region", "a", "b", "true_a", "true_b", "error")
_BONE, _AIR = 105, 25  # grey levels of the file: about 600 HU and -600 HU
_EYE_COLUMNS = (0.355, 0.69)  # centres of the eyeballs in the body's box, in the CT and in the photograph
_NEIGHBOURS = 2  # slices on either side: the body is found in three dimensions


def load_ct(folder: Path | None) -> Volume | None:
    """The slab around the slice, or None where the file is not there."""
    from ..io.files import read_volume

    if folder is None or not (folder / CT_FILE).is_file():
        return None
    volume = read_volume(folder / CT_FILE)
    first = CT_SLICE - _NEIGHBOURS
    shift = np.eye(4)
    shift[2, 3] = first
    return Volume(volume.array[first : CT_SLICE + _NEIGHBOURS + 1], volume.ijk_to_ras @ shift, name="CT slice 122")


def regions(ct: np.ndarray, cover: np.ndarray) -> dict[str, np.ndarray]:
    """Masks (H, W) on the raster. ct: (H, W) values of the file, cover: (H, W) bool body."""
    from scipy import ndimage

    bone = cover & (ct > _BONE)
    soft = cover & ~bone & (ct > _AIR)
    rows = np.linspace(0, 1, ct.shape[0])[:, None] * np.ones(ct.shape[1])
    cols = np.ones(ct.shape[0])[:, None] * np.linspace(0, 1, ct.shape[1])
    left = np.maximum.accumulate(bone, axis=1)
    right = np.maximum.accumulate(bone[:, ::-1], axis=1)[:, ::-1]
    behind = np.maximum.accumulate(bone[::-1], axis=0)[::-1]
    enclosed = soft & left & right
    brain = ndimage.binary_erosion(enclosed & behind & (rows > 0.45), iterations=5)
    fat = ndimage.binary_erosion(enclosed & (rows > 0.2) & (rows < 0.27) & (np.abs(cols - 0.5) > 0.11), iterations=2)
    eye = np.minimum(*(np.hypot(rows - 0.165, cols - centre) for centre in _EYE_COLUMNS)) < 0.04
    rim = ndimage.binary_erosion(cover, iterations=2) & ~ndimage.binary_erosion(cover, iterations=10)
    return {"bone": bone, "brain": brain, "orbital fat": fat, "eye": eye & soft, "skin and fat": rim & soft}


def run(suite: Suite, ct: Volume, head: Section, quick: bool, progress: Progress) -> None:
    """Add the table `regions` to the suite."""
    table = suite.tables["regions"] = Table(COLUMNS)
    suite.notes.append(__doc__.split("\n\n")[1].replace("\n", " "))
    with_network = any(row[2] == "vgg19" for row in suite.tables["errors"].rows)
    jobs = [m for m in methods(quick, with_network) if not (quick and m.preset == "full")]
    for number, method in enumerate(jobs):
        progress(number / len(jobs), f"CT by region: {method.features} {method.label}")
        try:
            matched = Matched(ct, head.rgb, method, k=_NEIGHBOURS, window=None, slices=(_NEIGHBOURS, _NEIGHBOURS + 1))
        except MedColorError as error:
            suite.failures.append((f"CT by region, {method.features} {method.label}", str(error)))
            continue
        for variant in (Variant("regression", False), Variant("fgs", True)):
            _add(table, matched, head, {"features": method.features, "method": method.label, **vars(variant)})


def _add(table: Table, matched: Matched, head: Section, keys: dict) -> None:
    grid = choose_grid(SIZE_PX)
    plane = matched.prepared.view[_NEIGHBOURS].astype(np.float32)
    cover = matched.prepared.body.plane(_NEIGHBOURS)
    chroma = to_grid(matched.box(matched.chroma(keys["smoother"], keys["gamma"])), grid)
    masks = regions(to_grid(matched.box(plane), grid), to_grid(matched.box(cover), grid) > 0.5)
    for name, mask in masks.items():
        true = np.median(head.lab[mask & head.mask, 1:], axis=0)
        got = np.median(chroma[mask], axis=0)
        columns = {"a": got[0], "b": got[1], "true_a": true[0], "true_b": true[1], "error": np.hypot(*(got - true))}
        table.add(**keys, region=name, **columns)
