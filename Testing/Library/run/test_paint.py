"""Painting: slices of a batch on threads of their own give what one after the other gives, and torch gets its threads back."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from MedColorLib import Settings, colorize, device
from MedColorLib.bench.peak_memory import tall_phantom
from MedColorLib.phantom import section

ROOT = Path(__file__).parents[3]


@contextmanager
def one_by_one():
    yield lambda function, *arguments: list(map(function, *arguments))


@pytest.mark.parametrize("changes", [{}, {"smoother": "fgs"}, {"preset": "full", "smoother": "guided"}])
def test_same_bytes_as_one_by_one(changes, small_raster, monkeypatch):
    volume = tall_phantom(7, 48)
    settings = Settings(**{"preset": "draft", "features": "embedded", "confidence": True, **changes})
    together = colorize(volume, [section()], settings)
    monkeypatch.setattr(device, "side_by_side", one_by_one)
    apart = colorize(volume, [section()], settings)
    np.testing.assert_array_equal(together.rgb, apart.rgb)
    np.testing.assert_array_equal(together.confidence, apart.confidence)
    assert together.report["out_of_gamut_pixels"] == apart.report["out_of_gamut_pixels"]
    assert together.rgb.any()


def test_order_threads_and_errors():
    before, names = (torch.get_num_threads(), cv2.getNumThreads()), set()

    def doubled(number):
        names.add(threading.current_thread().name)
        if number == 3:
            raise ZeroDivisionError
        return 2 * number, (torch.get_num_threads(), cv2.getNumThreads())

    with device.side_by_side() as each:
        assert each(doubled, [2, 0, 1]) == [(4, (1, 1)), (0, (1, 1)), (2, (1, 1))]
        with pytest.raises(ZeroDivisionError):
            each(doubled, [1, 3])
        assert (torch.get_num_threads(), cv2.getNumThreads()) == before
    assert all(name.startswith("MedColor slices") for name in names)
    assert not any(thread.name.startswith("MedColor slices") for thread in threading.enumerate())


def test_the_last_of_two_runs_gives_the_threads_of_blas_back():
    from threadpoolctl import threadpool_info, threadpool_limits

    def of_blas():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    with threadpool_limits(3, user_api="blas"):
        before = of_blas()
        first, second = device.side_by_side(), device.side_by_side()
        with first:
            second.__enter__()
            assert of_blas() == {1}
        assert of_blas() == {1}
        second.__exit__(None, None, None)
        assert of_blas() == before != {1}


@pytest.mark.parametrize(("cores", "free", "expected"), [(8, 1, 7), (2, 1, 1), (1, 1, 1), (4, 9, 1), (None, 1, 1)])
def test_cores_left_free(cores, free, expected, monkeypatch):
    monkeypatch.setattr(device.os, "cpu_count", lambda: cores)
    with device.one_thread():  # gives both their threads back
        assert device.leave_cores_free(free) == expected
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (expected, expected)


@pytest.mark.parametrize(("given", "expected"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_threads_sleep_while_they_wait_unless_told_otherwise(given, expected):
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment.update({} if given is None else {"OMP_WAIT_POLICY": given})
    code = "import MedColorLib, os, sys; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [expected, "False"]
