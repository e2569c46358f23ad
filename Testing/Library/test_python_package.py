"""The package as Python programmers meet it: types, names, versions, metadata, wheel and sdist."""

from __future__ import annotations

import ast
import email
import json
import re
import subprocess
import sys
import tarfile
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import MedColorLib
from MedColorLib import ColorVolume, Volume, parameters

ROOT = Path(__file__).resolve().parents[2]
ADDRESS = "https://github.com/MedColor/SlicerMedColor"


def packaged(tmp_path_factory, kind: str) -> Path:
    """The wheel or sdist, made by setuptools as pip would, from a copy: nothing is left in the checkout."""
    import shutil

    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp(kind)
    shutil.copytree(ROOT / "MedColorLib", source / "MedColorLib", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    code = f"from setuptools import build_meta\nprint(build_meta.build_{kind}({str(out)!r}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out / done.stdout.split()[-1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return packaged(tmp_path_factory, "wheel")


def test_type_checkers_are_clean_on_the_public_interface():
    """`typed_use.py` also has mistakes that must be found: an ignore that is not needed fails."""
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--no-error-summary"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_type_checkers_see_what_programs_see():
    tree = ast.parse(Path(MedColorLib.__file__).read_text(encoding="utf-8"))
    (guarded,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    seen = {alias.name: node.module for node in guarded.body for alias in node.names}
    assert seen == MedColorLib._WHERE and sorted(seen) == MedColorLib.__all__


def test_literal_types_are_the_choices():
    assert get_args(parameters.PresetName) == tuple(parameters.PRESETS)
    from MedColorLib.features import EXTRACTORS
    from MedColorLib.filters import PARAMETERS

    assert set(get_args(parameters.FeaturesName)) == {"auto", *EXTRACTORS}
    assert set(get_args(parameters.SmootherName)) == {"auto", *PARAMETERS}


def test_a_volume_is_told_without_its_voxels():
    volume = Volume(np.zeros((40, 50, 60), np.int16), np.diag([1.5, 1.5, 3.0, 1.0]), name="head")
    assert repr(volume) == "<Volume 'head' 40 x 50 x 60 (k, j, i) int16, 1.5 x 1.5 x 3 mm (i, j, k)>"
    rgb = np.zeros((4, 5, 6, 3), np.uint8)
    colored = ColorVolume(rgb, np.eye(4), {"long": "report"}, "head", np.zeros((4, 5, 6), np.uint8))
    assert (
        repr(colored) == "<ColorVolume 'head' 4 x 5 x 6 (k, j, i) uint8, 1 x 1 x 1 mm (i, j, k) RGB, with confidence>"
    )
    assert str(ColorVolume(rgb, np.eye(4))).endswith("RGB>")


def test_messages_go_to_the_package_s_logger():
    silences_others = ROOT / "MedColorLib/io/quiet.py"
    used = [name for path in [*(ROOT / "MedColorLib").rglob("*.py"), *(ROOT / "MedColor").rglob("*.py")]
            if path != silences_others
            for name in re.findall(r"getLogger\((.*?)\)", path.read_text(encoding="utf-8"))]  # fmt: skip
    assert set(used) == {'"MedColorLib"'}


def test_wheel_has_all_that_the_library_needs(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        told = email.message_from_bytes(archive.read(next(name for name in names if name.endswith("/METADATA"))))
    library = ROOT / "MedColorLib"
    needed = {path.relative_to(ROOT).as_posix() for path in library.rglob("*")
              if path.suffix in (".py", ".json", ".safetensors", ".typed") and "__pycache__" not in path.parts}  # fmt: skip
    assert {"MedColorLib/py.typed", "MedColorLib/features/contrast_net.safetensors"} <= needed
    assert needed == {name for name in names if ".dist-info/" not in name}
    assert told["Version"] == MedColorLib.__version__ and told["License-Expression"] == "Apache-2.0"
    assert told["Author"] and told["Keywords"] and len(told.get_all("Classifier")) > 10
    assert f"Homepage, {ADDRESS}" in told.get_all("Project-URL")
    assert any(name.endswith("licenses/LICENSE") for name in names)


@pytest.mark.slow
def test_wheel_works_where_it_is_installed(wheel, tmp_path):
    """Installed in a folder of its own, it colours the sample."""
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "-q", "--target", tmp_path, wheel]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    code = ("import MedColorLib\nfrom MedColorLib import Settings, colorize\nfrom MedColorLib.phantom import sample\n"
            "volume, picture = sample()\n"
            "result = colorize(volume, [picture], Settings(preset='draft', slices=(20, 22)))\n"
            "print(MedColorLib.__file__, result.rgb.any())")  # fmt: skip
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == [str(tmp_path / "MedColorLib" / "__init__.py"), "True"], done.stderr


def test_sdist_has_what_makes_the_wheel(tmp_path_factory):
    with tarfile.open(packaged(tmp_path_factory, "sdist")) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "README.md", "LICENSE", "MedColorLib/py.typed", "MedColorLib/features/weights.json",
            "MedColorLib/features/contrast_net.safetensors"} <= names  # fmt: skip


def test_every_python_has_one_pin_of_every_package():
    """Of what the tests need: `Testing/constraints.txt`, for each Python that the classifiers promise."""
    from packaging.requirements import Requirement

    toml = pytest.importorskip("tomllib" if sys.version_info >= (3, 11) else "tomli")
    project = toml.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / "Testing" / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [Requirement(line.partition("#")[0]) for line in lines if line.partition("#")[0].strip()]
    needed = [Requirement(text) for text in [*project["dependencies"], *project["optional-dependencies"]["test"]]]
    pythons = re.findall(r":: (3\.\d+)", "\n".join(project["classifiers"]))
    assert pythons[0] == project["requires-python"].strip(">=") and len(pythons) > 3

    def there(requirements: list, python: str) -> list:
        environment = {"python_version": python}
        return [one for one in requirements if one.marker is None or one.marker.evaluate(environment)]

    for python in pythons:
        pinned = {one.name.lower(): str(one.specifier) for one in there(pins, python)}
        assert len(pinned) == len(there(pins, python)), f"Python {python}: two pins of one package"
        for one in there(needed, python):
            version = pinned[one.name.lower()].partition("==")[2]
            assert one.specifier.contains(version), f"Python {python}: {one.name} {version} is not {one.specifier}"


def test_the_repository_has_one_address_and_one_version():
    texts = {name: (ROOT / name).read_text(encoding="utf-8")
             for name in ("CMakeLists.txt", "pyproject.toml", "CITATION.cff", "Resources/MedColor.json")}  # fmt: skip
    addresses = {
        name: set(re.findall(r"(?:github\.com|githubusercontent\.com)/(MedColor/\w+)", text))
        for name, text in texts.items()
    }
    assert all(found == {ADDRESS.partition(".com/")[2]} for found in addresses.values()), addresses
    assert json.loads(texts["Resources/MedColor.json"])["scm_url"] == f"{ADDRESS}.git"
    assert re.search(r"^version: (.*)$", texts["CITATION.cff"], re.M).group(1) == MedColorLib.__version__
    assert "version =" not in texts["pyproject.toml"].partition("[project.optional")[0]
    changes = (ROOT / "Resources" / "Documentation" / "changes.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changes, re.M).group(1) == MedColorLib.__version__


def test_citation_is_yaml_of_the_format():
    yaml = pytest.importorskip("yaml")
    data = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(data)
    assert data["repository-code"] == ADDRESS and find_spec("MedColorLib")
