"""Fast global smoother: kinds of arrays, devices, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from MedColorLib.errors import InputError, SettingsError
from MedColorLib.filters.fgs import fast_global_smoother
from MedColorLib.filters.fgs_parameters import FgsParameters
from MedColorLib.filters.fgs_torch import fgs_torch


def test_kinds_dtypes_and_layouts():
    rng = np.random.default_rng(11)
    source, guide = rng.random((3, 16, 21, 2)), rng.integers(0, 256, (3, 16, 21)).astype(np.uint8)
    stack = fast_global_smoother(source, guide)
    assert stack.shape == source.shape and stack.dtype == np.float64 and stack.flags.c_contiguous
    for n in range(3):
        np.testing.assert_array_equal(fast_global_smoother(source[n], guide[n]), stack[n])
        np.testing.assert_array_equal(fast_global_smoother(source[n, ..., 1], guide[n]), stack[n, ..., 1])
        shared = fast_global_smoother(source, guide[n])
        np.testing.assert_array_equal(shared[n], stack[n])
    as_torch = fast_global_smoother(torch.from_numpy(source), torch.from_numpy(guide))
    assert isinstance(as_torch, torch.Tensor)
    np.testing.assert_array_equal(as_torch.numpy(), stack)
    planes = fgs_torch(torch.from_numpy(source).permute(0, 3, 1, 2), torch.from_numpy(guide)[:, None])
    np.testing.assert_array_equal(planes.permute(0, 2, 3, 1).numpy(), stack)
    assert fast_global_smoother((source * 100).astype(np.int16), guide).dtype == np.float32
    for dtype, tolerance in ((np.float32, 1e-6), (np.float16, 2e-3)):
        got = fast_global_smoother(source.astype(dtype), guide)
        assert got.dtype == dtype
        np.testing.assert_allclose(got, stack, rtol=tolerance)
    low = fast_global_smoother(torch.from_numpy(source).to(torch.bfloat16), torch.from_numpy(guide))
    assert low.dtype == torch.bfloat16


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_cpu():
    rng = np.random.default_rng(13)
    source = torch.from_numpy((rng.random((2, 2, 200, 333)) * 100).astype(np.float32))
    guide = torch.from_numpy(rng.integers(0, 256, (2, 1, 200, 333)))
    for lam in (32.0, 1e12):
        got = fgs_torch(source.cuda(), guide.cuda(), lam)
        assert got.is_cuda
        torch.testing.assert_close(got.cpu(), fgs_torch(source, guide, lam), rtol=2e-6, atol=0.0)


def test_arguments_are_not_altered_and_need_not_be_writable_or_contiguous():
    rng = np.random.default_rng(12)
    source, guide, trust = rng.random((18, 24, 3)), rng.random((18, 24)) * 255, rng.random((18, 24))
    expected = fast_global_smoother(source, guide, confidence=trust)
    kept = [array.copy() for array in (source, guide, trust)]
    for array in (source, guide, trust):
        array.setflags(write=False)
    np.testing.assert_array_equal(fast_global_smoother(source, guide, confidence=trust), expected)
    swapped = [np.asfortranarray(array).astype(">f8") for array in (source, guide, trust)]
    np.testing.assert_array_equal(fast_global_smoother(*swapped[:2], confidence=swapped[2]), expected)
    fast_global_smoother(torch.from_numpy(kept[0]), torch.from_numpy(kept[1]), confidence=torch.from_numpy(kept[2]))
    for array, before in zip((source, guide, trust), kept):
        np.testing.assert_array_equal(array, before)


@pytest.mark.parametrize(
    "wrong",
    [
        {"lam": -1.0},
        {"lam": float("nan")},
        {"lam": float("inf")},
        {"lam": 10**400},
        {"lam": "32"},
        {"sigma": -1e-9},
        {"sigma": float("nan")},
        {"sigma": float("inf")},
        {"iterations": 0},
        {"iterations": 2.5},
        {"iterations": True},
        {"schedule": "paper"},
    ],
)
def test_wrong_parameters_are_refused(wrong):
    (name,) = wrong
    with pytest.raises(SettingsError, match=name):
        fast_global_smoother(np.zeros((4, 4)), np.zeros((4, 4)), **wrong)
    with pytest.raises(SettingsError, match=name):
        FgsParameters(**wrong)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bad_pixels_are_counted(bad):
    good, spoiled = np.ones((6, 7)), np.ones((6, 7))
    spoiled[2, 3] = spoiled[5, 6] = bad
    for name, arrays in (("source", (spoiled, good)), ("guide", (good, spoiled))):
        with pytest.raises(InputError, match=f"{name}: 2 of 42 .*replace"):
            fast_global_smoother(*arrays)
    with pytest.raises(InputError, match="confidence: 2 of 42"):
        fast_global_smoother(good, good, confidence=spoiled)


@pytest.mark.parametrize(
    ("source", "guide", "confidence", "message"),
    [
        (np.zeros((4, 5)), np.zeros((5, 4)), None, "guide"),
        (np.zeros((4, 5)), np.zeros((4, 5, 3, 1)), None, "guide"),
        (np.zeros((2, 4, 5, 1)), np.zeros((3, 4, 5)), None, "guide"),
        (np.zeros(5), np.zeros(5), None, "source"),
        (np.zeros((0, 5)), np.zeros((0, 5)), None, "source"),
        (np.zeros((4, 5), complex), np.zeros((4, 5)), None, "source"),
        (np.zeros((4, 5)), np.full((4, 5), "a"), None, "guide"),
        (np.zeros((4, 5)), torch.zeros(4, 5), None, "mixture"),
        (np.zeros((4, 5)), np.zeros((4, 5)), np.full((4, 5), 1.5), "confidence.*0..1"),
        (np.zeros((4, 5)), np.zeros((4, 5)), np.full((4, 5), -0.1), "confidence.*0..1"),
        (np.zeros((4, 5)), np.zeros((4, 5)), np.ones((4, 5, 2)), "confidence"),
    ],
)
def test_wrong_arrays_are_refused(source, guide, confidence, message):
    with pytest.raises(InputError, match=message):
        fast_global_smoother(source, guide, confidence=confidence)
