"""The head around the brain made by formula: skin, fat, muscles, skull, face and neck."""

from __future__ import annotations

import numpy as np

from .brain import paint_brain
from .noise import hashed, lumps
from .space import SIZE_MM, Space, depth_of, hump, joined

SKIN_MM = 2.2
_SOFT = ("fat", "muscle")
_BONY = ("bone", "marrow")
# what the face has beyond an oval: (up, back, side), (radii), width of the crease, all in mm
_FEATURES = (
    ((-14, -50, 0), (32, 35, 54), 14),  # forehead and brow
    ((-43, -62, 31), (13, 15, 17), 5),  # lids
    ((-66, -46, 38), (24, 27, 20), 18),  # cheek
    ((-81, -83, 9), (7, 9, 7), 6),  # wings of the nose
    ((-97, -74, 0), (7, 11, 24), 7),  # lip
)
# tissue, (side, back, up), (radii), lean, tilt, into, power
_MUSCLES = (
    ("muscle", (62, -18, -34), (11, 34, 48), -0.1, -0.1, _SOFT, 2),  # temporalis
    ("muscle", (55, -20, -88), (8, 19, 26), 0.2, -0.15, _SOFT, 2),  # masseter
    ("muscle", (33, -18, -71), (13, 13, 12), 0.8, 0, _SOFT, 2),  # pterygoids
    ("muscle", (35, -14, -94), (7, 14, 18), 0.3, 0, _SOFT, 2),
    ("muscle", (44, -48, -88), (2.4, 20, 16), 0.5, 0, _SOFT, 2),  # buccinator
    ("muscle", (25, 6, -86), (6, 7, 18), 0, 0, _SOFT, 2),  # below the styloid
    ("mucosa", (0, -22, -82), (17, 14, 22), 0, 0, _SOFT, 2),  # around the pharynx
    ("mucosa", (56, 4, -90), (8, 11, 22), 0, 0, _SOFT, 2),  # parotid
    ("muscle", (9, 1, -88), (8, 5, 20), 0.2, 0, _SOFT, 2),  # longus
    ("muscle", (31, -73, -42), (18, 3, 14), 0, 0, _SOFT, 4),  # around the lids
    ("muscle", (22, -80, -92), (18, 3, 8), 0.6, 0, ("fat",), 2),  # lips and cheek
)
_BROW = (
    ("bone", (0, -56, -18), (46, 25, 20), 0.0, 0, _SOFT, 2),
    ("marrow", (0, -56, -14), (40, 22.5, 15), 0.0, 0, _BONY, 2),
)
_BASE = (
    ("bone", (0, -24, -47), (16, 16, 15), 0, 0, (), 4),  # sphenoid
    ("bone", (0, -3, -58), (14, 6, 24), 0, -0.5, (), 2),  # clivus
    ("marrow", (0, -3, -58), (10, 3, 20), 0, -0.5, _BONY, 2),
    ("bone", (37, 13, -54), (13, 17, 10), 1.7, 0, (), 2),  # petrous pyramids
    ("bone", (57, 24, -64), (12, 15, 19), 0, 0, (), 2),  # mastoids
    ("fluid", (22, 10, -51), (7, 1.6, 2), 0, 0, ("bone",), 2),  # inner ear
    ("fluid", (36, 10, -54), (4, 3, 2.6), 0, 0, ("bone",), 2),
    ("air", (66, 8, -60), (15, 2.8, 3), 0, 0, _BONY, 2),  # ear canal
    ("mucosa", (0, -18, -36), (6, 5, 4), 0, 0, (), 2),  # pituitary
    ("blood", (10, -15, -46), (2.6, 5, 5), 0, 0, (), 2),  # carotids
    ("mucosa", (7, -24, -48), (7, 9, 9), 0, 0, (), 4),  # sphenoid sinuses
    ("air", (7, -24, -48), (6, 8, 8), 0, 0, (), 4),
)
_FACE = (
    ("air", (9, -71, -22), (8, 3.2, 9), -0.3, -0.1, _BONY, 2),  # frontal sinuses
    ("bone", (29, -50, -43), (21, 21, 20), -0.4, 0, (), 2),  # orbits
    ("bone", (28, -55, -70), (17, 19, 20), 0.1, 0, (), 2),  # maxillae
    ("bone", (50, -50, -58), (7, 14, 9), 0.5, 0, (), 2),  # zygomata
    ("marrow", (50, -50, -58), (4, 10, 6), 0.5, 0, _BONY, 2),
    ("bone", (64, -20, -60), (2.4, 32, 4), 0.12, 0, _SOFT, 2),  # zygomatic arches
    ("bone", (0, -57, -45), (13, 24, 17), 0, 0, (), 4),  # ethmoid
    ("bone", (0, -56, -68), (16, 24, 19), 0, 0, (), 4),  # nose
    ("mucosa", (0, -56, -68), (14, 26, 17), 0, 0, (), 4),
    ("air", (5, -56, -68), (3.6, 24, 15), 0.03, 0, (), 4),
    ("air", (9, -50, -66), (3.6, 15, 15), 0, 0, (), 4),
    ("bone", (0, -46, -60), (1.1, 16, 14), 0, 0, (), 4),  # septum
    ("fibrous tissue", (0, -72, -70), (1.3, 13, 13), 0, 0.2, (), 2),
    ("mucosa", (8, -54, -75), (3.4, 17, 4), 0, 0, (), 2),  # conchae
    ("mucosa", (8, -52, -64), (3, 14, 3.4), 0, 0, (), 2),
    ("mucosa", (28, -53, -70), (13, 14.5, 15.5), 0.1, 0, (), 2),  # maxillary sinuses
    ("air", (28, -53, -70), (11.8, 13.2, 14.2), 0.1, 0, (), 2),
    ("fat", (31, -54, -43), (18, 25, 17), -0.4, 0, (), 2),  # orbits
    ("muscle", (31, -75.5, -43), (15, 2, 12), 0, 0, ("fat",), 2),  # lids
    ("muscle", (18, -46, -43), (2, 17, 4.5), -0.3, 0, (), 2),  # recti
    ("muscle", (35, -44, -43), (2, 17, 4.5), -0.7, 0, (), 2),
    ("muscle", (28, -48, -30.5), (5, 17, 1.8), -0.5, 0, (), 2),
    ("muscle", (28, -48, -55.5), (5, 17, 1.8), -0.5, 0, (), 2),
    ("fluid", (23, -39, -43), (3, 15, 3), -0.6, 0, (), 2),  # optic nerve in its sheath
    ("white matter", (23, -39, -43), (1.9, 17, 1.9), -0.6, 0, (), 2),
    ("fibrous tissue", (31, -61, -43), (13, 13, 13), 0, 0, (), 2),  # eyes
    ("eye", (31, -61, -43), (12, 12, 12), 0, 0, (), 2),
    ("lens", (31, -69.5, -43), (5, 2.6, 5), 0, 0, (), 2),
)
_JAW = (
    ("bone", (52, 0, -66), (8, 4.5, 6), 0.3, 0, (), 2),  # condyles
    ("bone", (46, -10, -86), (3.4, 13, 24), 0.25, -0.3, (), 2),  # rami
    ("marrow", (46, -10, -86), (1.6, 10, 21), 0.25, -0.3, _BONY, 2),
    ("air", (0, -22, -76), (11, 8, 12), 0, 0, (), 2),  # pharynx
    ("mucosa", (0, -20, -94), (13, 8, 9), 0, 0, (), 2),
    ("bone", (0, -53, -85), (21, 26, 2.5), 0, 0, (), 4),  # palate
    ("bone", (0, -56, -93), (28, 27, 9), 0, 0, (), 2),
    ("mucosa", (0, -52, -96), (20, 25, 9.5), 0, 0, (), 2),
    ("muscle", (0, -46, -99), (18, 24, 9), 0, 0, (), 2),  # tongue
)
_NECK = (
    ("bone", (16, 14, -79), (7, 10, 6), 0.2, 0, (), 2),  # condyles of the occiput
    ("fat", (0, 24, -88), (19, 15, 20), 0, 0, _SOFT, 2),
    ("fluid", (0, 23, -79), (13, 12, 9), 0, 0, (), 2),  # great foramen
    ("bone", (20, 15, -91), (12, 10, 7), 0, 0, (), 2),  # atlas
    ("marrow", (20, 15, -91), (9, 7, 4.5), 0, 0, _BONY, 2),
    ("bone", (14, 34, -93), (17, 3, 4), -1.2, 0, (), 2),
    ("bone", (0, -2, -90), (9, 3, 5), 0, 0, (), 2),
    ("bone", (0, 6, -89), (5.5, 5, 12), 0, 0, (), 2),  # dens
    ("marrow", (0, 6, -89), (3.2, 3, 10), 0, 0, _BONY, 2),
    ("fluid", (0, 22, -88), (11, 8.5, 22), 0, 0, (), 2),  # cord in its sheath
    ("white matter", (0, 21, -80), (7, 5.5, 34), 0, -0.1, ("fluid", "grey matter", "bone", "marrow", "blood"), 2),
    ("grey matter", (2.2, 21, -80), (1.2, 2.8, 30), 0.3, -0.1, ("white matter",), 2),
    ("blood", (27, 12, -93), (2, 2, 8), 0, 0, (), 2),  # vertebral arteries
    ("blood", (30, -2, -90), (4, 3.5, 20), 0, 0, _SOFT, 2),  # carotids and jugular veins
)


