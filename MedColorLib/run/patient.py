"""The body of a run: found, all of the picture, or as the user gives it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import SettingsError
from ..io.label_volume import present_labels, read_labels, require_scan_grid
from ..parameters import BodyMask, Settings
from ..scan.body import Body, find_body, given_body, whole_body
from ..scan.planes import PlaneBlocks, planes_of
from ..scan.slices import SliceOrder
from ..volume import Volume


def choose_body(view: np.ndarray | PlaneBlocks, volume: Volume, settings: Settings, order: SliceOrder) -> Body:
    """The body that the settings ask for.

    Args:
        view: (slice, row, column) scalars of the volume.

    Raises:
        InputError: nothing stands out of the background, or a mask that is empty, no labels or not on the volume's grid.
        SettingsError: neither auto nor all nor a file.
    """
    if settings.body == "auto":
        _, row_mm, column_mm = (float(volume.spacing_mm[2 - axis]) for axis in order.axes)
        return find_body(view, (row_mm, column_mm))
    if settings.body == "all":
        return whole_body(view.shape)
    mask = settings.body if isinstance(settings.body, BodyMask) else _read_mask(settings.body)
    labels = mask.labels if mask.placed else Volume(mask.labels.array, volume.ijk_to_ras, name=mask.labels.name)
    require_scan_grid(labels, volume, "body")
    present_labels(labels, "body")
    if np.array_equal(labels.array, volume.array) and labels.array.max() > 1:
        raise SettingsError(f"body: {labels.name} is the scan itself; give a label volume: 0 is air, all else the body")
    return given_body(planes_of(order.view(labels.array)), labels.name)


def describe_body(body: Body, chosen: int) -> str:
    """One line for the plan.

    Args:
        chosen: slices that will be coloured.
    """
    left = f"; {body.left_outside.describe()}" if body.left_outside else ""
    return f"{chosen} of {len(body.boxes)} slices; {body.text}{left}"


def report_body(body: Body) -> dict:
    """Plain data for the report."""
    left = body.left_outside
    return {
        "how": body.text,
        "left_out_fraction": left and round(left.share, 4),
        "left_out_as_plates": left and round(left.plates, 4),
        "left_out_of_slices": {str(k): round(float(left.of_slice[k]), 4) for k in left.slices} if left else {},
        "warning": left and left.warning(),
    }


def _read_mask(path: str) -> BodyMask:
    if not Path(path).exists():
        raise SettingsError(
            f"body: {path!r} is neither auto nor all nor a file; give a label volume on the scan's grid"
        )
    return BodyMask(read_labels(Path(path)), placed=True)
