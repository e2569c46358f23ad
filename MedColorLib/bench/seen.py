"""What a viewer sees: whole CIEDE2000, lightness included, of finished colours against photographs of real tissue.

Every measure takes `colorize(volume, references, settings) -> ColorVolume` (`MedColorLib.colorize`, or a trivial method of
`trivial`) and the folder of the real images, and takes a few seconds:

    from MedColorLib import Settings, colorize
    from MedColorLib.bench import seen
    head_ct(colorize, data, Settings())        -> Regions: CT slice 122 against the photograph of its level
    chest_ct(colorize, data, Settings())       -> Chest: chest CT against the thorax photograph, by tissue
    thorax_pairs(colorize, data, Settings())   -> {remap: Seen}: pairs with known colours, error of the final sRGB

Exposure: how bright a photograph was taken says nothing about tissue, and a method may develop it (`exposure`). So one gain
in linear light, the same for all regions, is free: the photograph's colours are multiplied by the gain between 1/4 and 4
with which the mean error is smallest. Beside it stands the error with the photograph as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..color.difference import ciede2000
from ..color.lab import lab_to_linear, linear_to_xyz, srgb_to_lab, srgb_to_linear, xyz_to_lab
from ..parameters import Settings
from ..volume import ColorVolume, Volume
from .drawn_regions import HEAD, THORAX, drawn
from .pairs import REMAPS, SECTIONS, SIZE_PX, Pair, Section, make_pair, make_section
from .quality import worst_patch

Colorize = Callable[[Volume, list, Settings], ColorVolume]

CT_FILE, CT_SLICE = "vhf_head_ct.nrrd", 122
CHEST_FILE = "chest_ct.nrrd"
CHEST_SLICES = (40, 58)  # heart without liver; lungs, breasts, shoulder blades
_NEIGHBOURS = 4  # slices on either side of the CT slice: body, window and coherence are found in three dimensions
GAINS = tuple(float(gain) for gain in np.geomspace(0.25, 4, 129))  # the middle one is 1
EVERY_SIXTEENTH = np.zeros((SIZE_PX, SIZE_PX), bool)
EVERY_SIXTEENTH[2::4, 2::4] = True

HEAD_TARGET, HEAD_TARGET_REFERENCE = (6.0, 12.0), (4.0, 9.0)  # mean, worst: defaults; slider at the reference's
CHEST_TARGET, FAT_TO_MUSCLE_TARGET = (8.0, 14.0), 30.0
PAIR_TARGETS = {"as it is": 2.0, "g^0.6": 3.0, "two-to-one": 5.0, "inverted": 4.0}
SEEN_REMAPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as it is": REMAPS["as it is"],
    "g^0.6": lambda g: g**0.6,
    "two-to-one": lambda g: np.abs(2 * g - 1),
    "inverted": REMAPS["inverted"],
}


@dataclass(frozen=True)
class Seen:
    """One comparison: CIEDE2000 with the best exposure gain, that gain, and CIEDE2000 with the photograph as it is.

    `chroma`: mean with that gain and with the photograph's lightness put in, so of a*, b* alone.
    """

    mean: float
    worst: float
    gain: float
    mean_as_it_is: float
    worst_as_it_is: float
    chroma: float = float("nan")


@dataclass(frozen=True)
class Regions:
    """Region -> colours in the result and in the photograph (L*a*b*, exposure as it is), its error; and all together."""

    seen: Seen
    errors: dict[str, float]
    got: dict[str, tuple[float, float, float]]
    true: dict[str, tuple[float, float, float]]

    def text(self) -> str:
        """For people: a line a region."""
        lines = [
            f"{name:16s} got {_numbers(self.got[name])}  photograph x {self.seen.gain:.2f} "
            f"{_numbers(exposed(np.array(self.true[name]), self.seen.gain))}  error {error:5.1f}"
            for name, error in self.errors.items()
        ]
        seen = self.seen
        lines.append(
            f"mean {seen.mean:.2f}, worst {seen.worst:.2f} with the gain {seen.gain:.2f}; "
            f"as it is {seen.mean_as_it_is:.2f}, {seen.worst_as_it_is:.2f}"
        )
        return "\n".join(lines)


@dataclass(frozen=True)
class Chest(Regions):
    """Tissues of the chest, and CIEDE2000 between the fat and the muscle of the result and of the photograph."""

    fat_to_muscle: float = 0.0
    fat_to_muscle_true: float = 0.0


def head_ct(colorize: Colorize, data: Path, settings: Settings | None = None) -> Regions:
    """CT slice 122 coloured after the photograph of the same level, ten regions drawn by hand on both."""
    first = CT_SLICE - _NEIGHBOURS
    slab = cut(load(str(data / CT_FILE)), first, CT_SLICE + _NEIGHBOURS + 1)
    result = colorize(slab, [str(data / SECTIONS["head"])], settings or Settings())
    return score_head(result.rgb[_NEIGHBOURS], data)


def score_head(rgb: np.ndarray, data: Path) -> Regions:
    """The same of a picture: rgb (512, 512, 3) uint8 of CT slice 122."""
    return by_regions(rgb, _photograph(str(data / SECTIONS["head"])), HEAD)


def by_regions(rgb: np.ndarray, photograph: np.ndarray, regions: dict[str, tuple[tuple, tuple]]) -> Regions:
    """Median colours of a result and a photograph, (rows, cols, 3) uint8 each, in regions drawn on both."""
    got = {name: median_lab(rgb, drawn(rgb.shape, shapes)) for name, (shapes, _) in regions.items()}
    true = {name: median_lab(photograph, drawn(photograph.shape, shapes)) for name, (_, shapes) in regions.items()}
    return compare(got, true)


def chest_ct(
    colorize: Colorize, data: Path, settings: Settings | None = None, slices: tuple[int, int] = CHEST_SLICES
) -> Chest:
    """Slices of the chest CT coloured after the thorax photograph, tissues by Hounsfield units and depth."""
    slab = cut(load(str(data / CHEST_FILE)), *slices)
    result = colorize(slab, [str(data / SECTIONS["thorax"])], settings or Settings())
    return score_chest(result.rgb, data, slices)


def score_chest(rgb: np.ndarray, data: Path, slices: tuple[int, int] = CHEST_SLICES) -> Chest:
    """The same of a result: rgb (n, 512, 512, 3) uint8 of `slices` of the chest CT."""
    masks = chest_tissues(str(data / CHEST_FILE), slices)
    photograph = _photograph(str(data / SECTIONS["thorax"]))
    got = {name: median_lab(rgb, masks[name]) for name in THORAX}
    true = {name: median_lab(photograph, drawn(photograph.shape, shapes)) for name, shapes in THORAX.items()}
    all_regions = compare(got, true)
    apart = [float(ciede2000(colors["fat"], colors["muscle"])) for colors in (got, true)]
    return Chest(**vars(all_regions), fat_to_muscle=apart[0], fat_to_muscle_true=apart[1])


def thorax_pairs(
    colorize: Colorize, data: Path, settings: Settings | None = None, seed: int = 0, remaps: tuple = tuple(SEEN_REMAPS)
) -> dict[str, Seen]:
    """The thorax photograph, mirrored, warped and seen in grey: error of the final sRGB, mean over the body."""
    section = section_of(str(data), "thorax")
    return {remap: seen_pair(colorize, section, remap, settings, seed) for remap in remaps}


def seen_pair(
    colorize: Colorize, section: Section, remap: str, settings: Settings | None = None, seed: int = 0
) -> Seen:
    """One pair; `worst` is the mean of the worst patch of 16 x 16 pixels."""
    pair = pair_of(section, remap, seed)
    result = colorize(pair.volume, [section.rgb], replace(settings or Settings(), window=(0.0, 1.0)))
    got = srgb_to_lab(result.rgb[0].astype(np.float64) / 255)

    def measure(gain: float) -> tuple[float, float]:
        error = ciede2000(got, exposed(pair.truth, gain))
        return float(error[pair.mask].mean()), worst_patch(error, pair.mask)

    some = pair.mask & EVERY_SIXTEENTH  # enough to choose a gain from
    found = best_gain(measure, lambda gain: float(ciede2000(got[some], exposed(pair.truth[some], gain)).mean()))
    return replace(found, chroma=_chroma_error(got[pair.mask], exposed(pair.truth[pair.mask], found.gain)))


def pair_of(section: Section, remap: str, seed: int) -> Pair:
    """A pair as `pairs.make_pair` makes it, also for the remaps of this module."""
    pair = make_pair(section, "as it is", seed)
    return replace(pair, remap=remap, grey=np.clip(SEEN_REMAPS[remap](pair.grey), 0, 1) * pair.mask)


def compare(got: dict[str, np.ndarray], true: dict[str, np.ndarray]) -> Regions:
    """Colours of regions, L*a*b* by name, with one exposure gain for all."""
    ours, theirs = np.array(list(got.values())), np.array(list(true.values()))

    def error(gain: float) -> np.ndarray:
        return ciede2000(ours, exposed(theirs, gain))

    seen = best_gain(lambda gain: (float(error(gain).mean()), float(error(gain).max())))
    seen = replace(seen, chroma=_chroma_error(ours, exposed(theirs, seen.gain)))
    errors = dict(zip(got, map(float, error(seen.gain))))
    return Regions(seen, errors, _plain(got), _plain(true))


def _chroma_error(got: np.ndarray, true: np.ndarray) -> float:
    """Mean CIEDE2000 of (n, 3) L*a*b* with the true lightness put in."""
    return float(ciede2000(np.concatenate([true[:, :1], got[:, 1:]], 1), true).mean())


def best_gain(measure: Callable[[float], tuple[float, float]], rough: Callable[[float], float] | None = None) -> Seen:
    """The exposure gain with the smallest mean error, and the errors with it and without.

    Args:
        measure: gain -> mean and worst error. rough: gain -> mean error, to choose the gain by; None takes the measure's.
    """
    rough = rough or (lambda gain: measure(gain)[0])
    gain = min(GAINS, key=rough)
    return Seen(*measure(gain), gain, *measure(1.0))


def exposed(lab: np.ndarray, gain: float) -> np.ndarray:
    """L*a*b* (..., 3) after `gain` in linear light, limited to what sRGB can show."""
    if gain == 1.0:
        return lab
    linear = np.clip(lab_to_linear(np.asarray(lab, np.float64)) * gain, 0, 1)
    return xyz_to_lab(linear_to_xyz(linear))


def median_lab(rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Median L*, a*, b* of the pixels (..., 3) uint8 in the mask."""
    linear = srgb_to_linear(rgb[mask].astype(np.float64) / 255)
    return np.median(xyz_to_lab(linear_to_xyz(linear)), axis=0)


