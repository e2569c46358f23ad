"""Where OpenCV's filters are used, where ours take over, and that the two agree at the edges of the switch."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from MedColorLib.filters import FgsParameters, opencv
from MedColorLib.filters.domain_transform import domain_transform
from MedColorLib.filters.fgs import fast_global_smoother, smooth
from MedColorLib.filters.fgs_parameters import lambda_schedule
from MedColorLib.filters.guided import guided_filter

ONE_STEP = np.float64(1e-7)


def picture(height=40, width=61, channels=2, seed=0):
    rng = np.random.default_rng(seed)
    source = (rng.standard_normal((height, width, channels)) * 30).astype(np.float32)
    guide = rng.integers(0, 256, (height, width)).astype(np.uint8)
    guide[:, width // 2 :] //= 6
    return source, guide


@pytest.fixture
def asked(monkeypatch):
    """Which filters of OpenCV were really run; skips where OpenCV has none."""
    if opencv.contributed() is None:
        pytest.skip("this OpenCV has no ximgproc")
    seen = []

    class Watched:
        def __getattr__(self, name):
            seen.append(name)
            return getattr(real, name)

    real = opencv.contributed()
    monkeypatch.setattr(opencv, "contributed", Watched)
    return seen


def own_fgs(source, guide, lam, sigma, iterations=3, schedule="min2014"):
    """Ours, whatever the switch says: tensors are never sent to OpenCV."""
    tensors = torch.from_numpy(np.array(source)), torch.from_numpy(np.array(guide))
    return fast_global_smoother(*tensors, lam, sigma, iterations, schedule).numpy()


def lambda_of(first, schedule="min2014"):
    return first / lambda_schedule(1.0, 3, schedule)[0]


class TestFastGlobalSmoother:
    @pytest.mark.parametrize("schedule", ["min2014", "opencv"])
    @pytest.mark.parametrize("sigma", [opencv.SIGMA_RANGE[0], 5.0, 200.0, opencv.SIGMA_RANGE[1]])
    @pytest.mark.parametrize("first", [1e-3, 1.0, 30.0, opencv.LARGEST_LAMBDA * (1 - ONE_STEP)])
    def test_the_two_agree_wherever_opencv_is_used(self, first, sigma, schedule, asked):
        lam = lambda_of(first, schedule)
        for seed, (height, width) in enumerate([(2, 2), (2, 300), (300, 2), (40, 61)]):
            source, guide = picture(height, width, 3, seed)
            for values in (source, np.abs(source) + 50, np.where(source > 60, source, 0)):
                got = fast_global_smoother(values, guide, lam, sigma, 3, schedule)
                difference = np.abs(got - own_fgs(values, guide, lam, sigma, 3, schedule)).max()
                assert difference <= opencv.BOUND * np.abs(values).max()
        assert set(asked) == {"createFastGlobalSmootherFilter"}

    def test_long_lines_and_every_kind_of_guide(self, asked):
        rng = np.random.default_rng(1)
        source = (rng.random((3, 4096, 1)) * 100).astype(np.float32)
        source[:, :2000, 0] *= 0.01
        steps = np.broadcast_to(np.arange(4096) // 2048 * 255, (3, 4096))
        for guide in (np.zeros((3, 4096)), steps, rng.integers(0, 256, (3, 4096))):
            for turn in (lambda x: x, lambda x: np.ascontiguousarray(np.swapaxes(x, 0, 1))):
                lam = lambda_of(opencv.LARGEST_LAMBDA)
                got = fast_global_smoother(turn(source), turn(guide), lam * (1 - ONE_STEP), 20.0)
                assert np.abs(got - own_fgs(turn(source), turn(guide), lam, 20.0)).max() <= 100 * opencv.BOUND
        assert len(asked) == 6

    @pytest.mark.parametrize("dtype", ["uint8", "int16", "int64", "float32", "float64", "uint16"])
    def test_whole_numbers_of_any_type_are_an_8_bit_guide(self, dtype, asked):
        source, guide = picture()
        got = smooth(source, guide.astype(dtype))
        np.testing.assert_array_equal(got, smooth(source, guide))
        assert len(asked) == 2

    @pytest.mark.parametrize(
        ("change", "options"),
        [
            (lambda s, g: (s, g + np.float32(0.25)), {}),
            (lambda s, g: (s, g.astype(np.int64) + 1), {}),
            (lambda s, g: (s, g.astype(np.int64) - 1), {}),
            (lambda s, g: (s.astype(np.float64), g), {}),
            (lambda s, g: (s.astype(np.float16), g), {}),
            (lambda s, g: (s[None], g), {}),
            (lambda s, g: (s[:1], g[:1]), {}),
            (lambda s, g: (s * np.float32(1e30), g), {}),
            (lambda s, g: (s, np.stack([g] * 2, -1)), {}),
            (lambda s, g: (s, g), {"lam": lambda_of(opencv.LARGEST_LAMBDA) * 1.0001}),
            (lambda s, g: (s, g), {"lam": 0.0}),
            (lambda s, g: (s, g), {"sigma": 0.0}),
            (lambda s, g: (s, g), {"sigma": 0.0099}),
            (lambda s, g: (s, g), {"sigma": 1.1e6}),
            (lambda s, g: (s, g), {"confidence": np.ones((40, 61))}),
        ],
    )
    def test_ours_takes_over_outside(self, change, options, asked):
        source, guide = picture()
        source[:, :, 0] += 100
        source, guide = change(source, guide)
        got = fast_global_smoother(source, guide, **options)
        assert not asked and got.dtype == source.dtype and np.isfinite(got).all()

    def test_the_number_of_threads_changes_nothing(self, asked):
        import cv2

        source, guide = picture(37, 53)
        before, found = cv2.getNumThreads(), []
        try:
            for threads in (1, 2, 3):
                cv2.setNumThreads(threads)
                found.append(smooth(source, guide))
                assert cv2.getNumThreads() == threads
        finally:
            cv2.setNumThreads(before)
        np.testing.assert_array_equal(found[0], found[1])
        np.testing.assert_array_equal(found[0], found[2])

    def test_a_guide_rounded_to_8_bits_moves_the_result_little(self, asked):
        """What rounding a luminance of 0..255 costs: the links change by 1 / sigma at most."""
        source, guide = picture(seed=4)
        fine = np.clip(guide + np.random.default_rng(0).uniform(-0.5, 0.5, guide.shape), 0, 255)
        difference = smooth(source, np.rint(fine), FgsParameters()) - smooth(source, fine, FgsParameters())
        assert np.abs(difference).max() < 0.005 * np.abs(source).max()
        assert len(asked) == 1

    def test_without_the_contributed_modules_the_result_is_the_same(self, monkeypatch):
        source, guide = picture(channels=3)
        fast = smooth(source, guide), domain_transform(source, guide)
        monkeypatch.setattr(opencv, "contributed", lambda: None)
        for one, other in zip(fast, (smooth(source, guide), domain_transform(source, guide))):
            assert one.dtype == other.dtype and np.abs(one - other).max() <= opencv.BOUND * np.abs(source).max()

    def test_plain_opencv_has_no_contributed_modules(self, monkeypatch):
        import cv2

        monkeypatch.delattr(cv2, "ximgproc", raising=False)
        monkeypatch.setitem(__import__("sys").modules, "cv2.ximgproc", None)
        assert opencv.contributed() is None


class TestDomainTransform:
    @pytest.mark.parametrize("sigma_r", [opencv.SIGMA_R_LEAST, 20.0, 200.0, 1e9])
    @pytest.mark.parametrize("sigma_s", [*opencv.SIGMA_S_RANGE, 8.0])
    def test_the_two_agree_wherever_opencv_is_used(self, sigma_s, sigma_r, asked):
        for seed, (height, width) in enumerate([(2, 2), (2, 300), (300, 2), (40, 61)]):
            source, guide = picture(height, width, 3, seed)
            for guided in (guide, guide + np.float32(0.3), np.zeros_like(guide)):
                for values in (source, source + 1000, np.where(source > 60, source, 0)):
                    got = domain_transform(values, guided, sigma_s, sigma_r)
                    exact = domain_transform(values.astype(np.float64), guided, sigma_s, sigma_r)
                    assert np.abs(got - exact).max() <= opencv.BOUND * np.abs(values).max()
        assert set(asked) == {"dtFilter", "DTF_RF"}

    @pytest.mark.parametrize(
        ("change", "options"),
        [
            (lambda s, g: (s.astype(np.float64), g), {}),
            (lambda s, g: (s, g.astype(np.float32) + 1e5), {}),
            (lambda s, g: (s[:, :1], g[:, :1]), {}),
            (lambda s, g: (np.concatenate([s] * 3, -1), g), {}),
            (lambda s, g: (s, g), {"sigma_s": 0.99}),
            (lambda s, g: (s, g), {"sigma_s": 201.0}),
            (lambda s, g: (s, g), {"sigma_r": 0.099}),
        ],
    )
    def test_ours_takes_over_outside(self, change, options, asked):
        source, guide = change(*picture())
        got = domain_transform(source, guide, **options)
        exact = domain_transform(source.astype(np.float64), guide, **options)
        assert not asked and np.abs(got - exact).max() <= opencv.BOUND * np.abs(source).max()


class TestGuided:
    """Single precision where it is enough, double where it is not; the switch is at eps = 1 for 8-bit guides."""

    @pytest.mark.parametrize("radius", [1, 4, 16, 100])
    @pytest.mark.parametrize("eps", [1e-6, 0.95, 1.0, 2.0, 100.0])
    def test_single_precision_is_within_the_bound(self, eps, radius):
        rng = np.random.default_rng(2)
        edge = np.where(np.arange(90) < 45, 0.0, 255.0) * np.ones((70, 1))
        for fine in (edge, np.clip(edge + rng.integers(-1, 2, edge.shape), 0, 255), rng.random(edge.shape) * 255):
            guide = fine.astype(np.float32)
            follows = guide - 128 + rng.standard_normal(guide.shape) * 5
            source = np.stack([follows, 100 + rng.standard_normal(guide.shape)], -1).astype(np.float32)
            exact = guided_filter(source.astype(np.float64), guide, radius, eps)
            got = guided_filter(source, guide, radius, eps)
            assert got.dtype == np.float32
            assert np.abs(got - exact).max() <= 1e-5 * np.abs(source).max()

    def test_many_channels_and_huge_values(self):
        rng = np.random.default_rng(3)
        source, guide = rng.standard_normal((20, 30, 9)).astype(np.float32), rng.integers(0, 256, (20, 30))
        whole = guided_filter(source, guide)
        for channel in range(9):
            np.testing.assert_array_equal(whole[..., channel], guided_filter(source[..., channel], guide))
        huge = guided_filter(source * np.float32(1e37), guide)
        np.testing.assert_allclose(huge / np.float32(1e37), whole, atol=1e-5)

    @pytest.mark.parametrize("channels", [1, 2, 5])
    def test_a_result_is_the_callers_own(self, channels):
        """The arrays that are used again hold nothing that a caller has, and each thread has its own."""
        rng = np.random.default_rng(4)
        sources = rng.standard_normal((8, 40, 30, channels)).astype(np.float32)
        guides = (rng.random((8, 40, 30)) * 255).astype(np.float32)
        before = sources.copy(), guides.copy()
        one_by_one = [guided_filter(*pair, radius=3) for pair in zip(sources, guides)]
        kept = [result.copy() for result in one_by_one]
        with ThreadPoolExecutor(4) as pool:
            together = list(pool.map(lambda pair: guided_filter(*pair, radius=3), list(zip(sources, guides)) * 5))
        np.testing.assert_array_equal(one_by_one, kept)
        np.testing.assert_array_equal(together, kept * 5)
        np.testing.assert_array_equal(sources, before[0])
        np.testing.assert_array_equal(guides, before[1])
