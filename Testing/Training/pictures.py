"""Pictures by formula: anatomy that never was, seen through two random contrasts. Nothing real is in them.

An anatomy is a map of labels: a body with skin, fat, muscle and bone around it or without, and inside it nested regions,
convolutions, organs with shells, muscles with septa, cavities, vessels. Each label has a role (air, lung, fat, soft, bone) that
contrasts like CT and photographs respect and others ignore. A pair is two views of one anatomy, or of two neighbouring
levels of it, the second one turned a little, scaled and warped; not mirrored, since
MedColor finds out how a photograph lies before it matches.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

OUTSIDE, AIR, LUNG, FAT, SOFT, BONE = range(6)
MOST_LABELS = 240
ABSENT = 0.3  # share of a section's organs, vessels and arms that its neighbour lacks
_ROLES_INSIDE = (AIR, FAT, SOFT, SOFT, SOFT, BONE)


@dataclass(frozen=True)
class Anatomy:
    """Labels (n, n) uint8, 0 outside the body; roles (K,) of the labels; detail (n, n) float32 that every contrast may show."""

    labels: np.ndarray
    roles: np.ndarray
    detail: np.ndarray


@dataclass(frozen=True)
class Pair:
    """Two views of one anatomy.

    Attributes:
        first, second: (side, side) float32 luminance 0..1.
        x, y: (side, side) float32 column and row in `first` of each pixel of `second`.
        valid: (side, side) bool, where the same label is seen in both, inside the body and inside `first`.
        first_tissue, second_tissue: (side, side) uint8, 0 outside the body. Every soft label is a tissue of its own; all fat is
            one, all bone, all lung, all air.
    """

    first: np.ndarray
    second: np.ndarray
    x: np.ndarray
    y: np.ndarray
    valid: np.ndarray
    first_tissue: np.ndarray
    second_tissue: np.ndarray


class _Noise:
    """Smooth random fields; two levels of one anatomy share the first generator and differ by the second."""

    def __init__(self, seed: int, size: int, level: float) -> None:
        self._generators = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
        self._weights = np.cos(level), np.sin(level)
        self.size = size
        self.symmetry = 0.0

    def field(self, cells: float) -> np.ndarray:
        """(n, n) float32, about `cells` bumps along a side, deviation about 0.7, mirrored left-right by `symmetry` 0..1."""
        count = max(2, int(cells)) + 3
        values = sum(w * g.standard_normal((count, count)) for w, g in zip(self._weights, self._generators))
        values = cv2.resize(values.astype(np.float32), (self.size, self.size), interpolation=cv2.INTER_CUBIC)
        if self.symmetry:
            share = self.symmetry / 2
            values = ((1 - share) * values + share * values[:, ::-1]) / np.hypot(1 - share, share)
        return values


class _Canvas:
    """Labels under construction, with the generator of parameters."""

    def __init__(self, seed: int, size: int, level: float) -> None:
        self.rng = np.random.default_rng([seed, 0])
        self.noise = _Noise(seed, size, level)
        self._absent = np.random.default_rng([seed, 3]) if level else None
        self.labels = np.zeros((size, size), np.uint8)
        self.roles = [OUTSIDE]
        self.rows, self.cols = (v.astype(np.float32) for v in np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j])

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def lacks(self) -> bool:
        """Whether this section does not show what another one shows here."""
        return self._absent is not None and bool(self._absent.random() < ABSENT)

    def paint(self, where: np.ndarray, role: int) -> None:
        """A new label."""
        if len(self.roles) < MOST_LABELS:
            self.labels[where] = len(self.roles)
            self.roles.append(role)

    def some_role(self) -> int:
        return int(self.rng.choice(_ROLES_INSIDE))


def make_anatomy(seed: int, size: int, level: float = 0.0) -> Anatomy:
    """An anatomy on a raster of `size`; the same seed with a small `level` (radians) is a neighbouring section of it."""
    canvas = _Canvas(seed, size, level)
    if canvas.chance(0.6):
        canvas.noise.symmetry = canvas.between(0.5, 1.0)
    depth = _outline(canvas)
    canvas.paint(depth > 0, SOFT)
    inner = _layers(canvas, depth)
    fill = canvas.rng.choice([_nested, _convolutions, _organs, _muscles], p=[0.3, 0.25, 0.3, 0.15])
    fill(canvas, depth - inner)
    _small_things(canvas, depth)
    detail = 0.5 * canvas.noise.field(size / canvas.between(3, 7)) + 0.5 * canvas.noise.field(
        size / canvas.between(7, 20)
    )
    return Anatomy(canvas.labels, np.array(canvas.roles), detail.astype(np.float32))


def _outline(canvas: _Canvas) -> np.ndarray:
    """Depth below the skin, about 1 in the middle, below 0 outside."""
    bent = 1 + canvas.between(0.02, 0.12) * canvas.noise.field(4)
    if canvas.chance(0.15):  # a field of view without air
        fall = canvas.between(0.05, 0.45) * bent
        return 1.1 - fall * np.hypot(canvas.rows + canvas.between(-1, 1), canvas.cols)
    power = canvas.between(1.7, 3.5)
    height, width = canvas.between(0.6, 0.95), canvas.between(0.6, 0.95)
    arms = canvas.chance(0.2)
    width = width * 0.75 if arms else width
    radius = (np.abs(canvas.rows / height) ** power + np.abs(canvas.cols / width) ** power) ** (1 / power)
    depth = 1 - radius * bent
    if arms:
        side, thick, low = canvas.between(0.78, 0.9), canvas.between(0.08, 0.2), canvas.between(-0.3, 0.3)
        for sign in () if canvas.lacks() else (-1, 1):
            arm = np.hypot(canvas.rows - low, canvas.cols - sign * side) / thick
            depth = np.maximum(depth, (1 - arm * bent) * thick * 1.3)
    return depth


def _layers(canvas: _Canvas, depth: np.ndarray) -> float:
    """Skin, fat, muscle, bone from outside inwards; returns the depth at which the inside begins."""
    kinds = {
        "head": [
            (SOFT, 0.01, 0.035),
            (FAT, 0.02, 0.1),
            (SOFT, 0.0, 0.05),
            (BONE, 0.02, 0.06),
            (BONE, 0.0, 0.04),
            (BONE, 0.01, 0.03),
        ],
        "torso": [(SOFT, 0.01, 0.025), (FAT, 0.04, 0.25), (SOFT, 0.03, 0.12), (FAT, 0.0, 0.04)],
        "stripped": [],
        "any": [(canvas.some_role(), 0.01, 0.15) for _ in range(canvas.rng.integers(0, 5))],
    }
    kind = canvas.rng.choice(list(kinds), p=[0.35, 0.25, 0.2, 0.2])
    at = 0.0
    uneven = canvas.between(0.0, 0.5)
    for role, low, high in kinds[kind]:
        canvas.paint(depth > at, role)
        here = np.clip(1 + uneven * canvas.noise.field(canvas.between(3, 8)), 0.2, None) if canvas.chance(0.5) else 1.0
        at = at + canvas.between(low, high) * here
        if kind == "torso" and role == SOFT and high > 0.1 and canvas.chance(0.7):  # ribs
            canvas.paint((depth < at) & (depth > 0.05) & (canvas.noise.field(canvas.between(8, 16)) > 0.5), BONE)
    return at


def _nested(canvas: _Canvas, depth: np.ndarray) -> None:
    """Regions in regions."""
    coarse = int(canvas.rng.integers(3, 9))
    count = int(canvas.rng.integers(4, 10))
    fields = [canvas.noise.field(coarse) + 0.6 * canvas.noise.field(coarse * 2) for _ in range(count)]
    region = np.argmax(fields, axis=0)
    inside = depth > 0
    for index in range(count):
        canvas.paint(inside & (region == index), canvas.some_role())
    finer = int(canvas.rng.integers(9, 26))
    parts = np.argmax([canvas.noise.field(finer) for _ in range(3)], axis=0)
    for index in range(count):
        if canvas.chance(0.5):
            for part in (1, 2):
                canvas.paint(inside & (region == index) & (parts == part), canvas.some_role())


def _convolutions(canvas: _Canvas, depth: np.ndarray) -> None:
    """Brain-like: fluid, a folded rim, a core, nuclei and cavities."""
    inside = depth > 0
    canvas.paint(inside, SOFT)  # fluid
    folds = np.abs(canvas.noise.field(canvas.between(8, 18)))
    rim = canvas.between(0.1, 0.35)
    open_to = folds - np.clip(1 - depth / rim, 0, 1) * canvas.between(0.05, 0.35)
    tissue = (depth > canvas.between(0.005, 0.04)) & (open_to > canvas.between(0.0, 0.06))
    canvas.paint(tissue, SOFT)  # cortex
    core = tissue & (folds > canvas.between(0.15, 0.4)) | (depth > rim + canvas.between(0.0, 0.2))
    canvas.paint(core & inside & (depth > 0.05), SOFT)
    for _ in range(canvas.rng.integers(1, 6)):
        _blob(canvas, depth > rim * 0.6, SOFT, paired=canvas.chance(0.7))
    if canvas.chance(0.5):  # the midline
        canvas.paint((np.abs(canvas.cols + 0.02 * canvas.noise.field(4)) < canvas.between(0.006, 0.02)) & inside, SOFT)


def _organs(canvas: _Canvas, depth: np.ndarray) -> None:
    """Organs in fat, lungs, bones with marrow, cavities."""
    inside = depth > 0
    canvas.paint(inside, FAT if canvas.chance(0.6) else SOFT)
    if canvas.chance(0.5):
        lungs = LUNG if canvas.chance(0.7) else AIR
        for _ in range(canvas.rng.integers(1, 3)):
            _blob(canvas, depth > 0.02, lungs, paired=True, low=0.25, high=0.6)
    for _ in range(canvas.rng.integers(3, 14)):
        _blob(canvas, inside, canvas.some_role(), paired=canvas.chance(0.4), shell=canvas.chance(0.5), high=0.45)


def _muscles(canvas: _Canvas, depth: np.ndarray) -> None:
    """Cells with septa of fat between them, and bones."""
    inside = depth > 0
    fields = np.sort([canvas.noise.field(canvas.between(4, 9)) for _ in range(6)], axis=0)
    canvas.paint(inside, SOFT)
    if canvas.chance(0.6):
        canvas.paint(inside & (canvas.noise.field(4) > 0.2), SOFT)
    canvas.paint(inside & (fields[-1] - fields[-2] < canvas.between(0.03, 0.2)), FAT)
    for _ in range(canvas.rng.integers(1, 5)):
        _blob(canvas, inside, BONE, paired=canvas.chance(0.5), shell=True, high=0.35)


def _blob(canvas: _Canvas, where, role: int, paired=False, shell=False, low: float = 0.04, high: float = 0.3) -> None:
    """A bent ellipse, or two of them left and right, perhaps with a shell and something else inside."""
    size = np.exp(canvas.between(np.log(low), np.log(high)))
    y, x, stretch = canvas.between(-0.8, 0.8), canvas.between(-0.8, 0.8), np.exp(canvas.between(-0.6, 0.6))
    angle = canvas.between(0, np.pi)
    bent = 1 + canvas.between(0.0, 0.4) * canvas.noise.field(canvas.between(5, 10))
    rim, inner, second = canvas.between(0.08, 0.35), canvas.some_role(), canvas.chance(0.5)
    radius = None
    for sign in (-1, 1) if paired else (1,):
        dx, dy = canvas.cols * sign - abs(x) if paired else canvas.cols - x, canvas.rows - y
        along, across = np.cos(angle) * dx + np.sin(angle) * dy, np.cos(angle) * dy - np.sin(angle) * dx
        one = np.hypot(along * stretch, across / stretch) / size
        radius = one if radius is None else np.minimum(radius, one)
    radius = radius * bent
    if canvas.lacks():
        where = where & False
    canvas.paint(where & (radius < 1), role)
    if shell:
        canvas.paint(where & (radius < 1 - rim), inner)
    elif second and size > 0.15:
        canvas.paint(where & (radius < 1) & (canvas.noise.field(canvas.between(6, 14)) > 0.3), canvas.some_role())


def _small_things(canvas: _Canvas, depth: np.ndarray) -> None:
    """Vessels lengthwise and across, membranes, islands."""
    if canvas.chance(0.6):
        where = np.abs(canvas.noise.field(canvas.between(5, 14))) < canvas.between(0.02, 0.1)
        canvas.paint(where & (depth > (2 if canvas.lacks() else 0.08)), canvas.some_role())
    if canvas.chance(0.6):
        where = canvas.noise.field(canvas.between(16, 40)) > canvas.between(1.2, 1.8)
        canvas.paint(where & (depth > (2 if canvas.lacks() else 0.04)), canvas.some_role())
    for _ in range(canvas.rng.integers(0, 4)):
        _blob(canvas, depth > 0.03, canvas.some_role(), shell=canvas.chance(0.5), high=0.15)


# ---- contrasts ----------------------------------------------------------------------------------------------------------


def texture(rng: np.random.Generator, size: int, along_px: float, across_px: float) -> np.ndarray:
    """(size, size) float32 noise of deviation 1, its grains `along_px` x `across_px`, in a random direction."""
    plane = rng.standard_normal((128, 128)).astype(np.float32)
    angle = rng.uniform(0, np.pi)
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array(
        [[c / along_px, s / along_px, rng.uniform(0, 128)], [-s / across_px, c / across_px, rng.uniform(0, 128)]]
    )
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    plane = cv2.warpAffine(plane, matrix, (size, size), flags=flags, borderMode=cv2.BORDER_WRAP)
    return plane / (plane.std() + 1e-6)


def _curve(rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
    knots = int(rng.integers(3, 7))
    return np.interp(values, np.linspace(0, 1, knots), rng.random(knots)).astype(np.float32)


def _folded(rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
    """A curve that takes two tissues to one value."""
    amplitude, turns, phase = rng.uniform(0.15, 0.3), rng.uniform(0.8, 1.4), rng.choice([0.0, np.pi])
    if rng.random() < 0.5:
        return np.clip(values + amplitude * np.sin(2 * np.pi * turns * values + phase), 0, 1)
    return 0.5 - 0.5 * np.cos(np.pi * rng.uniform(1.3, 2.6) * values)


def _ct_values(rng: np.random.Generator, roles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Air black, soft tissues within a few per cent, fat below them, bone far above; then a window."""
    count = len(roles)
    fat, soft = rng.uniform(0.42, 0.47), rng.uniform(0.49, 0.52)
    values = soft + rng.normal(0, rng.uniform(0.004, 0.015), count)
    values = np.where(roles == FAT, fat + rng.normal(0, 0.004, count), values)
    values = np.where(roles == BONE, soft + rng.uniform(0.05, 0.45) * rng.uniform(0.3, 1, count), values)
    values = np.where(roles == LUNG, rng.uniform(0.05, 0.2), np.where(roles <= AIR, 0.0, values))
    kind = rng.random()
    if kind < 0.35:  # all of it
        low, high = rng.uniform(0.0, 0.2), rng.uniform(0.75, 1.0)
    else:  # soft tissue
        low, high = fat - rng.uniform(0.01, 0.2), soft + rng.uniform(0.02, 0.25)
    grain = np.where(
        roles == BONE, rng.uniform(0, 0.1), np.where(roles == LUNG, rng.uniform(0, 0.1), rng.uniform(0, 0.01))
    )
    return (values - low) / (high - low), grain / (high - low) * rng.choice([-1, 1], count)