def cut(volume: Volume, first: int, stop: int) -> Volume:
    """Slices first:stop of the array's first axis, in their place."""
    shift = np.eye(4)
    shift[2, 3] = first
    return Volume(volume.array[first:stop], volume.ijk_to_ras @ shift, volume.window, volume.name)


@lru_cache(maxsize=4)
def load(path: str) -> Volume:
    """A volume, kept for the next measure."""
    from .. import read_volume

    return read_volume(path)


def missing_files(data: Path | None) -> list[str]:
    """Names of the real images that the measures need and that are not in the folder."""
    needed = (*SECTIONS.values(), CT_FILE, CHEST_FILE)
    return [name for name in needed if data is None or not (data / name).exists()]


@lru_cache(maxsize=2)
def _photograph(path: str) -> np.ndarray:
    import cv2

    return np.ascontiguousarray(cv2.imread(path)[..., ::-1])


@lru_cache(maxsize=2)
def section_of(folder: str, name: str) -> Section:
    """One of the photographs (key of SECTIONS) on the raster of the benchmark, kept for the next measure."""
    return make_section(name, _photograph(str(Path(folder) / SECTIONS[name])))


@lru_cache(maxsize=2)
def chest_tissues(path: str, slices: tuple[int, int]) -> dict[str, np.ndarray]:
    """Masks (n, 512, 512) of fat, muscle, heart, bone and lung.

    By Hounsfield units, and by depth below the skin and distance from bone and lung; eroded, so that no voxel holds two
    tissues. The body is what lies above -300 HU in one piece after the table is cut off, with its lungs filled in.
    """
    from scipy import ndimage

    volume = load(path)
    masks: dict[str, list] = {name: [] for name in THORAX}
    for hu in volume.array[slice(*slices)].astype(np.float32):
        for name, mask in slice_tissues(hu, float(volume.spacing_mm[0]), ndimage).items():
            masks[name].append(mask)
    return {name: np.stack(planes) for name, planes in masks.items()}


