"""A head made by formula: a grey volume and a colour section of the same anatomy. For the demo, a first run and tests.

Not a patient and not a photograph: ellipsoids of skin, fat, skull, brain, ventricles, eyes and sinuses with seeded texture.
Made with NumPy alone: it is the first thing that a fresh Slicer shows, before any package is installed.
"""

from __future__ import annotations

import numpy as np

from .volume import Volume

# tissue: (CT in HU, T1 MR signal, sRGB colour)
TISSUES = {
    "air": (-1000, 4, (0, 0, 0)),
    "skin": (40, 420, (205, 160, 128)),
    "fat": (-95, 900, (226, 196, 124)),
    "muscle": (55, 380, (122, 52, 44)),
    "bone": (900, 60, (232, 218, 184)),
    "grey matter": (38, 430, (176, 124, 104)),
    "white matter": (30, 600, (214, 184, 152)),
    "fluid": (8, 120, (120, 84, 70)),
    "eye": (12, 160, (52, 50, 48)),
}
_NAMES = tuple(TISSUES)
_GELATIN = (28, 74, 120)


def labels(shape: tuple[int, int, int] = (48, 128, 112)) -> np.ndarray:
    """(k, j, i) uint8 indices into TISSUES; k from the feet up, j from front to back, i from right to left."""
    z, y, x = (np.linspace(-1, 1, n) for n in shape)
    z, y, x = z[:, None, None], y[None, :, None], x[None, None, :]
    fold = 0.03 * np.sin(9 * x + 2 * z) * np.sin(8 * y - z)
    out = np.zeros(shape, np.uint8)

    def paint(name: str, centre, radii, wobble=0.0) -> None:
        cz, cy, cx = centre
        rz, ry, rx = radii
        distance = np.sqrt(((z - cz) / rz) ** 2 + ((y - cy) / ry) ** 2 + ((x - cx) / rx) ** 2) + wobble
        out[distance < 1] = _NAMES.index(name)

    paint("skin", (-0.2, 0, 0), (1.1, 0.92, 0.84))
    paint("fat", (-0.2, 0, 0), (1.07, 0.89, 0.81))
    paint("muscle", (-0.35, 0.05, 0), (1.0, 0.82, 0.76))
    paint("bone", (-0.1, 0.05, 0), (0.95, 0.77, 0.69))
    paint("grey matter", (-0.1, 0.07, 0), (0.88, 0.69, 0.61))
    paint("white matter", (-0.1, 0.07, 0), (0.76, 0.56, 0.48), 3 * fold)
    for side in (-1, 1):
        paint("fluid", (0.05, 0.05, 0.11 * side), (0.3, 0.26, 0.06))
        paint("bone", (-0.45, -0.5, 0.36 * side), (0.3, 0.22, 0.22))
        paint("fat", (-0.45, -0.53, 0.36 * side), (0.26, 0.19, 0.18))
        paint("eye", (-0.45, -0.57, 0.36 * side), (0.19, 0.13, 0.13))
    paint("bone", (-0.5, -0.52, 0), (0.36, 0.24, 0.14))
    paint("air", (-0.5, -0.52, 0), (0.3, 0.18, 0.09), 4 * fold)
    return out


def sample(modality: str = "ct", seed: int = 0) -> tuple[Volume, np.ndarray]:
    """A grey volume and a colour section of it.

    Args:
        modality: "ct" (HU, int16) or "mr" (T1-like, uint16).

    Returns:
        Volume (48, 128, 112) of 4 x 1.6 x 1.6 mm; (h, w, 3) uint8 RGB section at eye level on blue gelatin, whose
        anatomy is stretched by a few per cent against the volume's, as a photograph's is.
    """
    rng = np.random.default_rng(seed)
    anatomy = labels()
    column = {"ct": 0, "mr": 1}[modality]
    table = np.array([TISSUES[name][column] for name in _NAMES], np.float64)
    values = _blurred(table[anatomy], (0.3, 0.5, 0.5))
    values += rng.normal(0, 12 if modality == "ct" else 14, anatomy.shape)
    array = np.rint(values).astype(np.int16) if modality == "ct" else np.rint(np.maximum(values, 0)).astype(np.uint16)
    ijk_to_ras = np.diag([-1.6, -1.6, 4.0, 1.0])
    ijk_to_ras[:3, 3] = (88.8, 101.6, -94.0)
    return Volume(array, ijk_to_ras, name=f"phantom {modality.upper()}"), section(rng=rng)


def section(level: float = -0.45, rng: np.random.Generator | None = None) -> np.ndarray:
    """(264, 248, 3) uint8 RGB: the colour section at height `level` (-1 feet .. 1 vertex) with texture, in gelatin."""
    rng = rng or np.random.default_rng(0)
    fine = labels((41, 256, 224))[round((level + 1) * 20)]
    rows, cols = np.mgrid[:256, :224].astype(np.float32)
    rows, cols = rows + 4 * np.sin(cols / 40), cols + 4 * np.sin(rows / 50)
    fine = _nearest(fine, rows, cols)
    fine = np.pad(fine, ((4, 4), (12, 12)))
    colors = np.array([TISSUES[name][2] for name in _NAMES], np.float64)
    picture = _blurred(colors[fine], (0.8, 0.8))
    grain = _blurred(rng.normal(0, 1, fine.shape), (1.2, 1.2))
    picture *= 1 + 0.04 * (grain / grain.std())[..., None]
    gelatin = np.array(_GELATIN) * (1 + 0.08 * _blurred(rng.normal(0, 1, fine.shape), (3, 3))[..., None] * 8)
    outside = _blurred((fine == 0).astype(float), (0.8, 0.8))[..., None]
    picture = picture * (1 - outside) + gelatin * outside
    return np.rint(np.clip(picture, 0, 255)).astype(np.uint8)


def _blurred(values: np.ndarray, sigmas: tuple[float, ...]) -> np.ndarray:
    """Gaussian of standard deviations in voxels along the first axes, cut at 4 of them, mirrored at the borders."""
    for axis, sigma in enumerate(sigmas):
        reach = int(4 * sigma + 0.5)
        weights = np.exp(-0.5 / sigma**2 * np.arange(-reach, reach + 1) ** 2)
        weights /= weights.sum()
        lines = np.moveaxis(values, axis, 0)
        count = len(lines)
        padded = np.pad(lines, [(reach, reach)] + [(0, 0)] * (lines.ndim - 1), mode="symmetric")
        total = padded[reach : reach + count] * weights[reach]
        for step in range(reach, 0, -1):
            total += (padded[reach - step : reach - step + count] + padded[reach + step :][:count]) * weights[
                reach - step
            ]
        values = np.moveaxis(total, 0, axis)
    return values


def _nearest(picture: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    """The pixels nearest to positions (row, column); 0 outside the picture."""
    row, col = np.rint(rows).astype(np.int64), np.rint(cols).astype(np.int64)
    inside = (row >= 0) & (row < picture.shape[0]) & (col >= 0) & (col < picture.shape[1])
    return np.where(inside, picture[row.clip(0, picture.shape[0] - 1), col.clip(0, picture.shape[1] - 1)], 0)
