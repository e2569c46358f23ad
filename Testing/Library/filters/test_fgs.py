"""Fast global smoother against exact solutions: 60 digits along lines, dense matrices and extended precision in 2-D."""

from __future__ import annotations

import itertools

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from MedColorLib.filters.fgs import fast_global_smoother
from MedColorLib.filters.fgs_parameters import SCHEDULES, lambda_schedule

GUIDES = {
    "constant": lambda n, rng: np.full(n, 7.0),
    "step": lambda n, rng: np.where(np.arange(n) < n // 2, 0.0, 255.0),
    "noise": lambda n, rng: rng.integers(0, 256, n).astype(np.float64),
    "float noise": lambda n, rng: rng.standard_normal(n).astype(np.float32).astype(np.float64),
    "ramp of one unit": lambda n, rng: np.arange(n, dtype=np.float64),
}


SOURCES = {
    "noise": lambda n, rng: rng.random(n) * 100,
    "impulse": lambda n, rng: np.eye(1, n, n // 3)[0],
    "step": lambda n, rng: np.where(np.arange(n) < n // 2, 0.0, 100.0),
    "ramp": lambda n, rng: np.arange(n) / n,
}


def exact_line(source, guide, lam, sigma):
    """(I + lam L) x = f by the textbook recursion in 60 digits, where its cancellations do no harm."""
    with mpmath.workdps(60):
        n, zero = len(source), mpmath.mpf(0)
        links = [
            mpmath.mpf(lam) * mpmath.exp(-abs(mpmath.mpf(b) - mpmath.mpf(a)) / sigma) for a, b in zip(guide, guide[1:])
        ]
        links = [zero, *links, zero]
        upper, x = [zero] * n, [mpmath.mpf(float(value)) for value in source]
        for i in range(n):
            pivot = 1 + links[i] + links[i + 1] - (links[i] * upper[i - 1] if i else zero)
            upper[i] = links[i + 1] / pivot
            x[i] = (x[i] + (links[i] * x[i - 1] if i else zero)) / pivot
        for i in range(n - 2, -1, -1):
            x[i] += upper[i] * x[i + 1]
        return np.array([float(value) for value in x])


def dense_matrix(guide, lam, sigma, dtype=np.float64):
    """I + lam L of one line, guide (n, G)."""
    distance = np.sqrt((np.diff(guide.astype(dtype), axis=0) ** 2).sum(axis=1))
    links = lam * (np.exp(-distance / sigma) if sigma else (distance == 0).astype(dtype))
    matrix = np.eye(len(guide), dtype=dtype)
    for i, link in enumerate(links):
        matrix[i : i + 2, i : i + 2] += link * np.array([[1, -1], [-1, 1]])
    return matrix


def eliminated(matrix, right):
    """Gaussian elimination of a tridiagonal system in the matrix's own dtype: LAPACK has no extended precision."""
    matrix, x = matrix.copy(), right.copy()
    for i in range(1, len(x)):
        factor = matrix[i, i - 1] / matrix[i - 1, i - 1]
        matrix[i] -= factor * matrix[i - 1]
        x[i] -= factor * x[i - 1]
    for i in range(len(x) - 1, -1, -1):
        x[i] = (x[i] - (matrix[i, i + 1] * x[i + 1] if i + 1 < len(x) else 0)) / matrix[i, i]
    return x


def exact_image(source, guide, lam, sigma, *, iterations, schedule, solve=eliminated, dtype=np.longdouble):
    """Rows, then columns, one line after the other. source (H, W, C), guide (H, W, G)."""
    image = source.astype(dtype)
    powers = [4.0 ** (iterations - t) for t in range(1, iterations + 1)]
    for t, power in enumerate(powers):
        strength = lam * 1.5 * power / (4.0**iterations - 1) if schedule == "min2014" else lam / 4.0**t
        for row in range(image.shape[0]):
            image[row] = solve(dense_matrix(guide[row], strength, sigma, dtype), image[row])
        for column in range(image.shape[1]):
            image[:, column] = solve(dense_matrix(guide[:, column], strength, sigma, dtype), image[:, column])
    return image


def relative_error(result, exact, source):
    """Pixel by pixel, down to values 1e-20 of the source's largest, which a colour cannot tell from 0."""
    floor = 1e-20 * float(np.abs(source).max())
    return float(np.max(np.abs(result - exact) / np.maximum(np.abs(exact), max(floor, 1e-300))))


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_all_small_sizes_against_dense_matrices(schedule):
    rng = np.random.default_rng(1)
    for height, width in itertools.product(range(1, 10), repeat=2):
        source, guide = rng.random((height, width, 2)), rng.integers(0, 256, (height, width, 3))
        exact = exact_image(
            source, guide, 50.0, 90.0, iterations=2, schedule=schedule, solve=np.linalg.solve, dtype=np.float64
        )
        got = fast_global_smoother(source, guide, 50.0, 90.0, 2, schedule)
        np.testing.assert_allclose(got, exact, rtol=1e-12, err_msg=f"{height} x {width}")


@settings(max_examples=120, deadline=None, derandomize=True, database=None)
@given(
    lam=st.one_of(st.just(0.0), st.floats(-3, 12).map(lambda e: 10.0**e)),
    relative_sigma=st.floats(-6, 6).map(lambda e: 10.0**e),
    length=st.one_of(st.integers(1, 40), st.integers(1, 1500)),
    guide_kind=st.sampled_from(sorted(GUIDES)),
    source_kind=st.sampled_from(sorted(SOURCES)),
    seed=st.integers(0, 9),
)
def test_lines_in_float32_against_60_digits(*, lam, relative_sigma, length, guide_kind, source_kind, seed):
    rng = np.random.default_rng(seed)
    guide, source = GUIDES[guide_kind](length, rng), SOURCES[source_kind](length, rng).astype(np.float32)
    sigma = relative_sigma * max(np.ptp(guide), 1.0)
    exact = exact_line(source, guide, lam, sigma)
    got = fast_global_smoother(source[None], guide[None], lam, sigma, 1, "opencv")[0]
    assert got.dtype == np.float32
    assert relative_error(got, exact, source) <= 1e-5


@pytest.mark.parametrize("lam", [32.0, 1e10, 1e12])
@pytest.mark.parametrize("source_kind", ["impulse", "noise", "ramp"])
def test_lines_of_4096_pixels(source_kind, lam):
    rng = np.random.default_rng(0)
    for guide_kind, sigma in (("constant", 1.0), ("noise", 25.0)):
        guide, source = GUIDES[guide_kind](4096, rng), SOURCES[source_kind](4096, rng).astype(np.float32)
        exact = exact_line(source, guide, lam, sigma)
        for shape in ((1, -1), (-1, 1)):
            got = fast_global_smoother(source.reshape(shape), guide.reshape(shape), lam, sigma, 1, "opencv")
            assert relative_error(got.ravel(), exact, source) <= 1e-5


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="this platform's long double is a double")
@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("lam", [32.0, 1e6, 1e12])
def test_images_against_extended_precision(lam, schedule):
    rng = np.random.default_rng(3)
    guide = rng.integers(0, 256, (23, 34, 1))
    guide[:, 17:] //= 4
    source = (rng.random((23, 34, 2)) * 100).astype(np.float32)
    for sigma in (0.01, 5.0, 200.0):
        exact = exact_image(source, guide, lam, sigma, iterations=3, schedule=schedule).astype(np.float64)
        got = fast_global_smoother(source, guide, lam, sigma, 3, schedule)
        assert relative_error(got, exact, source) <= 1e-5
        signed = source - np.float32(50)
        exact = exact_image(signed, guide, lam, sigma, iterations=3, schedule=schedule).astype(np.float64)
        got = fast_global_smoother(signed, guide, lam, sigma, 3, schedule)
        assert np.abs(got - exact).max() <= 1e-5 * np.abs(signed).max()


def test_opencv_schedule_is_opencvs_filter():
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    if not hasattr(cv2, "ximgproc"):
        pytest.skip("this OpenCV has no ximgproc")
    rng = np.random.default_rng(4)
    guide = cv2.GaussianBlur(rng.integers(0, 256, (90, 133)).astype(np.uint8), (0, 0), 2) * 2
    source = (rng.random((90, 133)) * 100).astype(np.float32)
    colour_guide = rng.integers(0, 256, (90, 133, 3)).astype(np.uint8)
    for lam, sigma, tolerance in ((1.0, 10.0, 1e-4), (32.0, 200.0, 1e-4), (500.0, 30.0, 5e-3)):
        for each in (guide, colour_guide):
            theirs = cv2.ximgproc.fastGlobalSmootherFilter(each, source, lam, sigma)
            ours = fast_global_smoother(source, each, lam, sigma, schedule="opencv")
            assert np.abs(ours - theirs).max() <= tolerance, (
                lam,
                sigma,
            )  # of 100: their recursion cancels as lam grows
            assert np.abs(fast_global_smoother(source, each, lam, sigma) - theirs).max() > 0.01  # the paper's is weaker


def test_lambda_schedules():
    for iterations in (1, 2, 3, 7):
        paper = [1.5 * 4.0 ** (iterations - t) / (4.0**iterations - 1) * 8 for t in range(1, iterations + 1)]
        assert lambda_schedule(8.0, iterations, "min2014") == pytest.approx(paper, rel=1e-14)
    assert lambda_schedule(8.0, 3, "opencv") == [8.0, 2.0, 0.5]


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(
    value=st.floats(-(2.0**127), 2.0**127, width=32),
    lam=st.floats(0, 12).map(lambda e: 10.0**e),
    sigma=st.floats(-6, 6).map(lambda e: 10.0**e),
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
)
def test_constants_stay_exactly(value, lam, sigma, shape):
    guide = np.random.default_rng(0).integers(0, 256, shape)
    source = np.full(shape, value, np.float32)
    np.testing.assert_array_equal(fast_global_smoother(source, guide, lam, sigma), source)


def test_constants_within_regions_to_a_few_units_in_the_last_place():
    guide = np.zeros((300, 300))
    guide[100:, 120:] = 1.0
    source = np.where(guide > 0, 73.3, 11.1).astype(np.float32)
    for lam in (1e2, 1e7, 1e12):
        got = fast_global_smoother(source, guide, lam, 1e-3)
        np.testing.assert_array_max_ulp(got, source, maxulp=16)


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(
    lam=st.floats(-3, 12).map(lambda e: 10.0**e),
    sigma=st.one_of(st.just(0.0), st.floats(-6, 6).map(lambda e: 10.0**e)),
    offset=st.sampled_from([0.0, 1e6, -1e6]),
    seed=st.integers(0, 99),
)
def test_result_stays_within_the_range_of_each_channel(lam, sigma, offset, seed):
    rng = np.random.default_rng(seed)
    source = (rng.standard_normal((2, 19, 26, 2)) + offset).astype(np.float32)
    got = fast_global_smoother(source, rng.integers(0, 256, (2, 19, 26)), lam, sigma)
    low, high = source.min(axis=(1, 2), keepdims=True), source.max(axis=(1, 2), keepdims=True)
    assert ((got >= low) & (got <= high)).all()


def test_linear_in_the_source():
    rng = np.random.default_rng(5)
    guide, a, b = rng.integers(0, 256, (40, 50)), rng.random((40, 50, 2)), rng.random((40, 50, 2))
    for lam in (32.0, 1e9):
        both = fast_global_smoother(2.0 * a - 3.0 * b, guide, lam)
        parts = 2.0 * fast_global_smoother(a, guide, lam) - 3.0 * fast_global_smoother(b, guide, lam)
        np.testing.assert_allclose(both, parts, atol=1e-13)
    single = a.astype(np.float32)
    np.testing.assert_array_equal(fast_global_smoother(-single, guide), -fast_global_smoother(single, guide))


def test_rows_come_before_columns():
    rng = np.random.default_rng(6)
    guide, source = rng.integers(0, 256, (30, 41)), rng.random((30, 41))
    turned = fast_global_smoother(source.T, guide.T, 32.0, 20.0).T
    straight = fast_global_smoother(source, guide, 32.0, 20.0)
    assert 1e-4 < np.abs(turned - straight).max() < 0.5  # another order of passes: alike, not equal
    row = fast_global_smoother(source[:1], guide[:1], 32.0, 20.0)
    column = fast_global_smoother(source[:1].T, guide[:1].T, 32.0, 20.0)
    np.testing.assert_array_equal(row, column.T)  # one line has no order
    mirrored = fast_global_smoother(source[:, ::-1], guide[:, ::-1], 32.0, 20.0)[:, ::-1]
    np.testing.assert_allclose(mirrored, straight, rtol=1e-13)


def test_strong_smoothing_gives_the_mean_and_none_the_source():
    rng = np.random.default_rng(7)
    source, guide = rng.random((33, 47)).astype(np.float32), rng.integers(0, 256, (33, 47))
    np.testing.assert_array_equal(fast_global_smoother(source, guide, 0.0), source)
    got = fast_global_smoother(source, np.zeros((33, 47)), 1e12)
    np.testing.assert_allclose(got, source.mean(dtype=np.float64), rtol=1e-6)


@pytest.mark.parametrize("sigma", [0.0, 5e-324, 1e-300, 1e-30])
def test_vanishing_sigma_links_equal_pixels_only(sigma):
    guide = np.array([[3.0, 3.0, 3.0, 4.0, 4.0, 9.0]])
    source = np.array([[0.0, 3.0, 6.0, 10.0, 20.0, 5.0]])
    got = fast_global_smoother(source, guide, 1e12, sigma)
    np.testing.assert_allclose(got, [[3.0, 3.0, 3.0, 15.0, 15.0, 5.0]], rtol=1e-9)


@pytest.mark.parametrize(
    "dtype", ["bool", "uint8", "int8", "uint16", "int16", "uint32", "int32", ">i2", "int64", "uint64"]
)
def test_integer_guides_keep_their_differences(dtype):
    kind, rng = np.dtype(dtype), np.random.default_rng(8)
    small = rng.integers(0, 2 if dtype == "bool" else 100, (12, 13))
    source = rng.random((12, 13))
    expected = fast_global_smoother(source, small.astype(np.float64), 30.0, 20.0)
    guide = small.astype(kind)
    if kind.kind != "b":  # up to the largest value of the type, far beyond the whole numbers of float64 for 64 bits
        guide = guide + kind.type(int(np.iinfo(kind).max) - int(small.max()))
    np.testing.assert_array_equal(fast_global_smoother(source, guide, 30.0, 20.0), expected)


def test_guides_over_the_whole_range_of_64_bits():
    limits = np.iinfo(np.int64)
    guide = np.array([[limits.min, limits.min, limits.max, limits.max]])
    source = np.array([[0.0, 2.0, 4.0, 6.0]])
    for given_guide in (guide, torch.from_numpy(guide)):
        as_given = source if isinstance(given_guide, np.ndarray) else torch.from_numpy(source)
        got = fast_global_smoother(as_given, given_guide, 1e9, 1e6)
        np.testing.assert_allclose(np.asarray(got), [[1.0, 1.0, 5.0, 5.0]], rtol=1e-8)


def test_extreme_magnitudes():
    rng = np.random.default_rng(9)
    source, guide = rng.random((20, 30)), rng.standard_normal((20, 30))
    expected = fast_global_smoother(source, guide, 1e6, 1.0)
    huge = (source * 3e38).astype(np.float32)
    np.testing.assert_allclose(fast_global_smoother(huge, guide, 1e6, 1.0) / np.float32(3e38), expected, rtol=1e-5)
    np.testing.assert_allclose(fast_global_smoother(source * 1e307, guide, 1e6, 1.0), expected * 1e307, rtol=1e-12)
    np.testing.assert_allclose(fast_global_smoother(source, guide * 1e307, 1e6, 1e307), expected, rtol=1e-12)
    tall = np.stack([guide, guide, guide], -1) * 1e300
    np.testing.assert_allclose(fast_global_smoother(source, tall, 1e6, np.sqrt(3) * 1e300), expected, rtol=1e-12)


def test_confidence_against_its_definition():
    rng = np.random.default_rng(10)
    source, guide, trust = rng.random((25, 31, 2)), rng.integers(0, 256, (25, 31)), rng.random((25, 31))
    numerator = fast_global_smoother(source * trust[..., None], guide, 50.0, 30.0)
    expected = numerator / fast_global_smoother(trust, guide, 50.0, 30.0)[..., None]
    got = fast_global_smoother(source, guide, 50.0, 30.0, confidence=trust)
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    plain = fast_global_smoother(source, guide, 50.0, 30.0)
    half = fast_global_smoother(source, guide, 50.0, 30.0, confidence=np.full((25, 31), 0.5))
    np.testing.assert_allclose(half, plain, rtol=1e-12)


def test_confidence_fills_from_the_same_region_and_leaves_what_it_cannot_reach():
    guide = np.zeros((20, 60))
    guide[:, 30:] = 200.0
    guide[:, 50:] = 90.0
    source = np.where(guide == 0, 5.0, 80.0).astype(np.float32)
    source[:, 45:] = -33.0
    trust = np.zeros((20, 60), np.float32)
    trust[3, 4] = trust[3, 33] = 1.0
    got = fast_global_smoother(source, guide, 32.0, 0.5, confidence=trust)
    np.testing.assert_allclose(got[:, :30], 5.0, rtol=1e-5)  # from one pixel, whose share fades to 1e-9
    np.testing.assert_allclose(got[:, 30:50], 80.0, rtol=1e-5)
    np.testing.assert_array_equal(got[:, 50:], -33.0)  # no trust there: untouched
    nowhere = fast_global_smoother(source, guide, 32.0, 0.5, confidence=np.zeros((20, 60)))
    np.testing.assert_array_equal(nowhere, source)
