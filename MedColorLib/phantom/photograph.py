"""The head as a photograph of a frozen section shows it: in blue gelatin, on a tray, with a label."""

from __future__ import annotations

import numpy as np

from .head import anatomy, coordinates
from .noise import grain, lumps, sine
from .space import SIZE_MM
from .tissues import NUMBER, TISSUES

_ROWS, _COLS = 256, 224
_EDGE_ROWS, _EDGE_COLS = 4, 12  # gelatin and tray beyond the raster of the anatomy
_FINE = 3  # samples along each side of a pixel
_GELATIN = (26, 78, 132)
_DIGITS = (0o75557, 0o26227, 0o71747, 0o71717, 0o55711, 0o74717, 0o74757, 0o71244, 0o75757, 0o75717)  # 3 x 5 points


def section(level: float = -0.45, seed: int = 0, scale: int = 1) -> np.ndarray:
    """(264, 248, 3) uint8 RGB times `scale`: the section at height `level` (-1 feet .. 1 vertex)."""
    fine = _FINE * scale
    tissue = _cut(level, fine)
    lines = tuple(np.arange(n, dtype=np.float32) * np.float32(0.8 / fine) for n in tissue.shape)  # in mm
    picture = _textured(tissue, lines, seed)
    _embed(picture, tissue == 0, lines, seed)
    picture = _shrunk(picture, _FINE)
    _lay_out(picture, level, scale)
    picture *= 1 + np.float32(0.015) * grain(picture.shape[:2], seed + 5)[..., None]
    return np.rint(np.clip(picture, 0, 255)).astype(np.uint8)


def section_labels(level: float = -0.45) -> np.ndarray:
    """(264, 248) uint8 indices into TISSUES: the truth of `section`, at the middle of each pixel; 0 in gelatin."""
    return np.ascontiguousarray(_cut(level, _FINE)[_FINE // 2 :: _FINE, _FINE // 2 :: _FINE])


def _cut(level: float, fine: int) -> np.ndarray:
    _, back, left = coordinates((1, _ROWS * fine, _COLS * fine))
    tissue = _warped(anatomy(np.array([level * SIZE_MM[0]]), back, left)[0], fine)
    return np.pad(tissue, ((_EDGE_ROWS * fine,) * 2, (_EDGE_COLS * fine,) * 2))


def _warped(tissue: np.ndarray, fine: int) -> np.ndarray:
    """Stretched by a few per cent, as tissue is when it is cut."""
    rows, cols = np.arange(tissue.shape[0], dtype=np.float32), np.arange(tissue.shape[1], dtype=np.float32)
    from_row = rows[:, None] + 4 * fine * sine(cols / np.float32(251 * fine))[None]
    from_col = cols[None] + 4 * fine * sine(rows / np.float32(314 * fine))[:, None]
    row, col = np.rint(from_row).astype(np.int32), np.rint(from_col).astype(np.int32)
    inside = (row >= 0) & (row < len(rows)) & (col >= 0) & (col < len(cols))
    return np.where(inside, tissue[row.clip(0, len(rows) - 1), col.clip(0, len(cols) - 1)], 0)


def _textured(tissue: np.ndarray, lines: tuple, seed: int) -> np.ndarray:
    """(h, w, 3) float32 colours of the tissues, and what is seen in them: lobules, fibres, marrow."""
    table = np.array([color for _, _, color in TISSUES.values()], np.float32)
    picture = table[tissue]
    broad = lumps(lines, 9.0, seed + 41)
    small = lumps(lines, 1.3, seed + 42)
    tiny = lumps(lines, 0.8, seed + 43)
    shade = 1 + np.float32(0.035) * broad + np.float32(0.03) * small
    picture *= shade[..., None]

    def mix(name: str, share: np.ndarray, color: tuple) -> None:
        where = tissue == NUMBER[name]
        part = np.clip(share[where], 0, 1)[:, None]
        picture[where] += part * (np.array(color, np.float32) - picture[where])

    lobules = np.abs(lumps(lines, 3.6, seed + 44) + np.float32(0.3) * small)
    mix("fat", np.float32(0.55) * (1 - lobules * 9), (176, 112, 78))
    mix("fat", np.float32(0.3) * broad, (240, 222, 176))
    fibres = lumps(lines, (1.1, 3.4), seed + 45) + np.float32(0.5) * tiny
    mix("muscle", np.float32(0.5) * fibres, (158, 84, 66))
    mix("muscle", np.float32(-0.5) * fibres, (74, 24, 24))
    mix("marrow", np.float32(0.8) * tiny, (222, 190, 150))
    mix("marrow", np.float32(-0.7) * small, (140, 60, 48))
    mix("bone", np.float32(0.3) * small, (206, 180, 142))
    mix("grey matter", np.float32(0.25) * small + np.float32(0.2) * broad, (150, 92, 78))
    mix("white matter", np.float32(0.25) * small + np.float32(0.15) * broad, (206, 168, 134))
    mix("skin", np.float32(0.5) * small, (170, 118, 88))
    return picture


def _embed(picture: np.ndarray, outside: np.ndarray, lines: tuple, seed: int) -> None:
    """Blue gelatin around the head and in its cavities, streaked as it froze."""
    streaks = lumps(lines, (60.0, 5.0), seed + 51) + np.float32(0.7) * lumps(lines, 14.0, seed + 52)
    frost = np.maximum(lumps(lines, (7.0, 0.9), seed + 53) * lumps(lines, 23.0, seed + 54) - np.float32(0.1), 0)
    blue = np.array(_GELATIN, np.float32) * (1 + np.float32(0.16) * streaks)[..., None]
    blue += frost[..., None] * np.array((90, 120, 110), np.float32)
    picture[outside] = blue[outside]


def _shrunk(picture: np.ndarray, factor: int) -> np.ndarray:
    parts = [picture[row::factor, col::factor] for row in range(factor) for col in range(factor)]
    return sum(parts[1:], parts[0].copy()) / np.float32(factor * factor)


def _lay_out(picture: np.ndarray, level: float, scale: int) -> None:
    """The tray to the left and right, and a paper with the number of the section in a corner."""
    for edge in (picture, picture[:, ::-1]):
        edge[:, : 5 * scale] = (34, 34, 36)
        edge[:, 5 * scale : 6 * scale] = (120, 132, 140)
    rows, cols = 17 * scale, 36 * scale
    paper = picture[-rows - 5 * scale : -5 * scale, -cols - 10 * scale : -10 * scale]
    paper[:] = (226, 222, 128)
    number = f"{round((1 - level) * 1000):04d}"
    for place, digit in enumerate(number):
        bits = _DIGITS[int(digit)]
        for point in range(15):
            if bits >> (14 - point) & 1:
                row, col = (3 + 2 * (point // 3)) * scale, (3 + 8 * place + 2 * (point % 3)) * scale
                paper[row : row + 2 * scale, col : col + 2 * scale] = (40, 40, 60)
