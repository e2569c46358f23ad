"""Suite *smoothing*: the fast global smoother by iterations, precision and implementation, against exact solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..filters import FILTERS, fast_global_smoother, regression
from ..progress import Progress
from .exact_smoothing import exact_fgs, exact_plane
from .pairs import Section, make_pair
from .tables import TIME_COLUMNS, Suite, Table, timed

SCENES = {"paper": (32.0, 200.0), "strong": (900.0, 8.0)}  # lambda, sigma in 8-bit units
COLUMNS = ("scene", "method", "iterations", "rms_to_wls", "max_to_wls", "max_to_separable", *TIME_COLUMNS)
STIFF_COLUMNS = ("lambda", "method", "max_to_separable")
IMPLEMENTATIONS = ("float32", "float64", "opencv")
_OTHERS = ("guided", "domain-transform", "wls", "regression")

NOTES = [
    "Source: a* and b* of the section as they lie; guide: the luminance of its mirrored and warped copy, rounded to 8 bits "
    "because OpenCV's filter takes no other; 256 x 256 pixels, two channels.",
    "rms_to_wls and max_to_wls: distance to the exact solution of the two-dimensional weighted least squares problem with the "
    "same links (sparse direct), as a share of the source's standard deviation; guided filter, domain transform, log-"
    "luminance WLS and regression solve other problems and stand beside it with the paper's parameters.",
    "max_to_separable: largest error against the separable filter's own answer in extended precision, as a share of the "
    "source's largest magnitude: what rounding does. OpenCV is held against its own lambda schedule.",
    "A time counts only where the result is finite and within the range of its source.",
]


@dataclass(frozen=True)
class _Scene:
    source: np.ndarray
    guide: np.ndarray
    lam: float
    sigma: float


def run(section: Section, quick: bool, seed: int, progress: Progress) -> Suite:
    """Measure all implementations on both scenes, then rounding over lambda."""
    table, stiff = Table(COLUMNS), Table(STIFF_COLUMNS)
    suite = Suite({"fgs": table, "stiff": stiff}, notes=list(NOTES))
    for number, (name, (lam, sigma)) in enumerate(SCENES.items()):
        scene = _scene(section, seed, lam, sigma)
        progress(0.4 * number, f"smoothing, scene {name}")
        _measure_scene(suite, name, scene, quick)
    progress(0.8, "smoothing, rounding over lambda")
    _measure_stiffness(suite, _scene(section, seed, *SCENES["paper"]), quick)
    return suite


def _scene(section: Section, seed: int, lam: float, sigma: float) -> _Scene:
    pair = make_pair(section, "as it is", seed)
    guide = np.rint(255 * pair.grey)
    return _Scene(np.ascontiguousarray(section.lab[..., 1:]), guide, lam, sigma)


def fgs_implementation(name: str) -> tuple[Callable, str]:
    """`f(source, guide, lam, sigma, iterations) -> result` and the lambda schedule it follows.

    Raises:
        ImportError: OpenCV without its contributed modules.
    """
    if name == "opencv":
        from cv2 import ximgproc

        def with_opencv(source, guide, lam, sigma, iterations):
            return ximgproc.fastGlobalSmootherFilter(
                guide.astype(np.uint8), source.astype(np.float32), lam, sigma, num_iter=iterations
            )

        return with_opencv, "opencv"
    dtype = np.dtype(name)
    return lambda source, guide, *options: fast_global_smoother(source.astype(dtype), guide, *options), "min2014"


def _measure_scene(suite: Suite, name: str, scene: _Scene, quick: bool) -> None:
    problem = scene.source, scene.guide, scene.lam, scene.sigma
    (exact, residual), seconds = timed(lambda: exact_plane(*problem), 1 if quick else 3)
    suite.notes.append(
        f"Scene {name}: lambda {scene.lam:g}, sigma {scene.sigma:g}; residual of the direct solution {residual:.1e}."
    )
    table = suite.tables["fgs"]
    table.add(scene=name, method="exact WLS", rms_to_wls=0, max_to_wls=0, **seconds.columns())
    counts = (1, 3, 5) if quick else (1, 2, 3, 4, 5, 8, 12)
    own = {(s, n): exact_fgs(*problem, n, s) for s in ("min2014", "opencv") for n in counts}
    for method in IMPLEMENTATIONS:
        try:
            filter_, schedule = fgs_implementation(method)
        except ImportError as error:
            suite.failures.append((f"smoothing by {method}", f"not installed ({error})"))
            continue
        for n in counts:
            _add(suite, name, method, scene, exact, lambda f=filter_, n=n: f(*problem, n), own[schedule, n], n)
    for method in _OTHERS:
        smooth = regression.smooth if method == "regression" else FILTERS[method]
        call = lambda s=smooth: s(scene.source.astype(np.float32), scene.guide)  # noqa: E731 - bound to this method
        _add(suite, name, method, scene, exact, call, None, None)


def _add(suite: Suite, name: str, method: str, scene: _Scene, exact, call, own, iterations) -> None:
    result, seconds = timed(call, 5, least_s=0.2)
    low, high = scene.source.min((0, 1)), scene.source.max((0, 1))
    slack = 1e-3 * (high - low)
    counts = bool(np.isfinite(result).all() and (result >= low - slack).all() and (result <= high + slack).all())
    label = f"{method}, {iterations} iterations" if iterations else method
    if not counts:
        suite.failures.append(
            (f"time of {label}, scene {name}", "the result is not finite or leaves the source's range")
        )
    distance = np.abs(np.asarray(result, np.float64) - exact) / scene.source.std()
    columns = {"rms_to_wls": np.sqrt((distance**2).mean()), "max_to_wls": distance.max()}
    if own is not None:
        columns["max_to_separable"] = relative_error(result, own, scene.source)
    columns.update(seconds.columns() if counts else {})
    suite.tables["fgs"].add(scene=name, method=method, iterations=iterations, **columns)


def relative_error(result: np.ndarray, exact: np.ndarray, source: np.ndarray) -> float:
    """Largest error as a share of the source's largest magnitude; NaN where the result is not finite."""
    return float(np.abs(result.astype(np.longdouble) - exact).max() / np.abs(source).max())


def _measure_stiffness(suite: Suite, scene: _Scene, quick: bool) -> None:
    cut = np.s_[64:192, 64:192]
    source, guide = scene.source[cut], scene.guide[cut]
    for exponent in range(0, 13, 3 if quick else 1):
        for method in IMPLEMENTATIONS:
            try:
                filter_, schedule = fgs_implementation(method)
            except ImportError:
                continue
            lam = 10.0**exponent
            result = filter_(source, guide, lam, scene.sigma, 3)
            error = relative_error(result, exact_fgs(source, guide, lam, scene.sigma, 3, schedule), source)
            suite.tables["stiff"].add(**{"lambda": lam}, method=method, max_to_separable=error)
