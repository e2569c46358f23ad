"""A Slicer just installed: none of the packages that MedColor asks for is there. What a user does first works all the same."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys

import numpy as np
import pytest
import slicer
from host_fixtures import color_node, grey_node, two_colors

ABSENT = ("torch", "cv2", "scipy", "SimpleITK", "safetensors", "platformdirs", "nrrd", "nibabel", "tqdm", "PIL")


@pytest.fixture
def fresh(monkeypatch, scene):
    """Importing any of them fails, as it does where they are not installed."""
    for name in [m for m in sys.modules if m.split(".")[0] in ("MedColorLib", "MedColorSlicer")]:
        monkeypatch.delitem(sys.modules, name)
    for name in [m for m in sys.modules if m.split(".")[0] in ABSENT]:
        monkeypatch.delitem(sys.modules, name)

    class Nowhere:
        def find_spec(self, name, path=None, target=None):
            if name.split(".")[0] in ABSENT:
                raise ModuleNotFoundError(f"No module named '{name}'", name=name)

    monkeypatch.setattr(sys, "meta_path", [Nowhere(), *sys.meta_path])
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name.split(".")[0] in ABSENT else found(name, *rest)
    )
    return scene


def test_phantom_of_sample_data_needs_numpy_and_vtk_alone(fresh):
    from MedColorSlicer import samples

    grey, picture = samples.load_phantom()
    assert slicer.util.arrayFromVolume(grey).shape == (80, 144, 126)
    assert slicer.util.arrayFromVolume(picture).shape == (1, 264, 248, 3)


def test_a_result_can_be_shown_cut_and_compared_without_packages(fresh):
    """Scenes of others open in a fresh Slicer, too."""
    from MedColorSlicer.logic import MedColorLogic

    logic, rgb = MedColorLogic(), two_colors(16, 6)
    result = color_node(rgb)
    grey = slicer.util.addVolumeFromArray(rgb.max(axis=3).astype(np.int16), name="grey")
    logic.showVolumeRendering(result)
    logic.setOpacity(result, 0.4)
    logic.setCut(result, "slice")
    logic.showComparison(grey, result)
    logic.hideComparison(grey, result)
    logic.setLight(True)


@pytest.mark.parametrize(
    "call",
    [
        lambda logic, grey, picture: logic.process(grey, picture),
        lambda logic, grey, picture: logic.preview(grey, picture, 2),
        lambda logic, grey, picture: logic.plan(grey, picture),
        lambda logic, grey, picture: logic.recommend(grey, "/pictures"),
    ],
    ids=["process", "preview", "plan", "recommend"],
)
def test_console_gets_a_medcolor_error_with_the_remedy(fresh, call):
    from MedColorSlicer.logic import MedColorLogic

    from MedColorLib.errors import MedColorError

    grey = grey_node(shape=(6, 40, 40))
    before = fresh.GetNumberOfNodes()
    picture = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    with pytest.raises(MedColorError, match=r"package \w+ is missing.*Apply.*installPackages"):
        call(MedColorLogic(), grey, picture)
    assert fresh.GetNumberOfNodes() == before


def test_packages_are_not_installed_unasked(fresh):
    from MedColorSlicer.logic import MedColorLogic

    from MedColorLib.errors import MedColorError

    with pytest.raises(MedColorError, match="PyTorch is missing"):
        MedColorLogic.installPackages()


def test_phantom_in_a_bare_python():
    """Not even an import that is caught: in a process of its own."""
    code = (
        f"import sys; [sys.modules.__setitem__(name, None) for name in {ABSENT!r}]; "
        "from MedColorLib.phantom import sample; volume, picture = sample(); print(volume.array.shape, picture.shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
