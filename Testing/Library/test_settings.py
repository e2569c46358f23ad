"""Settings, devices and memory: what cannot be is told by name, in one sentence with the remedy."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch

from MedColorLib import Settings
from MedColorLib.device import choose_device, memory_errors
from MedColorLib.errors import DeviceError, MemoryTooSmall, SettingsError


def of_opencv() -> Exception:
    """What OpenCV raises where its allocator finds nothing."""
    try:
        cv2.resize(np.zeros((9, 9), np.uint8), (2**30, 2**30))
    except cv2.error as error:
        return error
    return MemoryError()


OUT_OF_MEMORY = (
    MemoryError(),
    np._core._exceptions._ArrayMemoryError((9, 9), np.dtype(float)) if hasattr(np, "_core") else MemoryError(),
    RuntimeError(
        "[enforce fail at alloc_cpu.cpp:124] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9"
    ),
    RuntimeError("Exception thrown in SimpleITK ImageFileReader_Execute: Failed to allocate memory for image."),
    RuntimeError("std::bad_alloc"),
    OSError(12, "Cannot allocate memory"),
    of_opencv(),
)
NAMES = ("preset", "features", "smoother", "luminance", "plane", "reconstruction", "device")


class TestSettings:
    @pytest.mark.parametrize(
        "wrong",
        [
            {"preset": "best"},
            {"features": "resnet"},
            {"smoother": "median"},
            {"luminance": "both"},
            {"plane": "sagittal"},
            {"reconstruction": "adam"},
            {"window": (1, 1)},
            {"window": (2, 1)},
            {"window": (0, float("inf"))},
            {"window": ("a", "b")},
            {"window": 5},
            {"window": (1, 2, 3)},
            {"slices": (3, 3)},
            {"slices": (-1, 3)},
            {"slices": "ab"},
            {"region": ((0, 1), (0, 1))},
            {"region": ((0, 1), (0, 1), (2, 2))},
            {"region": 7},
            {"seed": -1},
            {"seed": 2**63},
            {"seed": 1.5},
            {"batch": 0},
            {"batch": 2.0},
            {"coherence_mm": float("nan")},
            {"coherence_mm": -0.1},
            *(
                {name: value}
                for name in NAMES
                for value in (None, 3, 2.5, True, b"x", ["auto"], {}, np.zeros(2), object)
            ),
            *({"gamma": value} for value in ("off", "on", 0, 1, 0.5, [], np.zeros(3))),
            *({"confidence": value} for value in ("no", None, 1, [])),
            *(
                {"window": value}
                for value in ("12", b"12", True, [True, 2], {1: 2, 3: 4}, (1, None), (1, "2"), object())
            ),
            *(
                {"slices": value}
                for value in ((1.5, 3), (1.0, 3.0), (True, 3), 3, ("1", "3"), {1: 2}, (1, 2, 3), [None, 2])
            ),
            *(
                {"region": value}
                for value in (((0, 1.5), (0, 1), (0, 1)), "abc", ((0, 1),) * 2 + ("01",), [[0, 1]] * 4, {})
            ),
            *({"coherence_mm": value} for value in ("8", None, True, [8.0], np.zeros(2), 10**400, b"8", 1j)),
            *({"seed": value} for value in (True, "1", None, [1], np.zeros(2))),
            *({"batch": value} for value in (True, "4", None, [4])),
            *({"smoother_options": value} for value in (5, "lam=16", [("lam", 16)], {1: 2}, True)),
        ],
    )
    def test_wrong_values_are_named(self, wrong):
        with pytest.raises(SettingsError, match=next(iter(wrong))):
            Settings(**wrong)

    @pytest.mark.parametrize("data", [None, 5, "preset", [("preset", "full")]])
    def test_no_dictionary(self, data):
        with pytest.raises(SettingsError, match="settings: expected names and values"):
            Settings.from_dict(data)

    def test_numbers_of_numpy_are_numbers(self):
        found = Settings(
            seed=np.int64(3), batch=np.uint8(2), slices=np.array([1, 4]), window=np.array([0, 9], np.float32)
        )
        assert found == Settings(seed=3, batch=2, slices=(1, 4), window=(0, 9))
        assert json.loads(json.dumps(found.to_dict()))["slices"] == [1, 4]
        assert Settings(coherence_mm=np.float32(1.5)).coherence_mm == 1.5

    def test_through_a_dictionary_and_back(self):
        settings = Settings(window=(1, 2), slices=(3, 4), region=((0, 1), (2, 3), (4, 5)), gamma=True, seed=5)
        assert Settings.from_dict(settings.to_dict()) == settings
        with pytest.raises(SettingsError, match="settings: unknown colour; known are batch, "):
            Settings.from_dict({"colour": 1})
        with pytest.raises(SettingsError, match="preset"):
            Settings.from_dict({"preset": "best"})

    def test_what_auto_means(self):
        assert Settings(preset="full").resolved_smoother == "fgs"
        assert Settings(preset="full", luminance="paper").resolved_gamma is True
        assert Settings(preset="full", luminance="keep").resolved_gamma is False
        assert Settings(preset="draft").resolved_smoother == "regression"
        assert Settings(smoother="wls").resolved_smoother == "wls" and Settings(gamma=True).resolved_gamma is True


class TestDevices:
    def test_those_that_are_here(self):
        assert choose_device("cpu") == "cpu"
        assert choose_device("auto") in ("cpu", "cuda", "mps")

    @pytest.mark.parametrize("name", ["", "gpu", "CPU", "cuda:99", "cuda:x", "cuda:-1", "cpu:0", "tpu"])
    def test_those_that_are_not(self, name):
        with pytest.raises(DeviceError, match=r"is not here; present: cpu.*Use --device auto or one of these"):
            choose_device(name)

    def test_out_of_memory_names_the_remedy(self):
        with (
            pytest.raises(DeviceError, match=r"device cuda: .* too small; .* --preset draft or --device cpu"),
            memory_errors("cuda"),
        ):
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB")

    @pytest.mark.parametrize("error", OUT_OF_MEMORY, ids=lambda error: type(error).__name__)
    def test_of_every_library(self, error):
        with (
            pytest.raises(MemoryTooSmall, match=r"device cpu: its memory is too small; .*--slices.*--preset draft"),
            memory_errors("cpu"),
        ):
            raise error

    def test_other_errors_pass(self):
        with pytest.raises(RuntimeError, match="something else"), memory_errors("cpu"):
            raise RuntimeError("something else")
