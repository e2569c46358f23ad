"""Stability of the whole pipeline: volumes with bad voxels, extreme values, sizes, spacings and directions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np

from ..parameters import Settings
from ..phantom import TISSUES, labels, section
from ..pipeline import colorize
from ..volume import ColorVolume, Volume
from .case import REFUSED, Case, holds, refuses

_SETTINGS = Settings(preset="draft", features="embedded", device="cpu")
_SHAPE = (3, 48, 40)
_GEOMETRY = np.diag([-4.0, -4.0, 8.0, 1.0])


def cases() -> Iterator[Case]:
    """Values, sizes, geometry, repeatability."""
    yield from _value_cases()
    yield from _refused_volumes()
    yield from _size_cases()
    yield from _geometry_cases()
    again = holds(lambda: np.array_equal(_colored(_hu()).rgb, _colored(_hu()).rgb), "the same bytes")
    yield Case("volume", "same seed", "run twice", "the same bytes", again)


@lru_cache(maxsize=1)
def _phantom() -> np.ndarray:
    table = np.array([values[0] for values in TISSUES.values()], np.float64)
    anatomy = labels((12, *_SHAPE[1:]))[2:5]
    return table[anatomy] + np.random.default_rng(0).normal(0, 12, _SHAPE)


def _hu(dtype=np.int16) -> np.ndarray:
    return np.rint(_phantom()).astype(dtype)


@lru_cache(maxsize=1)
def _reference() -> np.ndarray:
    return section()


def _colored(array: np.ndarray, ijk_to_ras: np.ndarray | None = None, settings: Settings = _SETTINGS) -> ColorVolume:
    geometry = _GEOMETRY if ijk_to_ras is None else ijk_to_ras
    return colorize(Volume(array, geometry, name="case"), [_reference()], settings)


def _sound(array: np.ndarray, ijk_to_ras: np.ndarray | None = None) -> Callable[[], tuple[bool, str]]:
    """Check that the result has the grid of its input, colour inside and black around."""

    def check() -> tuple[bool, str]:
        before = array.copy()
        result = _colored(array, ijk_to_ras)
        geometry = _GEOMETRY if ijk_to_ras is None else ijk_to_ras
        same_grid = result.rgb.shape == (*array.shape, 3) and np.array_equal(result.ijk_to_ras, geometry)
        untouched = np.array_equal(before, array, equal_nan=array.dtype.kind == "f")
        coloured = np.ptp(result.rgb.astype(np.int16), axis=-1).max() > 10
        share = float((result.rgb.max(axis=-1) > 0).mean())
        return same_grid and untouched and coloured, f"{100 * share:.0f} % of the voxels coloured"

    return check


def _case(name: str, condition: str, check, expected: str = "coloured, same grid, input untouched") -> Case:
    return Case("volume", name, condition, expected, check)


def _value_cases() -> Iterator[Case]:
    rng = np.random.default_rng(1)
    spots = rng.random(_SHAPE)
    floats = _phantom().astype(np.float32)
    yield _case("10 % NaN", "float32", _sound(np.where(spots < 0.1, np.nan, floats).astype(np.float32)))
    yield _case(
        "infinities",
        "1 % of either sign",
        _sound(np.where(spots < 0.01, np.inf, np.where(spots > 0.99, -np.inf, floats))),
    )
    yield _case("padding", "NaN outside a circle", _sound(np.where(_circle(), floats, np.nan)))
    yield _case("padding", "-32768 outside a circle", _sound(np.where(_circle(), _hu(), -32768).astype(np.int16)))
    yield _case("metal", "30000 HU in 1 % of the voxels", _sound(np.where(spots < 0.01, 30000, _hu()).astype(np.int16)))
    yield _case(
        "int16 limits",
        "-32768 and 32767 in 1 %",
        _sound(np.where(spots < 0.005, -32768, np.where(spots > 0.995, 32767, _hu())).astype(np.int16)),
    )
    for dtype, shift, factor in (
        (np.uint8, 1000, 0.12),
        (np.uint16, 1000, 30),
        (np.uint64, 1000, 1e15),
        (np.int8, 0, 0.1),
    ):
        values = np.clip((_phantom() + shift) * factor, np.iinfo(dtype).min, 0.99 * np.iinfo(dtype).max)
        yield _case("type", np.dtype(dtype).name, _sound(values.astype(dtype)))
    yield _case("type", "float16", _sound(floats.astype(np.float16)))
    yield _case("type", "big-endian int16", _sound(_hu(">i2")))
    for factor in (1e300, 1e-300, 1e-40):
        yield _case("scale", f"float64 times {factor:g}", _sound(_phantom() * factor))
    yield _case("offset", "float64 plus 1e9", _sound(_phantom() + 1e9))
    yield _case("two values", "0 and 1", _sound((_phantom() > -500).astype(np.uint8)))
    frozen = _hu()
    frozen.setflags(write=False)
    yield _case("read-only array", "int16", _sound(frozen))
    yield _case("strided array", "every other voxel of a larger one", _sound(np.repeat(_hu(), 2, axis=2)[:, :, ::2]))


def _circle() -> np.ndarray:
    y, x = np.linspace(-1, 1, _SHAPE[1])[:, None], np.linspace(-1, 1, _SHAPE[2])
    return np.broadcast_to(y**2 + x**2 < 1, _SHAPE)


def _refused_volumes() -> Iterator[Case]:
    for name, array in (
        ("all NaN", np.full(_SHAPE, np.nan)),
        ("constant", np.full(_SHAPE, 5.0)),
        ("one voxel", np.full((1, 1, 1), 5.0)),
        ("no voxels", np.empty((0, 4, 4))),
        ("RGB", np.zeros((*_SHAPE, 3), np.uint8)),
        ("two-dimensional", np.zeros((4, 4))),
        ("complex numbers", np.zeros(_SHAPE, np.complex64)),
    ):
        yield _case(name, "as the volume", refuses(lambda a=array: _colored(a)), REFUSED)
    for name, picture in (
        ("grey picture", np.repeat(np.arange(64, dtype=np.uint8)[None, :, None], 64, 0).repeat(3, 2)),
        ("black picture", np.zeros((64, 64, 3), np.uint8)),
        ("blue gelatin alone", np.full((64, 64, 3), (28, 74, 120), np.uint8)),
        ("floats", np.zeros((64, 64, 3))),
    ):
        volume = Volume(_hu(), _GEOMETRY)
        yield _case(name, "as the reference", refuses(lambda p=picture, v=volume: colorize(v, [p], _SETTINGS)), REFUSED)
    flat = np.eye(4)
    flat[:, 1] = flat[:, 0]
    for name, matrix in (
        ("two equal directions", flat),
        ("NaN in the geometry", np.full((4, 4), np.nan)),
        ("spacing 0", np.diag([0.0, 1, 1, 1])),
    ):
        yield _case(name, "directions", refuses(lambda m=matrix: _colored(_hu(), m)), REFUSED)


def _size_cases() -> Iterator[Case]:
    def resized(shape: tuple[int, int, int]) -> np.ndarray:
        index = [np.arange(n) * size // n for n, size in zip(shape, _SHAPE)]
        return _hu()[np.ix_(*index)]

    for shape in ((1, 48, 40), (3, 17, 19), (3, 7, 5), (2, 3, 3), (3, 300, 9), (3, 9, 300), (40, 6, 5), (1, 640, 611)):
        yield _case("size", f"{shape[0]} slices of {shape[1]} x {shape[2]}", _sound(resized(shape)))
    for shape in ((4, 1, 1), (1, 1, 8), (1, 2, 2)):
        array = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
        yield Case(
            "volume", "size", f"{shape[0]} slices of {shape[1]} x {shape[2]}", "coloured or refused, nothing else",
            lambda a=array: (_colored(a).rgb.shape == (*a.shape, 3), "coloured"), may_refuse=True,
        )  # fmt: skip
    lonely = np.full((9, 48, 40), -1000, np.int16)
    lonely[4] = _hu()[1]
    only = holds(lambda: [bool(p.any()) for p in _colored(lonely).rgb] == [k == 4 for k in range(9)], "only that slice")
    yield _case("one slice with body among empty ones", "9 slices", only, "only that slice is coloured")
    copies = np.repeat(_hu()[1:2], 3, axis=0)
    same = holds(
        lambda: all(np.array_equal(p, q) for p, q in zip(*[iter(_colored(copies).rgb[:2])] * 2)), "the same colours"
    )
    yield _case("identical slices", "3 slices", same, "the same colours")
    filled = _hu()[:, 16:32, 14:26]
    yield _case("body touching every border", "3 slices of 16 x 12", _sound(filled))


def _geometry_cases() -> Iterator[Case]:
    for spacing in ((0.01, 0.01, 0.01), (50.0, 50.0, 50.0), (0.01, 0.01, 50.0), (50.0, 0.01, 1.0)):
        matrix = np.diag([-spacing[0], -spacing[1], spacing[2], 1.0])
        yield _case("spacing", " x ".join(f"{s:g}" for s in spacing) + " mm", _sound(_hu(), matrix))
    turn = np.radians(30.0)
    oblique = _GEOMETRY.copy()
    oblique[:3, :3] = (
        np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]) @ oblique[:3, :3]
    )
    oblique[:3, 3] = (1e4, -1e4, 1e-3)
    yield _case("directions", "turned by 30 degrees, far origin", _sound(_hu(), oblique))
    sheared = _GEOMETRY.copy()
    sheared[0, 2] = 3.0
    yield _case("directions", "sheared (gantry tilt)", _sound(_hu(), sheared))
    for name, axis in (("slices run down", 0), ("rows run forwards", 1), ("left-handed", 2)):
        yield _case(
            "directions", name, holds(lambda a=axis: _flip_commutes(a), "the same colours"), "the same colours, flipped"
        )
    for name, order in (("sagittal", (2, 0, 1)), ("coronal", (1, 0, 2))):
        yield _case(
            "directions",
            name,
            holds(lambda o=order: _transpose_commutes(o), "the same colours"),
            "the same colours, transposed",
        )


def _flip_commutes(axis: int) -> bool:
    """Whether a volume stored the other way round along an array axis, and said to be, gets the same colours."""
    matrix = _GEOMETRY.copy()
    column = 2 - axis
    matrix[:, 3] += matrix[:, column] * (_SHAPE[axis] - 1)
    matrix[:, column] *= -1
    return np.array_equal(np.flip(_colored(np.flip(_hu(), axis), matrix).rgb, axis), _colored(_hu()).rgb)


def _transpose_commutes(order: tuple[int, int, int]) -> bool:
    """Whether a volume stored with other axes, and said to be, gets the same colours."""
    columns = [2 - order[2 - c] for c in range(3)]
    matrix = np.eye(4)
    matrix[:, :3] = _GEOMETRY[:, columns]
    matrix[:, 3] = _GEOMETRY[:, 3]
    back = np.argsort(order)
    return np.array_equal(_colored(_hu().transpose(order), matrix).rgb.transpose(*back, 3), _colored(_hu()).rgb)
