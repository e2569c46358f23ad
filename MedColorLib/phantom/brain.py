"""The brain made by formula: folded cortex, white matter, nuclei, ventricles, cerebellum and stem."""

from __future__ import annotations

import numpy as np

from .noise import hashed, lumps, ripples
from .space import Space
from .tissues import NUMBER

_CORTEX_MM = 2.9
_FOLD_MM = 23.5  # from sulcus to sulcus and back
_FOLIA_MM = 3.0

# tissue, (side, back, up), (radii), lean, tilt, into
_NUCLEI = (
    ("grey matter", (25, -4, -1), (5.5, 18, 11), 0.12, 0, ("white matter",)),  # putamen
    ("white matter", (19.6, -3, -3), (0.7, 12, 8), 0.3, 0, ("grey matter",)),
    ("grey matter", (13, -24, 3), (6.5, 11, 13), -0.25, 0, ("white matter",)),  # head of the caudate
    ("grey matter", (10, 9, -1), (8.5, 14, 11), 0.3, 0, ("white matter", "grey matter", "fluid")),  # thalamus
    ("fluid", (0, 3, -6), (2.0, 12, 9), 0, -0.3, ()),  # third ventricle
    ("fluid", (7, -20, 6), (4.2, 12.5, 8), -0.4, 0, ()),  # frontal horn
    ("fluid", (10, 3, 16), (6.5, 30, 4.6), 0.15, 0, ()),  # body
    ("fluid", (23, 32, 5), (6.5, 14, 11), 0.45, 0, ()),  # trigone
    ("fluid", (27, 50, 2), (3.2, 16, 5), -0.15, 0, ()),  # occipital horn
    ("fluid", (33, 4, -27), (3, 18, 3.5), 0.05, 0, ("white matter", "grey matter")),  # temporal horn
    ("grey matter", (27, 5, -31), (4.5, 15, 3.4), 0.1, 0, ("white matter", "grey matter")),  # hippocampus
    ("blood", (22, 30, 6), (2.4, 6, 4), 0.4, 0, ("fluid",)),  # plexus
)
_STEM = (
    ("fluid", (0, 0, -42), (19, 14, 24), 0, 0.1, ()),  # cisterns
    ("white matter", (13, 5, -28), (9, 7, 13), -0.5, 0.2, ("fluid",)),  # peduncles of the cerebrum
    ("white matter", (0, 11, -28), (13, 8, 13), 0, 0.1, ()),  # midbrain
    ("white matter", (0, 5, -48), (16, 11, 13), 0, 0, ()),  # pons
    ("grey matter", (0, 3, -48), (11, 3.5, 9), 0, 0, ()),
    ("white matter", (22, 16, -49), (12, 7, 7), 0.5, 0, ("grey matter", "fluid")),  # peduncles of the cerebellum
    ("grey matter", (0, 10, -29), (5, 4, 10), 0, 0, ()),
    ("fluid", (0, 16, -29), (1.2, 1.2, 14), 0, 0, ()),  # aqueduct
    ("fluid", (0, 19, -49), (7, 3.4, 9), 0, 0, ()),  # fourth ventricle
    ("grey matter", (14, 32, -50), (5, 7, 5), -0.2, 0, ("white matter",)),  # dentate nuclei
    ("blood", (0, -8, -46), (1.8, 1.8, 14), 0, 0, ()),  # basilar artery
)


def paint_brain(space: Space, cavity_mm: np.ndarray) -> None:
    """Fill what lies deeper than 0 mm in the cavity of the skull."""
    inside = cavity_mm > 0
    at = np.nonzero(inside)
    if not len(at[0]):
        return
    up, back, left = (line[index] for line, index in zip(space.lines, at))
    sway = lumps(space.lines, 34.0, 11)[inside]
    twist = lumps(space.lines, 27.0, 12)[inside]
    depth = cavity_mm[inside] - np.float32(1.2)
    tent = _above_tent(up, back, left)
    labels = np.where(
        tent > 0,
        _cerebrum(up, back, left, np.minimum(depth, tent), sway, twist),
        _cerebellum(up, back, left, np.minimum(depth, -tent - np.float32(1.5)), sway, twist),
    )
    falx = (np.abs(left + 2 * sway) < np.float32(0.4)) & (_outside_arch(up, back) > 4) & (tent > 0)
    labels = np.where(falx & (labels == NUMBER["fluid"]), NUMBER["fibrous tissue"], labels)
    reach = cavity_mm[inside]
    below_vault = (np.abs(left) < 5 - np.float32(0.8) * reach) & ((back > 20) | (up > 20))
    along_tent = (np.abs(tent) < 4 - np.float32(0.6) * reach) & (back > 25)
    labels = np.where((reach < 6) & (below_vault | along_tent), NUMBER["blood"], labels)  # sinuses of the dura
    space.labels[inside] = labels.astype(np.uint8)
    for tissue, centre, radii, lean, tilt, into in _NUCLEI + _STEM:
        space.paint(tissue, centre, radii, lean, tilt, into or ("grey matter", "white matter", "fluid", "blood"))