def coordinates(shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions in mm of a grid's voxels along k (up), j (back) and i (left)."""
    steps = [(2 * np.arange(n) - (n - 1)) / max(n - 1, 1) for n in shape]
    return tuple((step * size).astype(np.float32) for step, size in zip(steps, SIZE_MM))


def anatomy(up_mm: np.ndarray, back_mm: np.ndarray, left_mm: np.ndarray) -> np.ndarray:
    """(k, j, i) uint8 numbers of the tissues at these positions."""
    return anatomy_and_depth(up_mm, back_mm, left_mm)[0]


def anatomy_and_depth(up_mm: np.ndarray, back_mm: np.ndarray, left_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the tissues, and the depth in mm below the skin, negative outside (float32)."""
    space = Space(up_mm, back_mm, left_mm)
    sway = lumps(space.lines, 30.0, 1)
    cavity = _cavity(space)
    temple = hump(space.up, -25, 62) * hump(space.back, -16, 50) * np.minimum(space.side / np.float32(45), 1)
    skin = _outline(space, temple) + np.float32(0.5) * sway
    _paint_soft(space, skin, cavity, sway)
    for row in _BROW:
        space.paint(*row)
    _paint_skull(space, cavity, skin, temple, sway)
    paint_brain(space, cavity)
    for row in _BASE + _mastoid_cells() + _FACE + _ethmoid_cells() + _JAW + _teeth() + _NECK:
        space.paint(*row)
    space.fill("air", skin <= 0)
    space.fill("skin", (skin > 0) & (skin < SKIN_MM))
    return space.labels, skin


def _mastoid_cells() -> tuple:
    drawn = hashed(np.arange(22)[:, None], np.arange(4)[None], seed=7).astype(np.float64) / 2**31 - 1
    return tuple(
        ("air", (57 + 8 * a, 24 + 10 * b, -64 + 13 * c), (2.2 + d,) * 3, 0, 0, _BONY, 2) for a, b, c, d in drawn
    )


def _ethmoid_cells() -> tuple:
    rows = []
    for n in range(5):
        a, b = (hashed(np.arange(2), np.array([n]), seed=8).astype(np.float64) / 2**31 - 1).tolist()
        cell, size = (5.6 + a + 0.3 * n, -73 + 8.6 * n, -43 + 3 * b), (4.6 + 0.7 * b, 3.7 + 0.6 * a, 11 + 2 * a)
        rows.append(("mucosa", cell, tuple(side + 0.8 for side in size), 0.3 * b, 0.1 * a, (), 4))
        rows.append(("air", cell, size, 0.3 * b, 0.1 * a, (), 4))
    return tuple(rows)


def _teeth() -> tuple:
    """Along half an ellipse, front to back: t is the tangent of half the angle."""
    rows = []
    for t in (0.07, 0.21, 0.35, 0.5, 0.66, 0.84, 1.05):
        side, front = 2 * t / (1 + t * t), (1 - t * t) / (1 + t * t)
        size = 2.6 + 1.6 * t
        rows.append(("tooth", (24 * side, -56 - 22 * front, -96), (size, size, 8), 0, 0, (), 2))
    return tuple(rows)


def _cavity(space: Space) -> np.ndarray:
    """Depth in mm below the inner table of the skull."""
    dome, middle, rear = _fossae(space)
    floor = space.up + 29  # of the frontal lobes, over the orbits
    return joined(joined(np.minimum(dome, floor), rear, 26), middle, 8)


def _fossae(space: Space) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    axes = space.up, space.back, space.side
    egg = space.side * (1 - np.float32(0.0014) * space.back)  # broader behind the ears than at the brow
    return (
        depth_of((space.up, space.back, egg), (8, 3, 0), (64, 77, 62)),
        depth_of(axes, (-36, -7, 34), (19, 30, 23)),
        depth_of(axes, (-46, 40, 0), (30, 37, 54)),
    )


def _outline(space: Space, temple: np.ndarray) -> np.ndarray:
    """Depth in mm below the skin."""
    up, back, side = axes = space.up, space.back, space.side
    dome, middle, rear = _fossae(space)
    cranium = joined(joined(dome, rear, 26), middle, 20)
    cranium = joined(cranium, depth_of(axes, (-40, 10, 0), (30, 55, 58)), 16) + 12 + 5 * temple
    face = -joined(-depth_of((back, side), (-12, 0), (68, 58)), 26 + up, 24)
    neck = -joined(-depth_of((back, side), (14, 0), (54, 52)), 50 + up, 20)
    out = joined(joined(cranium, face, 22), neck, 20)
    for centre, radii, round_mm in _FEATURES:
        out = joined(out, depth_of(axes, centre, radii), round_mm)
    nose = depth_of((up, back - np.float32(0.36) * (up + 72), side), (-64, -82, 0), (27, 12, 10))
    pinna = up, back - np.float32(0.2) * (up + 50), side - np.float32(0.1) * (back - 12)
    ear = depth_of(pinna, (-50, 14, 73), (23, 14, 4.2))
    return joined(joined(out, nose, 10), ear, 8)


def _paint_soft(space: Space, skin: np.ndarray, cavity: np.ndarray, sway: np.ndarray) -> None:
    space.fill("skin", skin > 0)
    space.fill("fat", skin > SKIN_MM)
    _paint_nape(space, skin, cavity, sway)
    for row in _MUSCLES:
        space.paint(*row)
    space.fill("fat", (skin > SKIN_MM) & (skin < 3.6))


def _paint_nape(space: Space, skin: np.ndarray, cavity: np.ndarray, sway: np.ndarray) -> None:
    """The muscles of the neck, in layers with fat between, and the thin ones of the scalp."""
    tear = lumps(space.lines, 17.0, 2)
    between = _from_sheets(skin + 3 * sway + 4 * tear, 9.5)
    across = _from_sheets(space.side + 5 * sway + 5 * tear + np.float32(0.7) * skin, 31)
    low = (space.up < -30) & (skin > 5 + 2 * sway) & (cavity < -6) & (space.back > 10 + 5 * tear) & (space.side > 1)
    scalp = (np.abs(skin - np.float32(4.6)) < np.float32(0.7)) & (space.up < 30 + 20 * tear) & (np.abs(space.back) > 25)
    space.fill("muscle", scalp)
    space.fill("muscle", low & (between > 0.7) & (across > 0.6))


def _from_sheets(along_mm: np.ndarray, apart_mm: float) -> np.ndarray:
    """Distance in mm from sheets that lie that far apart."""
    turns = along_mm / np.float32(apart_mm)
    return np.abs(turns - np.floor(turns + np.float32(0.5))) * np.float32(apart_mm)


def _paint_skull(space: Space, cavity, skin, temple, sway) -> None:
    thick = np.float32(6.6) - np.float32(3.6) * temple + sway
    space.fill("bone", (cavity > -thick) & (skin > 2.5))
    middle = np.float32(0.5) * thick
    space.fill("marrow", (np.abs(cavity + middle) < middle - np.float32(1.9)) & (skin > 4))
