"""The same questions to every smoothing filter, and each of them against a slow, obvious version of itself."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from MedColorLib.errors import InputError, MedColorError, SettingsError
from MedColorLib.filters import FILTERS, PARAMETERS, smooth
from MedColorLib.filters import wls as wls_module
from MedColorLib.filters.domain_transform import domain_transform
from MedColorLib.filters.guided import guided_filter
from MedColorLib.filters.wls import wls

ROOT = Path(__file__).parents[3]
WRONG = {
    "fgs": [{"lam": -1.0}, {"sigma": float("nan")}, {"schedule": "?"}],
    "guided": [{"radius": -1}, {"radius": 1.5}, {"eps": 0.0}, {"eps": float("nan")}],
    "domain-transform": [{"sigma_s": 0.0}, {"sigma_r": 0.0}, {"sigma_r": float("inf")}, {"iterations": 0}],
    "wls": [{"lam": -0.1}, {"alpha": float("nan")}, {"eps": 0.0}],
}


def picture(height=24, width=31, channels=2, seed=0):
    """Signed colour and a guide with two tissues, an edge, and noise."""
    rng = np.random.default_rng(seed)
    source = (rng.standard_normal((height, width, channels)) * 30).astype(np.float32)
    guide = rng.uniform(0, 8, (height, width)).astype(np.float32)
    guide[:, width // 2 :] += 180
    return source, guide


@pytest.mark.parametrize("name", FILTERS)
class TestEveryFilter:
    def test_shape_dtype_and_untouched_arguments(self, name):
        for height, width, channels in ((24, 31, 2), (1, 9, 3), (9, 1, 1), (1, 1, 2), (2, 2, 4)):
            source, guide = picture(height, width, channels)
            before = source.copy(), guide.copy()
            got = smooth(name, source, guide)
            assert got.shape == source.shape and got.dtype == np.float32 and np.isfinite(got).all()
            np.testing.assert_array_equal(source, before[0])
            np.testing.assert_array_equal(guide, before[1])
            np.testing.assert_array_equal(smooth(name, source, guide), got)

    def test_linear_in_the_source(self, name):
        (a, guide), (b, _) = picture(seed=1), picture(seed=2)
        both = smooth(name, 2 * a - 3 * b, guide)
        parts = 2 * smooth(name, a, guide) - 3 * smooth(name, b, guide)
        np.testing.assert_allclose(both, parts, atol=1e-4)

    def test_channels_do_not_mix(self, name):
        source, guide = picture(channels=3)
        together = smooth(name, source, guide)
        for channel in range(3):
            alone = smooth(name, source[..., channel : channel + 1], guide)
            np.testing.assert_allclose(together[..., channel : channel + 1], alone, atol=1e-5)

    @pytest.mark.parametrize("value", [0.0, 73.3, -1e-20, 3e30])
    def test_constants_stay(self, name, value):
        source, guide = picture()
        source[:] = value
        np.testing.assert_allclose(smooth(name, source, guide), source, rtol=2e-7)

    def test_smooths_within_a_region_and_not_across_the_edge(self, name):
        source, guide = picture()
        source[:, 31 // 2 :] += 500
        parameters = PARAMETERS[name]()
        if name == "fgs":  # the paper's 200 lets colour cross this edge
            parameters = replace(parameters, sigma=5.0)
        if name == "domain-transform":
            parameters = replace(parameters, sigma_r=5.0)
        if name == "guided":
            parameters = replace(parameters, eps=500.0)
        got = smooth(name, source, guide, parameters)
        left, right = got[:, :10], got[:, 21:]
        assert left.std() < 0.6 * source[:, :10].std() and right.std() < 0.6 * source[:, 21:].std()
        assert abs(left.mean()) < 60 and abs(right.mean() - 500) < 60

    def test_flat_black_guide(self, name):
        source, guide = picture()
        got = smooth(name, source, np.zeros_like(guide))
        assert np.isfinite(got).all() and got.std() < source.std()

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_bad_pixels_are_counted(self, name, bad):
        source, guide = picture()
        guide[3, 4] = bad
        with pytest.raises(InputError, match="guide: 1 of 744"):
            smooth(name, source, guide)
        source, guide = picture()
        source[3, 4] = bad
        with pytest.raises(InputError, match="source: 2 of 1488"):
            smooth(name, source, guide)

    def test_wrong_shapes_are_refused(self, name):
        source, guide = picture()
        for wrong in ((source, guide.T), (source[:0], guide[:0]), (source[None, None], guide), (source, guide[0])):
            with pytest.raises(InputError):
                smooth(name, *wrong)

    def test_wrong_parameters_are_refused(self, name):
        for wrong in WRONG[name]:
            with pytest.raises(SettingsError, match=next(iter(wrong))):
                PARAMETERS[name](**wrong)
        source, guide = picture()
        other = PARAMETERS["wls" if name == "fgs" else "fgs"]()
        with pytest.raises(SettingsError, match="parameters"):
            smooth(name, source, guide, other)


def test_unknown_name_lists_the_filters():
    with pytest.raises(SettingsError, match=r"domain-transform.*bilateral"):
        smooth("bilateral", *picture())


def test_importing_the_filters_loads_no_heavy_package():
    code = "import sys, MedColorLib.filters; print(*{m.split('.')[0] for m in sys.modules} & {'torch', 'scipy', 'cv2'})"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def slow_guided(source, guide, radius, eps):
    """Window by window, two-pass moments in extended precision."""
    source, guide = source.astype(np.longdouble), guide.astype(np.longdouble)
    height, width = guide.shape
    slope, offset = np.zeros_like(guide), np.zeros_like(guide)

    def window(i, j):
        return np.s_[max(i - radius, 0) : i + radius + 1, max(j - radius, 0) : j + radius + 1]

    for i in range(height):
        for j in range(width):
            g, f = guide[window(i, j)], source[window(i, j)]
            slope[i, j] = ((g - g.mean()) * (f - f.mean())).mean() / (((g - g.mean()) ** 2).mean() + eps)
            offset[i, j] = f.mean() - slope[i, j] * g.mean()
    result = np.zeros_like(guide)
    for i in range(height):
        for j in range(width):
            result[i, j] = slope[window(i, j)].mean() * guide[i, j] + offset[window(i, j)].mean()
    return result.astype(np.float64)


@pytest.mark.parametrize(("radius", "eps"), [(0, 2.0), (1, 1e-6), (3, 2.0), (16, 100.0), (1000, 2.0)])
def test_guided_filter_window_by_window(radius, eps):
    source, guide = picture(13, 18, 1)
    got = guided_filter(source[..., 0].astype(np.float64), guide, radius, eps)
    np.testing.assert_allclose(got, slow_guided(source[..., 0], guide, radius, eps), atol=1e-9)


def test_guided_filter_far_from_zero():
    rng = np.random.default_rng(3)
    guide, source = 30000.0 + rng.standard_normal((12, 15)) * 0.1, 1e12 + rng.standard_normal((12, 15))
    for eps in (1e-2, 1e-6):
        got = guided_filter(source, guide, 2, eps)
        np.testing.assert_allclose(got - 1e12, slow_guided(source - 1e12, guide, 2, eps), atol=2e-4)


def test_guided_filter_agrees_with_opencv_away_from_the_border():
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    if not hasattr(cv2, "ximgproc"):
        pytest.skip("this OpenCV has no ximgproc")
    source, guide = picture(90, 100)
    theirs = cv2.ximgproc.guidedFilter(guide, source, 5, 100.0)  # mirrors at the border, ours averages what is there
    inside = np.s_[10:-10, 10:-10]
    np.testing.assert_allclose(guided_filter(source, guide, 5, 100.0)[inside], theirs[inside], atol=2e-3)


def slow_domain_transform(source, guide, sigma_s, sigma_r, iterations):
    image, guide = source.astype(np.float64).copy(), guide.astype(np.float64)
    for iteration in range(1, iterations + 1):
        sigma = sigma_s * np.sqrt(3) * 2 ** (iterations - iteration) / np.sqrt(4**iterations - 1)
        for lines, guides in ((image, guide), (image.T, guide.T)):
            for line, along in zip(lines, guides):
                weight = [
                    np.exp(-np.sqrt(2) / sigma) ** (1 + sigma_s / sigma_r * abs(b - a))
                    for a, b in zip(along, along[1:])
                ]
                for n in range(1, len(line)):
                    line[n] = (1 - weight[n - 1]) * line[n] + weight[n - 1] * line[n - 1]
                for n in range(len(line) - 2, -1, -1):
                    line[n] = (1 - weight[n]) * line[n] + weight[n] * line[n + 1]
    return image


@pytest.mark.parametrize("parameters", [(8.0, 200.0, 3), (0.5, 5.0, 1), (100.0, 1e-3, 2), (1e9, 1e9, 3)])
def test_domain_transform_pixel_by_pixel(parameters):
    source, guide = picture(14, 17, 1)
    got = domain_transform(source[..., 0].astype(np.float64), guide, *parameters)
    np.testing.assert_allclose(got, slow_domain_transform(source[..., 0], guide, *parameters), atol=1e-11)


def test_domain_transform_agrees_with_opencv():
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed")
    if not hasattr(cv2, "ximgproc"):
        pytest.skip("this OpenCV has no ximgproc")
    source, guide = picture(90, 100)
    for sigma_s, sigma_r, iterations in ((8.0, 200.0, 3), (30.0, 20.0, 2)):
        theirs = cv2.ximgproc.dtFilter(guide, source, sigma_s, sigma_r, mode=cv2.ximgproc.DTF_RF, numIters=iterations)
        np.testing.assert_allclose(domain_transform(source, guide, sigma_s, sigma_r, iterations), theirs, atol=1e-4)


def test_domain_transform_stays_within_the_range():
    source, guide = picture()
    for sigma_s, sigma_r in ((1e-3, 1e100), (1e9, 1e-100), (1e9, 1e100), (8.0, 0.1)):
        got = domain_transform(source, guide, sigma_s, sigma_r)
        assert (got >= source.min(axis=(0, 1))).all() and (got <= source.max(axis=(0, 1))).all()


def dense_wls(source, guide, lam, alpha, eps):
    height, width = guide.shape
    luminance = np.log(guide.astype(np.float64) + 1)
    matrix = np.eye(height * width)
    for i in range(height):
        for j in range(width):
            for k, m in ((i + 1, j), (i, j + 1)):
                if k < height and m < width:
                    link = lam / (abs(luminance[i, j] - luminance[k, m]) ** alpha + eps)
                    p, q = i * width + j, k * width + m
                    matrix[[p, q], [p, q]] += link
                    matrix[[p, q], [q, p]] -= link
    return np.linalg.solve(matrix, source.reshape(height * width, -1)).reshape(source.shape)


@pytest.mark.parametrize("parameters", [(0.2, 1.8, 1e-4), (0.0, 1.8, 1e-4), (5.0, 0.0, 1.0), (1.0, 1.2, 1e-2)])
def test_wls_against_a_dense_matrix(parameters):
    for height, width in ((1, 1), (1, 8), (9, 1), (7, 11)):
        source, guide = picture(height, width)
        source = source.astype(np.float64)
        np.testing.assert_allclose(wls(source, guide, *parameters), dense_wls(source, guide, *parameters), atol=1e-9)


def test_wls_by_tiles_is_the_direct_solution(monkeypatch):
    source, guide = picture(70, 83)
    source[..., 1] = 4.5  # a constant channel is solved at the start
    direct = wls(source.astype(np.float64), guide)
    monkeypatch.setattr(wls_module, "DIRECT_PIXELS", 100)
    monkeypatch.setattr(wls_module, "_TILE", 25)
    monkeypatch.setattr(wls_module, "_OVERLAP", 6)
    tiles = wls(source.astype(np.float64), guide)
    assert not np.array_equal(tiles, direct)  # another way was taken
    np.testing.assert_allclose(tiles, direct, atol=1e-7)


def test_wls_refuses_a_solution_it_cannot_trust(monkeypatch):
    source, guide = picture(70, 83)
    monkeypatch.setattr(wls_module, "DIRECT_PIXELS", 100)
    monkeypatch.setattr(wls_module, "_TILE", 10)
    monkeypatch.setattr(wls_module, "_OVERLAP", 0)
    monkeypatch.setattr(wls_module, "_STEPS", 3)
    with pytest.raises(MedColorError, match="residual"):
        wls(source, guide)


def test_wls_needs_luminance():
    source, guide = picture()
    with pytest.raises(InputError, match="at least 0"):
        wls(source, guide - 1000)