def _above_tent(up, back, left):
    """Height in mm above the sheet between cerebrum and cerebellum, which rises to the midline and to the front."""
    side = np.abs(left)
    wide = np.float32(9) + np.float32(0.42) * np.clip(back - 5, 0, 80)
    ridge = 1 / (1 + (side / wide) ** 2)
    height = np.float32(-35) + 27 * ridge - np.float32(0.3) * np.maximum(back - 34, 0)
    in_front = np.maximum(np.float32(12) + np.float32(0.16) * side - back, 0)  # where the temporal lobes reach down
    return up - height + 3 * in_front


def _cerebrum(up, back, left, depth, sway, twist):
    side = np.abs(left + 2 * sway)
    arch = _outside_arch(up, back)
    midline = side - np.float32(0.7) + 8 * np.maximum(-arch, 0)
    hull = np.minimum(depth, midline)
    lateral = _lateral_fissure(up, back, side, sway)
    centre_back = np.clip(back, -40, 42) * np.float32(0.75)
    ways = [up - 4 - sway * 3, back - centre_back, side - np.float32(20)]
    reach = np.sqrt(ways[0] ** 2 + ways[1] ** 2 + ways[2] ** 2) + np.float32(1e-3)
    spread = np.float32(40) / reach + np.float32(0.3)
    points = (
        ways[0] * spread + 9 * twist,
        ways[1] * spread + centre_back * np.float32(1.3) + 9 * sway,
        ways[2] * spread + 9 * twist - 9 * sway,
    )
    sheet = ripples(points, _FOLD_MM, 21)
    bottom = np.float32(17) + 8 * sway  # how deep the sulci go
    cut = np.sqrt(sheet * sheet + np.maximum(hull - bottom, 0) ** 2)
    cut = cut + np.maximum(-arch, 0) * np.maximum(22 - side, 0) / 5  # the callosum and what it covers have no sulci
    cut = np.minimum(cut, lateral)
    gap = np.float32(0.35) + np.float32(0.6) * np.maximum(1 - np.maximum(hull, 0) / 5, 0)
    surface = np.minimum(hull, cut - gap)
    out = np.where(surface < _CORTEX_MM + np.float32(0.5) * twist, NUMBER["grey matter"], NUMBER["white matter"])
    return np.where(surface < 0, NUMBER["fluid"], out)


def _outside_arch(up, back):
    """Distance in mm outside the corpus callosum's upper edge, seen from the side; below it there is no fissure."""
    a, b = (up - 2) / np.float32(25), (back - 2) / np.float32(38)
    k = np.sqrt(a * a + b * b) + np.float32(1e-3)
    return (k - 1) * np.float32(25)


def _lateral_fissure(up, back, side, sway):
    """Distance in mm from the fissure between temporal and frontal lobe and from the cleft over the insula."""
    slant = (up + 5 - np.float32(0.38) * back + 3 * sway) * np.float32(0.93)
    along = np.maximum(np.abs(back - 4) - 32, 0) + np.maximum(36 - side, 0)
    stem = np.sqrt(slant * slant + along * along)
    bow = np.abs(side - 37 + ((back + 2) / 11) ** 2 * np.float32(0.9) + ((up - 1) / 9) ** 2)
    edge = np.maximum(np.sqrt(((back + 2) / 22) ** 2 + ((up - 1) / 15) ** 2) - 1, 0) * 18
    return np.sqrt(np.minimum(stem * stem, bow * bow + edge * edge))


def _cerebellum(up, back, left, depth, sway, twist):
    """Folia: sheets that fan out from the fourth ventricle and bend forwards at the sides."""
    bent = np.sqrt((back - 6) ** 2 + (np.float32(0.8) * left) ** 2)
    high = up + 68
    turn = 50 * high / (np.sqrt(high * high + bent * bent) + np.float32(1e-3)) - np.float32(0.45) * bent
    turn = turn + 3 * sway + 2 * twist
    sheet = np.floor(turn / np.float32(_FOLIA_MM))
    away = np.abs(turn - (sheet + np.float32(0.5)) * np.float32(_FOLIA_MM))
    bottom = 5 + (hashed(sheet.astype(np.int64), seed=33) >> np.uint32(28)).astype(np.float32)
    cut = np.sqrt(away * away + np.maximum(depth - bottom - 3 * twist, 0) ** 2)
    surface = np.minimum(depth, cut)
    out = np.where(surface < np.float32(0.95), NUMBER["grey matter"], NUMBER["white matter"])
    return np.where((surface < np.float32(0.2)) | (depth < 0), NUMBER["fluid"], out)
