"""Stability of colour science and grey values: near zero, out of gamut, windows without width, one grey level."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..color import (
    ciede2000,
    gamma_decode,
    gamma_encode,
    gray_to_lightness,
    lab_to_srgb,
    lab_to_srgb_in_gamut,
    lightness_to_gray,
    srgb_to_lab,
)
from ..scan.intensity import (
    Window,
    apply_curve,
    apply_window,
    check_values,
    choose_window,
    histogram_match_curve,
    spreading_curve,
)
from .case import REFUSED, Case, at_most, holds, refuses


def cases() -> Iterator[Case]:
    """Lab, gamma, gamut, windows, histogram match."""
    yield from _lab_cases()
    yield from _gamut_cases()
    yield from _window_cases()
    yield from _curve_cases()


def _lab_cases() -> Iterator[Case]:
    greys = np.linspace(0, 1, 4097)[:, None] * np.ones(3)
    axis = np.linspace(0, 1, 33)
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    tiny = np.concatenate([[0.0], np.geomspace(1e-300, 1e-2, 2000)])

    def round_trip(dtype) -> float:
        colors = cube.astype(dtype)
        return float(np.abs(lab_to_srgb(srgb_to_lab(colors)) - colors).max())

    def all_bytes() -> bool:
        side = np.arange(0, 256, 5, dtype=np.uint8)
        colors = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1)
        back, changed = lab_to_srgb_in_gamut(srgb_to_lab(colors))
        return changed == 0 and np.array_equal(back, colors)

    def symmetric() -> float:
        rng = np.random.default_rng(0)
        one, other = (np.concatenate([rng.uniform(-120, 120, (4000, 3)), np.zeros((10, 3))]) for _ in range(2))
        return float(np.abs(ciede2000(one, other) - ciede2000(other, one)).max())

    yield Case(
        "Lab",
        "grey stays grey",
        "4097 greys",
        "a*, b* at most 1e-12",
        at_most(lambda: np.abs(srgb_to_lab(greys)[:, 1:]).max(), 1e-12),
    )
    yield Case(
        "Lab", "round trip", "33^3 colours, float64", "at most 1e-12", at_most(lambda: round_trip(np.float64), 1e-12)
    )
    yield Case(
        "Lab", "round trip", "33^3 colours, float32", "at most 3e-5", at_most(lambda: round_trip(np.float32), 3e-5)
    )
    yield Case("Lab", "round trip", "52^3 colours of whole bytes", "the same bytes", holds(all_bytes, "the same bytes"))
    rising = holds(
        lambda: (np.diff(gray_to_lightness(tiny)) >= 0).all() and gray_to_lightness(tiny)[0] == 0, "rising from 0"
    )
    yield Case("Lab", "near black", "0 and 1e-300 to 0.01", "L* rises from 0", rising)
    back = at_most(lambda: np.abs(lightness_to_gray(gray_to_lightness(tiny)) - tiny).max(), 1e-15)
    yield Case("Lab", "near black", "to L* and back", "at most 1e-15", back)
    negative = holds(lambda: np.isfinite(srgb_to_lab(-cube)).all(), "finite")
    yield Case("Lab", "negative components", "-1 to 0", "finite", negative)
    same = at_most(lambda: np.abs(ciede2000(srgb_to_lab(cube), srgb_to_lab(cube))).max(), 0.0)
    yield Case("CIEDE2000", "no difference", "33^3 colours", "0", same)
    yield Case("CIEDE2000", "order", "random colours and greys", "the same both ways, 1e-12", at_most(symmetric, 1e-12))
    for gamma in (0.5, 2.0, 0.01):

        def there_and_back(gamma=gamma) -> float:
            return float(np.abs(gamma_decode(gamma_encode(axis, gamma), gamma) - axis).max())

        yield Case("gamma", "round trip", f"{gamma:g}, 0 to 1", "at most 1e-12", at_most(there_and_back, 1e-12))
    yield Case(
        "gamma",
        "negative values",
        "-1",
        "0, no NaN",
        at_most(lambda: np.abs(gamma_encode(np.array([-1.0, -1e-300]))).max(), 0.0),
    )
    yield Case("gamma", "gamma 0", "0 to 1", REFUSED, refuses(lambda: gamma_encode(axis, 0.0)))


def _gamut_cases() -> Iterator[Case]:
    axis = np.linspace(-500, 500, 21)
    wild = np.stack(np.meshgrid(np.linspace(-20, 140, 17), axis, axis, indexing="ij"), -1)

    def lightness_error() -> float:
        inside = wild[(wild[..., 0] >= 1) & (wild[..., 0] <= 99)]
        kept = srgb_to_lab(lab_to_srgb_in_gamut(inside)[0])[..., 0]
        return float(np.abs(kept - inside[..., 0]).max())

    def hue_error() -> float:
        lab = np.stack([np.full(360, 60.0), *(80 * f(np.radians(np.arange(360.0))) for f in (np.cos, np.sin))], -1)
        got = srgb_to_lab(lab_to_srgb_in_gamut(lab)[0].astype(np.float64) / 255)
        turn = np.degrees(np.arctan2(got[:, 2], got[:, 1])) - np.arange(360.0)
        return float(np.abs((turn + 180) % 360 - 180).max())

    yield Case("gamut", "wild colours", "L* -20 to 140, a*, b* to 500", "L* kept to 0.5", at_most(lightness_error, 0.5))
    yield Case(
        "gamut", "hue", "chroma 80 at L* 60, all hues", "hue kept to 2 degrees", at_most(hue_error, 2.0, " degrees")
    )
    black = holds(lambda: not lab_to_srgb_in_gamut(np.array([[0.0, 300.0, -300.0]]))[0].any(), "black")
    yield Case("gamut", "coloured black", "L* 0, chroma 424", "black", black)
    for name, value in (("NaN", np.nan), ("infinity", np.inf), ("1e30", 1e30)):
        yield Case(
            "gamut",
            "bad colour",
            name,
            REFUSED,
            refuses(lambda v=value: lab_to_srgb_in_gamut(np.array([[50.0, v, 0.0]]))),
        )


def _window_cases() -> Iterator[Case]:
    def grey(values, low, high, dtype=np.float64) -> np.ndarray:
        return apply_window(np.array(values, dtype), Window(low, high, "given"))

    def ends(values, low, high, dtype, wanted) -> bool:
        return np.allclose(grey(values, low, high, dtype), wanted, atol=1e-4)

    values = np.linspace(0, 100, 1000).reshape(10, 10, 10)
    for name, window in (
        ("zero width", (5.0, 5.0)),
        ("reversed", (9.0, 1.0)),
        ("NaN", (np.nan, 1.0)),
        ("infinite", (0.0, np.inf)),
    ):
        yield Case(
            "window",
            name,
            f"{window[0]:g} to {window[1]:g}",
            REFUSED,
            refuses(lambda w=window: choose_window(values, given=w)),
        )
    limits = (-32768, 0, 32767)
    takes = (
        ("int16 limits", limits, -32768, 32767, np.int16, (0, 0.5, 1)),
        ("metal at 30000 HU", (-1000, 40, 30000), -200, 300, np.int16, (0, 0.48, 1)),
        ("uint64 limits", (0, 2**64 - 1), 0, 2.0**64, np.uint64, (0, 1)),
        ("float64 beyond float32", (-1e308, 0.0, 1e308), -1e308, 1e308, np.float64, (0, 0.5, 1)),
        ("subnormal width", (0.0, 5e-310, 1e-309), 0.0, 1e-309, np.float64, (0, 0.5, 1)),
        ("NaN and infinities", (np.nan, -np.inf, np.inf), 0, 1, np.float64, (0, 0, 1)),
    )
    for name, given, low, high, dtype, wanted in takes:
        check = holds(
            lambda a=(given, low, high, dtype, wanted): ends(*a),
            f"grey {', '.join(f'{w:g}' for w in wanted)}",
            "other greys",
        )
        yield Case(
            "window",
            name,
            f"{np.dtype(dtype)}, window {low:g} to {high:g}",
            f"grey {', '.join(f'{w:g}' for w in wanted)}",
            check,
        )
    mostly = np.zeros((4, 8, 8))
    mostly[2, 3, 3] = 7.0
    rare = holds(lambda: choose_window(mostly).low < choose_window(mostly).high, "a window")
    yield Case("window", "two values, one of them rare", "1 of 256 voxels", "a window with width", rare)
    yield Case(
        "window", "a single value", "constant body", REFUSED, refuses(lambda: choose_window(np.full((2, 3, 3), 4.0)))
    )
    yield Case(
        "values",
        "constant volume",
        "float64",
        REFUSED,
        refuses(lambda: check_values(np.full((2, 3, 3), 4.0), "volume")),
    )
    yield Case(
        "values",
        "all NaN",
        "float32",
        REFUSED,
        refuses(lambda: check_values(np.full((2, 3, 3), np.nan, np.float32), "volume")),
    )


def _curve_cases() -> Iterator[Case]:
    rng = np.random.default_rng(0)
    spread, one, none = rng.random(1000), np.full(1000, 0.3), np.empty(0)
    for name, source, target in (
        ("source of one level", one, spread),
        ("target of one level", spread, one),
        ("both of one level", one, one),
        ("no pixels in the source", none, spread),
        ("no pixels in the target", spread, none),
        ("greys outside 0..1", 10 * spread - 5, 10 * spread - 5),
    ):

        def usable(source=source, target=target) -> bool:
            curve = histogram_match_curve(source, target)
            rises = (np.diff(curve) >= 0).all() and curve.min() >= 0 and curve.max() <= 1
            return bool(rises and np.isfinite(apply_curve(spread, curve)).all())

        yield Case("histogram match", name, "256 bins", "a rising curve within 0..1", holds(usable, "a rising curve"))
    median = at_most(lambda: abs(apply_curve(one, histogram_match_curve(one, spread))[0] - np.median(spread)), 0.02)
    yield Case("histogram match", "source of one level", "against 1000 greys", "goes to the median, 0.02", median)
    for name, greys in (("one level", one), ("no pixels", none), ("1000 greys", spread)):
        strict = holds(lambda g=greys: (np.diff(spreading_curve(g)) > 0).all(), "strictly rising")
        yield Case("guide curve", name, "256 bins", "strictly rising", strict)
