"""Stability of the smoothing filters: lambda 0 to 1e12, sigma 1e-6 to 1e6, lines of 1 to 4096, bad pixels, extremes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..filters import (
    DomainTransformParameters,
    GuidedParameters,
    WlsParameters,
    fast_global_smoother,
    regression,
    smooth,
)
from .case import REFUSED, Case, at_most, holds, refuses
from .exact_smoothing import exact_fgs, exact_lines

LAMBDAS = (0.0, 1e-3, 1.0, 32.0, 1e3, 1e5, 1e7, 1e9, 1e12)
SIGMAS = (1e-6, 1e-3, 1.0, 1e3, 1e6)  # relative to the guide's range
LENGTHS = (1, 2, 3, 17, 256, 4096)
_FLOOR = 1e-20  # of the source's magnitude: far from an impulse the exact values leave float32


def cases() -> Iterator[Case]:
    """FGS first: it is the paper's smoother, and the one whose systems are stiff."""
    for lam in LAMBDAS:
        yield Case(
            "FGS", f"lambda {lam:g}", "lines of 1 to 4096, sigma 1e-6 to 1e6 of the guide's range, constant, step, noise, ramp",
            "relative error of each pixel at most 1e-5", at_most(lambda v=lam: line_error(v), 1e-5), beside=_opencv_beside(lam),
        )  # fmt: skip
    yield from _fgs_properties()
    yield from _fgs_refusals()
    yield from _wls_cases()
    yield from _other_filters()


def line_error(lam: float) -> float:
    """Largest relative error of float32 lines against extended precision over lengths, sigmas, guides and sources."""
    worst = 0.0
    for length in LENGTHS:
        guides, sources = _lines(length)
        for sigma in SIGMAS:
            scale = sigma * max(float(np.ptp(guides)), 1.0)
            links = lam * np.exp(-np.abs(np.diff(guides.astype(np.longdouble), axis=1)) / scale)
            exact = exact_lines(sources, links)
            result = fast_global_smoother(sources[:, None, :, None], guides[:, None, :], lam, scale, 1, "opencv")
            least = _FLOOR * sources.max(axis=1, keepdims=True)
            error = np.abs(result[:, 0, :, 0] - exact) / np.maximum(exact, least)
            worst = max(worst, float(error.max()))
    return worst