def slice_tissues(hu: np.ndarray, spacing_mm: float, ndimage) -> dict[str, np.ndarray]:
    """Masks of one slice, hu (rows, cols) float32; see `chest_tissues`."""
    solid = ndimage.binary_opening(hu > -300, iterations=4)
    labels, _ = ndimage.label(solid)
    body = ndimage.binary_fill_holes(labels == 1 + np.argmax(np.bincount(labels.ravel())[1:]))
    depth = ndimage.distance_transform_edt(body) * spacing_mm
    smooth = ndimage.gaussian_filter(hu, 1.0)
    soft = body & (smooth > 0) & (smooth < 110)
    lung = ndimage.binary_erosion(body & (hu < -600) & (depth > 15), iterations=3)
    heart = ndimage.binary_erosion(ndimage.binary_opening(soft & (depth > 30), _disc(16)), iterations=4)
    rows = np.flatnonzero(body.any(1))
    behind = np.arange(len(hu))[:, None] > rows[0] + 0.45 * (rows[-1] - rows[0])  # breast glands are not muscle
    muscle = soft & behind & (depth > 8) & (depth < 45) & ~ndimage.binary_dilation(heart, iterations=12)
    fat = body & (smooth > -140) & (smooth < -70) & (depth > 5) & (depth < 30)
    return {
        "fat": ndimage.binary_erosion(fat, iterations=2),
        "muscle": ndimage.binary_erosion(muscle, iterations=2),
        "heart": heart,
        "bone": ndimage.binary_erosion(body & (smooth > 180), iterations=1),
        "lung": lung,
    }


def _disc(radius: int) -> np.ndarray:
    rows, cols = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return np.hypot(rows, cols) <= radius


def _plain(colors: dict[str, np.ndarray]) -> dict[str, tuple]:
    return {name: tuple(round(float(v), 2) for v in lab) for name, lab in colors.items()}


def _numbers(lab) -> str:
    return " ".join(f"{value:5.1f}" for value in lab)