def _photograph_values(rng: np.random.Generator, roles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fat and bone pale, soft tissues anything below, cavities dark or filled."""
    count = len(roles)
    values = rng.uniform(0.1, rng.uniform(0.4, 0.7), count)
    values = np.where(roles == FAT, rng.uniform(0.5, 0.9) + rng.normal(0, 0.03, count), values)
    values = np.where(roles == BONE, rng.uniform(0.4, 0.9, count), values)
    values = np.where(roles == LUNG, rng.uniform(0.05, 0.5), values)
    if rng.random() < 0.7:
        values = np.where(roles == AIR, rng.uniform(0, 0.15), values)
    return values, rng.uniform(0, 0.12, count) * rng.choice([-1, 1], count)


def _mr_values(rng: np.random.Generator, roles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every label its own value; cavities dark, compact bone mostly, fat often bright."""
    count = len(roles)
    values = rng.uniform(0.1, 1, count) * rng.uniform(0.4, 1)
    if rng.random() < 0.6:
        values = np.where(roles == FAT, rng.uniform(0.6, 1.2) + rng.normal(0, 0.03, count), values)
    if rng.random() < 0.7:
        values = np.where((roles == BONE) & (rng.random(count) < 0.7), rng.uniform(0, 0.12), values)
    values = np.where((roles == AIR) | (roles == LUNG), rng.uniform(0, 0.1), values)
    return values, rng.uniform(0, 0.12, count) * rng.choice([-1, 1], count)


def _any_values(rng: np.random.Generator, roles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return rng.random(len(roles)), rng.uniform(-0.12, 0.12, len(roles))


def view(rng: np.random.Generator, anatomy: Anatomy, kind: str, tissue: np.ndarray) -> np.ndarray:
    """One contrast of an anatomy, (n, n) float32 0..1.

    Args:
        kind: "ct", "mr", "photograph", "any" (every label its own value) or "curve" (a curve of the tissue value).
        tissue: (K,) values 0..1 that both views of a pair share.
    """
    labels = anatomy.labels
    if kind == "curve":
        picture = _curve(rng, np.clip(tissue[labels] + rng.uniform(0.01, 0.1) * anatomy.detail, 0, 1))
    else:
        make = {"ct": _ct_values, "mr": _mr_values, "photograph": _photograph_values, "any": _any_values}[kind]
        values, grain = make(rng, anatomy.roles)
        picture = values.astype(np.float32)[labels] + grain.astype(np.float32)[labels] * anatomy.detail
    if kind == "photograph" or rng.random() < 0.2:
        picture = _surface(rng, picture, labels, len(anatomy.roles))
    if kind != "ct" and rng.random() < 0.3:
        picture = _folded(rng, np.clip(picture, 0, 1))
    if kind != "ct" and rng.random() < 0.25:
        picture = 1 - np.clip(picture, 0, 1)
    if rng.random() < 0.4:
        picture = np.clip(picture, 0, None) ** np.exp(rng.uniform(-0.6, 0.6))
    return _acquired(rng, np.clip(picture, 0, 1.2), labels > 0, kind)


def _surface(rng: np.random.Generator, picture: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """What a cut surface shows and no scanner does: grain, fibres, gloss, uneven light."""
    size = len(picture)
    fine, fibre = texture(rng, size, 1.2, 1.2), texture(rng, size, rng.uniform(4, 16), rng.uniform(1.2, 2.5))
    strength = rng.uniform(0, 0.12)
    shares = rng.random((2, count)).astype(np.float32) * strength
    picture = picture + shares[0][labels] * fine + shares[1][labels] * fibre
    if rng.random() < 0.5:
        spots = texture(rng, size, 1.5, rng.uniform(1.2, 3))
        picture = picture + np.where(spots > rng.uniform(2.0, 2.8), rng.uniform(0.1, 0.5), 0).astype(np.float32)
    return picture


def _acquired(rng: np.random.Generator, picture: np.ndarray, body: np.ndarray, kind: str) -> np.ndarray:
    """Partial volume, coil shading or uneven light, noise, and black outside the body."""
    size = len(picture)
    picture = (picture * body).astype(np.float32)
    blur = rng.uniform(0, 1.4)
    if blur > 0.3:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    if kind != "ct":
        cells = rng.standard_normal((5, 5)).astype(np.float32)
        picture = picture * (1 + rng.uniform(0, 0.3) * cv2.resize(cells, (size, size), interpolation=cv2.INTER_CUBIC))
    sigma = rng.uniform(0, 0.04)
    grain = rng.uniform(1.0, 2.0)
    noise = sigma * texture(rng, size, grain, grain)
    if kind == "mr" and rng.random() < 0.5:
        picture = np.hypot(picture + noise, sigma * texture(rng, size, grain, grain))
    else:
        picture = picture + noise
    if rng.random() < 0.85:  # cut out, as MedColor does with a scan and with a photograph
        picture = picture * body
    return np.clip(picture, 0, 1).astype(np.float32)


# ---- pairs --------------------------------------------------------------------------------------------------------------

_KINDS = ("ct", "mr", "photograph", "any", "curve")


def make_pair(rng: np.random.Generator, levels: tuple[Anatomy, Anatomy], side: int) -> Pair:
    """Two views of an anatomy, `side` px wide, the second warped.

    Args:
        levels: the anatomy as the first and as the second view see it: the same, or a neighbouring section.
    """
    window = min(len(levels[0].labels), 16 * round(1.4 * side / 16))
    top, left = _corner(rng, levels[0].labels, window)
    own, other = (_cut_out(anatomy, top, left, window) for anatomy in levels)
    kinds = _two_kinds(rng)
    values = rng.random(len(own.roles)).astype(np.float32)
    first, second = (view(rng, anatomy, kind, values) for anatomy, kind in zip((own, other), kinds))
    start = (window - side) // 2
    x, y = (values + start for values in _warp(rng, side))
    outside = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 0}
    second = cv2.remap(second, x, y, cv2.INTER_LINEAR, **outside)
    here, there = (cv2.remap(a.labels, x, y, cv2.INTER_NEAREST, **outside) for a in (own, other))
    x, y = x - start, y - start
    inside = (x > 1) & (y > 1) & (x < side - 2) & (y < side - 2)
    cut = np.s_[start : start + side, start : start + side]
    valid = (here > 0) & (here == there) & inside
    tissue = _tissue_of(own.roles)
    return Pair(first[cut], second, x, y, valid, tissue[own.labels[cut]], tissue[there])


def _tissue_of(roles: np.ndarray) -> np.ndarray:
    """(K,) uint8, see `Pair`: the tissue that a label is of."""
    shared = (roles != OUTSIDE) & (roles != SOFT)
    return np.where(shared, MOST_LABELS + roles, np.arange(len(roles))).astype(np.uint8)


def _cut_out(anatomy: Anatomy, top: int, left: int, window: int) -> Anatomy:
    cut = np.s_[top : top + window, left : left + window]
    return Anatomy(anatomy.labels[cut], anatomy.roles, anatomy.detail[cut])


def _two_kinds(rng: np.random.Generator) -> tuple[str, str]:
    """Mostly a photograph and a scan; now and then one curve each of the same tissue values."""
    if rng.random() < 0.25:
        return "curve", "curve"
    first, second = rng.choice(_KINDS, p=[0.05, 0.1, 0.6, 0.15, 0.1]), rng.choice(_KINDS, p=[0.3, 0.3, 0.1, 0.2, 0.1])
    return (first, second) if rng.random() < 0.7 else (second, first)


def _corner(rng: np.random.Generator, labels: np.ndarray, side: int) -> tuple[int, int]:
    """Upper left corner of a cut that shows some body."""
    rest = len(labels) - side
    for _ in range(8):
        top, left = (int(v) for v in rng.integers(0, rest + 1, 2))
        if np.count_nonzero(labels[top : top + side : 4, left : left + side : 4]) > side * side / 16 * 0.3:
            return top, left
    return rest // 2, rest // 2


def _warp(rng: np.random.Generator, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows (side, side) to read from: a similarity, stretched, smoothly bent."""
    centre = (side - 1) / 2
    rows, cols = (v.astype(np.float32) - centre for v in np.mgrid[:side, :side])
    angle = rng.normal(0, 0.12)
    scale = np.exp(rng.uniform(-0.15, 0.15)) * np.exp(rng.uniform(-0.2, 0.2, 2))
    bend = rng.uniform(0, 0.035) * side
    dx, dy = (
        bend * cv2.resize(rng.standard_normal((5, 5)).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC)
        for _ in range(2)
    )
    x = (np.cos(angle) * cols - np.sin(angle) * rows) * scale[0] + centre + dx + rng.normal(0, 0.02) * side
    y = (np.sin(angle) * cols + np.cos(angle) * rows) * scale[1] + centre + dy + rng.normal(0, 0.02) * side
    return x.astype(np.float32), y.astype(np.float32)
