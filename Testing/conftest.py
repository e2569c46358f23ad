"""Fixtures that more than one test file uses."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

# Read when torch is first imported. Threads that wait must not keep the cores busy: tests often share a machine.
os.environ.setdefault("OMP_NUM_THREADS", "2")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Processes of `-n auto`."""
    import distribution

    return distribution.processes()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Ours for `--dist loadfile`; None leaves it to xdist."""
    import distribution

    return distribution.LongestFirst(config, log) if config.getoption("dist") == "loadfile" else None


@dataclass(frozen=True)
class Phantom:
    """The phantom of `MedColorLib.phantom`, every fourth slice and every second pixel: (12, 64, 56).

    `labels` (k, j, i) are indices into TISSUES, `colors` (k, j, i, 3) uint8 the true colours, `inside` (k, j, i) bool the
    body with the air inside it. All arrays are read-only, so that a test that alters its input fails.
    """

    volume: object
    reference: np.ndarray
    labels: np.ndarray
    colors: np.ndarray
    inside: np.ndarray


def _small_phantom(modality: str) -> Phantom:
    from scipy.ndimage import binary_fill_holes

    from MedColorLib import Volume
    from MedColorLib.phantom import TISSUES, labels, sample

    volume, reference = sample(modality)
    every = np.s_[::4, ::2, ::2]
    ijk_to_ras = volume.ijk_to_ras @ np.diag([2.0, 2.0, 4.0, 1.0])
    anatomy = labels()[every]
    colors = np.array([color for _, _, color in TISSUES.values()], np.uint8)[anatomy]
    inside = np.stack([binary_fill_holes(plane > 0) for plane in anatomy])
    small = Volume(np.ascontiguousarray(volume.array[every]), ijk_to_ras, name=volume.name)
    for array in (small.array, reference, anatomy, colors, inside):
        array.setflags(write=False)
    return Phantom(small, reference, anatomy, colors, inside)


@pytest.fixture(scope="session")
def ct() -> Phantom:
    """A small phantom in Hounsfield units."""
    return _small_phantom("ct")


@pytest.fixture(scope="session")
def mr() -> Phantom:
    """The same anatomy as T1 MR: another order of grey values."""
    return _small_phantom("mr")


@pytest.fixture
def rng() -> np.random.Generator:
    """Chance that is the same in every run."""
    return np.random.default_rng(20260)


@pytest.fixture(autouse=True)
def two_threads() -> None:
    """The same number of threads everywhere, so that sums have the same order; two, so that there is a second one."""
    torch, cv2 = sys.modules.get("torch"), sys.modules.get("cv2")
    if torch is not None and torch.get_num_threads() != 2:
        torch.set_num_threads(2)
    if cv2 is not None and cv2.getNumThreads() != 2:
        cv2.setNumThreads(2)


@pytest.fixture(autouse=True, scope="session")
def own_features_folder(tmp_path_factory):
    """Features that tests keep do not go to the user's cache."""
    folder = tmp_path_factory.mktemp("features")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("MedColorLib.features.kept.kept_folder", lambda: folder)
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real images; they are not part of the project."""
    return _present(SHARED / "data")


@pytest.fixture(scope="session")
def shared_weights() -> Path:
    """File of the VGG-19 weights; not part of the project."""
    return _present(SHARED / "weights" / "vgg19_oxford_uint8.safetensors")


def _present(path: Path) -> Path:
    if not path.exists():
        pytest.skip(f"needs ../shared/{path.relative_to(SHARED)} beside the repository")
    return path


@pytest.fixture(scope="module")
def small_raster():
    """All presets match on a raster of 64 pixels: the same code, a hundredth of the work."""
    from dataclasses import replace

    from MedColorLib.parameters import PRESETS

    with pytest.MonkeyPatch.context() as patch:
        for name, preset in PRESETS.items():
            patch.setitem(PRESETS, name, replace(preset, grid_px=64))
        yield
