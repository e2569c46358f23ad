"""Stage *guard*: tissue labels that matching and colour never cross.

A label volume on the scan's grid, a segmentation, puts every voxel into a group. Evidence of colour is kept apart by group
and spreads within its own group only. Where the references have label pictures, too, a voxel takes colours of its own
group and of no other one: groups join the features so strongly that nothing else outvotes them, and votes of another group
do not count. A group that a reference's labels lack has no counterpart there and is matched freely.

Photographs are averaged onto the raster within groups, so that no mixed colour arises there either.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import InputError, SettingsError
from ..io.label_picture import read_label_picture
from ..io.label_volume import HIGHEST_LABEL, present_labels, require_scan_grid
from ..parameters import Settings
from ..references.photograph import Reference
from ..scan.grid import MARGIN, Grid, to_grid
from ..scan.planes import PlaneBlocks, planes_of
from ..scan.slices import SliceOrder
from ..volume import Volume

MOST_GROUPS = 16  # each of them has its own evidence, in memory and in time
OTHER = 255  # index of pixels whose group the volume does not have
NOWHERE = 254  # of raster pixels outside the body's box or the reference's tissue


@dataclass(frozen=True, eq=False)
class Guard:
    """Labels of the scan, and of the references where there are any.

    Attributes:
        labels: on exactly the scan's grid, whole numbers 0 to 65535. 0 means "no label", which is a group like any other.
        reference_labels: for each reference, in order, a PNG (grey or palette), an (h, w) array of whole numbers with the
            size of the reference's picture, or None. None altogether: only colour is kept apart.
        groups: label -> group, whole numbers; labels with one group belong together. Labels that are not named are a group
            of their own, with their own number.
        present: the groups of the volume, ascending; at most 16.

    Raises:
        InputError: labels that are not whole numbers from 0 to 65535, or too many groups.
        SettingsError: groups that are not whole numbers from 0 to 65535.
    """

    labels: Volume
    reference_labels: Sequence | None = None
    groups: Mapping[int, int] | None = None
    present: tuple[int, ...] = field(init=False, default=())
    members: dict[int, tuple[int, ...]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        given = self.reference_labels
        if given is not None:
            one = isinstance(given, (str, Path)) or (isinstance(given, np.ndarray) and given.ndim == 2)
            object.__setattr__(self, "reference_labels", (given,) if one else tuple(given))
        object.__setattr__(self, "groups", _checked_groups(self.groups or {}))
        for label in present_labels(self.labels, "tissue guard"):
            group = self.groups.get(label, label)
            self.members[group] = (*self.members.get(group, ()), label)
        object.__setattr__(self, "present", tuple(sorted(self.members)))
        if len(self.present) > MOST_GROUPS:
            raise InputError(
                f"tissue guard: {self.labels.name} has {len(self.present)} label groups, at most {MOST_GROUPS} are kept "
                "apart; join labels into groups (--label-group 1,2,5-9)"
            )

    @property
    def table(self) -> np.ndarray:
        """(65536,) uint8: label -> index into `present`, OTHER for a group that the volume does not have."""
        index = {group: n for n, group in enumerate(self.present)}
        table = np.full(HIGHEST_LABEL + 1, OTHER, np.uint8)
        table[list(self.present)] = range(len(self.present))
        for label, group in self.groups.items():
            table[label] = index.get(group, OTHER)
        return table

    def name_of(self, index: int) -> str:
        """The labels of a group for people: "1+2+5", "0 (no label)"."""
        labels = self.members[self.present[index]]
        return "0 (no label)" if labels == (0,) else "+".join(map(str, labels))


@dataclass(frozen=True, eq=False)
class Groups:
    """A guard made ready for one run.

    Attributes:
        guard: as given. table: (65536,) uint8, see `Guard.table`.
        view: (slice, row, column) labels, in the order of the stack.
        pictures: for each reference (h, w) uint8 group indices, cut as its picture is, or None.
        missing: for each reference the indices of groups without counterpart in its labels, or None without labels.
        hashes: for each reference the SHA-256 of its label picture, or None.
    """

    guard: Guard
    table: np.ndarray
    view: np.ndarray | PlaneBlocks
    pictures: tuple[np.ndarray | None, ...]
    missing: tuple[tuple[int, ...] | None, ...]
    hashes: tuple[str | None, ...]

    def __len__(self) -> int:
        return len(self.guard.present)

    def in_box(self, k: int, box: Sequence[int]) -> np.ndarray:
        """(rows, cols) uint8 group indices of slice k inside `box` [j0, j1, i0, i1)."""
        j0, j1, i0, i1 = box
        return self.table[self.view[k, j0:j1, i0:i1].astype(np.intp)]

    def on_grid(self, k: int, box: Sequence[int], grid: Grid) -> np.ndarray:
        """(H, W) uint8 group indices of slice k on the grid, nearest neighbour; NOWHERE in the margin."""
        labels = self.in_box(k, box)
        rows, cols = (((np.arange(n) + 0.5) * size / n).astype(int) for n, size in zip(grid.inner, labels.shape))
        return np.pad(labels[np.ix_(rows, cols)], MARGIN, constant_values=NOWHERE)

    def describe(self, references: Sequence[Reference]) -> str:
        """One line for the plan."""
        names = ", ".join(self.guard.name_of(n) for n in range(len(self)))
        text = f"{len(self)} label groups of {self.guard.labels.name} ({names}); colour does not spread across them"
        labelled = sum(picture is not None for picture in self.pictures)
        if not labelled:
            return f"{text}; no reference has labels, so matching may still cross them"
        with_labels = "" if labelled == len(self.pictures) else f" with {labelled} of {len(self.pictures)} references"
        return "; ".join([f"{text}; matching{with_labels} stays within them", *self.unguarded(references)])

    def unguarded(self, references: Sequence[Reference]) -> list[str]:
        """Groups without counterpart, one sentence for each reference that lacks some."""
        return [
            f"{reference.name} lacks {', '.join(map(self.guard.name_of, missing))}: matched freely"
            for reference, missing in zip(references, self.missing)
            if missing
        ]

    def report(self, references: Sequence[Reference]) -> dict:
        """Plain data, JSON-ready."""
        return {
            **self.identity(),
            "name": self.guard.labels.name,
            "groups": {str(group): list(labels) for group, labels in sorted(self.guard.members.items())},
            "without_counterpart": {
                r.name: [self.guard.present[n] for n in missing]
                for r, missing in zip(references, self.missing)
                if missing is not None
            },
        }

    def identity(self) -> dict:
        """What matches depend on: hashes of all labels, and the groups that were asked for."""
        from ..report import voxels_sha256

        labels = self.guard.labels.array
        return {
            "labels_sha256": voxels_sha256(labels),
            "labels_dtype": labels.dtype.name,
            "reference_labels_sha256": list(self.hashes),
            "joined": sorted(self.guard.groups.items()),
        }


def prepare_guard(
    guard: Guard, volume: Volume, references: Sequence[Reference], settings: Settings, order: SliceOrder, grid: Grid
) -> Groups:
    """Check a guard against what it shall guard.

    Raises:
        InputError: labels on another grid, label pictures of another number or size.
        SettingsError: the smoother does not keep evidence apart.
    """
    if not settings.weighs_matches:
        raise SettingsError(
            f"tissue guard: smoother {settings.resolved_smoother} with preset {settings.preset} does not weigh matches and "
            "would spread colour across labels; use smoother regression, or fgs, domain-transform or wls with preset draft "
            "or balanced"
        )
    require_scan_grid(guard.labels, volume, "tissue guard")
    table = guard.table
    given = guard.reference_labels or (None,) * len(references)
    if len(given) != len(references):
        raise InputError(
            f"tissue guard: {len(given)} label pictures for {len(references)} references; give one for each, in their order "
            "(None, on the command line '-', for one without)"
        )
    cut = [None if one is None else _cut(one, reference) for one, reference in zip(given, references)]
    pictures = tuple(None if labels is None else table[labels] for labels in cut)
    missing = tuple(
        None if picture is None else _missing(picture, reference, grid, len(guard.present))
        for picture, reference in zip(pictures, references)
    )
    hashes = tuple(None if labels is None else hashlib.sha256(labels.tobytes()).hexdigest() for labels in cut)
    return Groups(guard, table, planes_of(order.view(guard.labels.array)), pictures, missing, hashes)


def groups_on_grid(picture: np.ndarray, reference: Reference, grid: Grid) -> np.ndarray:
    """(H, W) uint8: the group that covers most of each raster pixel's tissue; NOWHERE where there is none.

    Args:
        picture: (h, w) uint8 group indices, cut as the reference is.
    """
    found = np.full((grid.height, grid.width), NOWHERE, np.uint8)
    best = np.zeros(found.shape, np.float32)
    for index in np.unique(picture[reference.mask]):
        cover = to_grid(reference.mask & (picture == index), grid)
        larger = cover > best
        found[larger], best[larger] = index, cover[larger]
    return found


def colors_on_grid(
    picture: np.ndarray, reference: Reference, grid: Grid, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colours of a reference on the grid, averaged within groups only, and its groups.

    Args:
        picture: as for `groups_on_grid`. mask: (H, W) bool, tissue on the grid.

    Returns:
        L*a*b* (H, W, 3) float32 and group indices (H, W) uint8; outside the mask those of the nearest tissue.
    """
    from scipy import ndimage

    from ..color.lab import srgb_to_lab

    lab = srgb_to_lab(reference.rgb.astype(np.float64) / 255).astype(np.float32)
    groups = groups_on_grid(picture, reference, grid)
    colors = np.zeros((*groups.shape, 3), np.float32)
    for index in np.unique(groups[mask]):
        own, here = (reference.mask & (picture == index))[..., None], groups == index
        colors[here] = to_grid(lab * own, grid)[here] / to_grid(own.astype(np.float32), grid)[here]
    rows, cols = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return colors[rows, cols], groups[rows, cols]