def _lines(length: int) -> tuple[np.ndarray, np.ndarray]:
    """Guides and sources (8, length) float32: every guide with noise and with an impulse as the source."""
    rng = np.random.default_rng(length)
    ramp = np.arange(length, dtype=np.float32)
    guides = [np.full(length, 7.0), np.where(ramp < length // 2, 0.0, 255.0), rng.integers(0, 256, length), ramp]
    impulse = np.zeros(length)
    impulse[length // 3] = 100
    sources = [rng.random(length) * 100, impulse]
    pairs = [(g, s) for g in guides for s in sources]
    return np.stack([g for g, _ in pairs]).astype(np.float32), np.stack([s for _, s in pairs]).astype(np.float32)


def _opencv_beside(lam: float) -> str:
    """What OpenCV's filter does on noise at sigma 200, against its own schedule."""
    try:
        from cv2 import ximgproc
    except ImportError:
        return ""
    rng = np.random.default_rng(0)
    guide, source = rng.integers(0, 256, (32, 256)).astype(np.uint8), (rng.random((32, 256)) * 100).astype(np.float32)
    result = ximgproc.fastGlobalSmootherFilter(guide, source, lam, 200.0)
    error = np.abs(result - exact_fgs(source[..., None], guide, lam, 200.0, 3, "opencv")[..., 0]).max() / 100
    return f"OpenCV: {float(error):.1g}" if np.isfinite(error) else "OpenCV: NaN"


def _picture(seed: int = 0, shape: tuple[int, int] = (48, 40)) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return (rng.random((*shape, 2)) * 100 - 50).astype(np.float32), rng.integers(0, 256, shape).astype(np.float32)


def _fgs_properties() -> Iterator[Case]:
    source, guide = _picture()

    def case(name, condition, expected, check):
        return Case("FGS", name, condition, expected, check)

    def leaves_range(lam: float) -> float:
        result = fast_global_smoother(source, guide, lam, 20.0)
        low, high = source.min((0, 1)), source.max((0, 1))
        return float(np.maximum(low - result, result - high).max())

    def constant_error(lam: float) -> float:
        constant = np.full_like(source, 37.3)
        return float(np.abs(fast_global_smoother(constant, guide, lam, 20.0) - constant).max() / 37.3)

    def shifted(offset: float) -> float:
        moved = fast_global_smoother(source, guide.astype(np.float64) + offset, 1e3, 20.0)
        return float(np.abs(moved - fast_global_smoother(source, guide, 1e3, 20.0)).max())

    def scaled(factor: float) -> float:
        result = fast_global_smoother((source * factor).astype(np.float32), guide, 1e3, 20.0) / factor
        return float(np.abs(result - fast_global_smoother(source, guide, 1e3, 20.0)).max() / 50)

    for lam in (32.0, 1e12, 1e30):
        yield case("range", f"lambda {lam:g}", "stays within the source", at_most(lambda v=lam: leaves_range(v), 0.0))
        yield case(
            "constant",
            f"lambda {lam:g}",
            "kept to 2 units of rounding",
            at_most(lambda v=lam: constant_error(v), 2.4e-7),
        )
    yield case("guide of any offset", "guide + 1e6", "as without it, 1e-3 of 100", at_most(lambda: shifted(1e6), 0.1))
    yield case("tiny and huge sources", "times 1e-30", "as without it, 1e-5", at_most(lambda: scaled(1e-30), 1e-5))
    yield case("tiny and huge sources", "times 1e35", "as without it, 1e-5", at_most(lambda: scaled(1e35), 1e-5))
    wide = np.arange(48 * 40).reshape(48, 40).astype(np.uint16) * 30

    def sixteen_bit() -> float:
        exact = exact_fgs(source, wide, 1e5, 500.0, 3, "min2014")
        return float(np.abs(fast_global_smoother(source, wide, 1e5, 500.0) - exact).max() / 50)

    yield case("16-bit guide", "lambda 1e5, sigma 500", "error at most 1e-5", at_most(sixteen_bit, 1e-5))
    alone = np.full((1, 1, 2), 3.0, np.float32)
    kept = holds(lambda: np.array_equal(fast_global_smoother(alone, alone[..., 0], 1e12, 1.0), alone), "unchanged")
    yield case("one pixel", "1 x 1", "unchanged", kept)
    zero = np.zeros(guide.shape, np.float32)
    same = holds(lambda: np.array_equal(fast_global_smoother(source, guide, confidence=zero), source), "the source")
    yield case("confidence 0 everywhere", "lambda 32", "the source itself", same)


def _fgs_refusals() -> Iterator[Case]:
    source, guide = _picture()
    for name, value in (("NaN", np.nan), ("infinity", np.inf)):
        bad = source.copy()
        bad[3, 4, 0] = value
        call = refuses(lambda b=bad: fast_global_smoother(b, guide))
        yield Case("FGS", f"one {name} pixel", "source", REFUSED, call, beside=_opencv_bad_pixel(bad, guide))
        bad_guide = guide.copy()
        bad_guide[3, 4] = value
        yield Case(
            "FGS", f"one {name} pixel", "guide", REFUSED, refuses(lambda b=bad_guide: fast_global_smoother(source, b))
        )
    for name, options in (
        ("lambda -1", (-1.0,)),
        ("lambda NaN", (np.nan,)),
        ("sigma -1", (32.0, -1.0)),
        ("sigma NaN", (32.0, np.nan)),
    ):
        yield Case(
            "FGS",
            "impossible parameter",
            name,
            REFUSED,
            refuses(lambda o=options: fast_global_smoother(source, guide, *o)),
        )
    yield Case("FGS", "no pixels", "0 x 0", REFUSED, refuses(lambda: fast_global_smoother(source[:0], guide[:0])))

    def unlinked() -> float:  # sigma 0 links equal pixels only; in noise without equal neighbours nothing changes
        different = np.arange(guide.size, dtype=np.float32).reshape(guide.shape)
        return float(np.abs(fast_global_smoother(source, different, 1e12, 0.0) - source).max())

    yield Case(
        "FGS", "sigma 0", "no equal neighbours", "the source itself", at_most(unlinked, 0.0), beside="OpenCV: NaN"
    )


def _opencv_bad_pixel(source: np.ndarray, guide: np.ndarray) -> str:
    try:
        from cv2 import ximgproc
    except ImportError:
        return ""
    result = ximgproc.fastGlobalSmootherFilter(guide.astype(np.uint8), source, 32.0, 200.0)
    return f"OpenCV: {100 * np.mean(~np.isfinite(result[..., 0])):.0f} % of the image not finite"


def _wls_cases() -> Iterator[Case]:
    source, guide = _picture()
    black = np.where(np.arange(40) < 20, 0.0, 255.0) * np.ones((48, 1))
    for lam, eps in ((0.0, 1e-4), (0.2, 1e-4), (1e3, 1e-4), (1e6, 1e-4), (1e6, 1e-8)):

        def constant_error(lam=lam, eps=eps) -> float:
            constant = np.full((48, 40, 1), 37.3)
            return float(np.abs(smooth("wls", constant, black, WlsParameters(lam, 1.8, eps)) - 37.3).max() / 37.3)

        def mean_error(lam=lam, eps=eps) -> float:  # the system's rows and columns sum to one: the mean is kept
            result = smooth("wls", source.astype(np.float64), black, WlsParameters(lam, 1.8, eps))
            return float(np.abs(result.mean((0, 1)) - source.mean((0, 1), dtype=np.float64)).max() / 50)

        condition = f"lambda {lam:g}, eps {eps:g}, black beside white"
        yield Case("WLS", "constant", condition, "kept to 1e-12", at_most(constant_error, 1e-12))
        stiff = lam / eps > 1e12  # beyond what float64 can solve to the residual that is promised
        expected = "kept to 1e-6" + (", or refused with the residual" if stiff else "")
        yield Case("WLS", "mean", condition, expected, at_most(mean_error, 1e-6), may_refuse=stiff)
    bad = source.copy()
    bad[0, 0, 0] = np.nan
    yield Case("WLS", "one NaN pixel", "source", REFUSED, refuses(lambda: smooth("wls", bad, guide)))
    yield Case("WLS", "negative luminance", "guide", REFUSED, refuses(lambda: smooth("wls", source, guide - 300)))


def _other_filters() -> Iterator[Case]:
    source, guide = _picture()

    def guided_shift(offset: float) -> float:
        parameters = GuidedParameters(4, 2.0)
        wide = guide.astype(np.float64)
        results = [smooth("guided", source.astype(np.float64), g, parameters) for g in (wide, wide + offset)]
        return float(np.abs(results[0] - results[1]).max() / 50)

    for offset, bound in ((1e3, 1e-11), (1e6, 1e-7)):
        check = at_most(lambda o=offset: guided_shift(o), bound)
        yield Case("guided filter", "guide of any offset", f"guide + {offset:g}", f"as without it, {bound:g}", check)
    flat = np.full_like(guide, 9.0)
    for name, parameters in (
        ("radius 1000", GuidedParameters(1000, 2.0)),
        ("radius 0", GuidedParameters(0, 2.0)),
        ("eps 1e-100", GuidedParameters(4, 1e-100)),
    ):
        finite = holds(lambda p=parameters: np.isfinite(smooth("guided", source, flat, p)).all(), "finite")
        yield Case("guided filter", "constant guide", name, "finite", finite)
    extremes = ((1e-3, 1e-100), (1e9, 1e-100), (1e9, 1e100), (8.0, 200.0))
    for sigma_s, sigma_r in extremes:

        def out_of_range(s=sigma_s, r=sigma_r) -> float:
            result = smooth("domain-transform", source, guide, DomainTransformParameters(s, r))
            return float(np.maximum(source.min((0, 1)) - result, result - source.max((0, 1))).max())

        condition = f"sigma_s {sigma_s:g}, sigma_r {sigma_r:g}"
        yield Case("domain transform", "range", condition, "stays within the source", at_most(out_of_range, 0.0))
    for name, value, weight in (
        ("no weight anywhere", 9.0, 0.0),
        ("constant guide", 9.0, 1.0),
        ("guide beyond 0..255", 1e30, 1.0),
    ):

        def regressed(value=value, weight=weight) -> bool:
            there = np.full_like(guide, value)
            model = regression.fit(source, there, np.full_like(guide, weight), regression.RegressionParameters())
            return bool(np.isfinite(regression.predict(model, there)).all())

        yield Case("regression", name, "48 x 40", "finite", holds(regressed, "finite"))