def _missing(picture: np.ndarray, reference: Reference, grid: Grid, count: int) -> tuple[int, ...]:
    there = np.unique(groups_on_grid(picture, reference, grid)[to_grid(reference.mask, grid) > 0.5])
    return tuple(n for n in range(count) if n not in there)


def _cut(labels, reference: Reference) -> np.ndarray:
    """(h, w) int64 labels of a reference, cut and made smaller as its picture was."""
    if isinstance(labels, np.ndarray):
        values, name = labels, reference.name
    else:
        values, name = read_label_picture(labels), Path(labels).name
    if values.ndim != 2 or values.dtype.kind not in "iub" or values.min() < 0 or values.max() > HIGHEST_LABEL:
        raise InputError(
            f"reference labels {name}: expected (h, w) whole numbers from 0 to {HIGHEST_LABEL}, got {values.dtype} "
            f"{values.shape}"
        )
    frame = reference.frame
    if frame is None or values.shape != frame.shape:
        size = "unknown" if frame is None else f"{frame.shape[1]} x {frame.shape[0]}"
        raise InputError(
            f"reference labels {name}: {values.shape[1]} x {values.shape[0]} pixels, but the picture of {reference.name} has "
            f"{size}; draw the labels on the picture itself"
        )
    inner = frame.cut(values)
    rows, cols = (((np.arange(n) + 0.5) * size / n).astype(int) for n, size in zip(reference.mask.shape, inner.shape))
    return inner[np.ix_(rows, cols)].astype(np.int64)


def _checked_groups(groups: Mapping[int, int]) -> dict[int, int]:
    for number in (n for pair in groups.items() for n in pair):
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or not 0 <= number <= HIGHEST_LABEL:
            raise SettingsError(
                f"tissue guard: groups: expected whole numbers from 0 to {HIGHEST_LABEL}, got {number!r}"
            )
    return {int(label): int(group) for label, group in groups.items()}
