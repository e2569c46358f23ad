"""Packages: asked first, by Slicer's mechanisms, and declining is harmless."""

from __future__ import annotations

import contextlib
import importlib.util
import subprocess
import sys
import types

import numpy as np
import pytest
import slicer


@pytest.fixture
def dependencies(host, monkeypatch):
    """The module with nothing missing, outside testing mode, and no way to reach a network by accident."""
    from MedColorSlicer import dependencies

    def forbidden(*_arguments, **_options):
        raise AssertionError("pip was called")

    monkeypatch.setattr(slicer.util, "pip_install", forbidden)
    for name in ("MessageDialog", "WaitCursor"):  # they need a screen
        monkeypatch.setattr(slicer.util, name, lambda *_arguments: contextlib.nullcontext(), raising=False)
    monkeypatch.setattr(slicer.app, "testingEnabled", lambda: False)
    monkeypatch.setattr(dependencies, "torch_missing", lambda: False)
    monkeypatch.setattr(dependencies, "missing", list)
    return dependencies


def without(monkeypatch, *names):
    """Modules of these names cannot be found."""
    real = importlib.util.find_spec

    def find_spec(name, package=None):
        return None if name.split(".")[0] in names or name in names else real(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    for name in names:
        monkeypatch.delitem(sys.modules, name, raising=False)


def test_nothing_missing_installs_nothing(dependencies):
    dependencies.ensure()


def test_requirements_name_neither_torch_nor_vtk(dependencies):
    lines = dependencies.requirements()
    assert len(lines) >= 3
    assert not [line for line in lines if line.startswith(("torch", "vtk"))]
    assert all(">=" in line and "==" not in line for line in lines), "minimum versions, not pins"


def test_missing_is_found_without_importing(host, monkeypatch):
    from MedColorSlicer import dependencies

    without(monkeypatch, "cv2", "safetensors")
    assert {line.split(">")[0] for line in dependencies.missing()} == {"opencv-contrib-python-headless", "safetensors"}
    assert "cv2" not in sys.modules


@pytest.mark.parametrize("agreed", [True, False])
def test_slicer_before_packaging(dependencies, monkeypatch, agreed):
    """Slicer 5.8 and 5.10: MedColor asks, then `slicer.util.pip_install`."""
    without(monkeypatch, "slicer.packaging")
    state = {"missing": ["scipy>=1.9"]}
    asked, installed = [], []
    monkeypatch.setattr(dependencies, "missing", lambda: state["missing"])
    monkeypatch.setattr(slicer.util, "confirmOkCancelDisplay", lambda text: asked.append(text) or agreed)

    def pip_install(arguments):
        *names, option, path = arguments
        installed.append(names)
        with open(path, encoding="utf-8") as stream:
            assert (option, stream.read()) == ("--constraint", f"numpy=={np.__version__}\n")
        state["missing"] = []

    monkeypatch.setattr(slicer.util, "pip_install", pip_install)
    if agreed:
        dependencies.ensure()
        assert installed == [["scipy>=1.9"]]
    else:
        with pytest.raises(dependencies.NotInstalled, match="Nothing was installed"):
            dependencies.ensure()
        assert not installed
    assert "scipy>=1.9" in asked[0]


def test_failed_installation_is_said(dependencies, monkeypatch):
    without(monkeypatch, "slicer.packaging")
    monkeypatch.setattr(dependencies, "missing", lambda: ["scipy>=1.9"])
    monkeypatch.setattr(slicer.util, "confirmOkCancelDisplay", lambda _text: True)
    monkeypatch.setattr(slicer.util, "pip_install", lambda _text: None)
    with pytest.raises(dependencies.NotInstalled, match="check the network"):
        dependencies.ensure()

    def fail(_text):
        raise subprocess.CalledProcessError(1, "pip")

    monkeypatch.setattr(slicer.util, "pip_install", fail)
    with pytest.raises(dependencies.NotInstalled, match="check the network"):
        dependencies.ensure()


@pytest.mark.parametrize("agreed", [True, False])
def test_slicer_with_packaging(dependencies, monkeypatch, agreed):
    """Slicer 5.12: `slicer.packaging.pip_ensure` asks by itself."""
    state = {"missing": ["scipy>=1.9", "safetensors"]}
    calls = []

    def pip_ensure(requirements, constraints=None, requester=None):
        with open(constraints, encoding="utf-8") as stream:
            calls.append((list(requirements), stream.read(), requester))
        if not agreed:
            raise RuntimeError("declined")
        state["missing"] = []

    packaging = types.ModuleType("slicer.packaging")
    packaging.__spec__ = types.SimpleNamespace(name="slicer.packaging")
    packaging.pip_ensure = pip_ensure
    monkeypatch.setitem(sys.modules, "slicer.packaging", packaging)
    monkeypatch.setattr(slicer, "packaging", packaging, raising=False)
    monkeypatch.setattr(dependencies, "missing", lambda: state["missing"])
    if agreed:
        dependencies.ensure()
    else:
        with pytest.raises(dependencies.NotInstalled, match="Nothing was installed"):
            dependencies.ensure()
    assert calls == [(["scipy>=1.9", "safetensors"], f"numpy=={np.__version__}\n", "MedColor")]


def test_torch_without_the_pytorch_extension(dependencies, monkeypatch):
    monkeypatch.setattr(dependencies, "torch_missing", lambda: True)
    monkeypatch.setitem(sys.modules, "PyTorchUtils", None)
    with pytest.raises(dependencies.NotInstalled, match="Extensions Manager"):
        dependencies.ensure()


@pytest.mark.parametrize("agreed", [True, False])
def test_torch_by_the_pytorch_extension(dependencies, monkeypatch, agreed):
    calls = []

    class PyTorchUtilsLogic:
        def installTorch(self, **options):
            calls.append(options)
            return object() if agreed else None

    utils = types.ModuleType("PyTorchUtils")
    utils.PyTorchUtilsLogic = PyTorchUtilsLogic
    monkeypatch.setitem(sys.modules, "PyTorchUtils", utils)
    monkeypatch.setattr(dependencies, "torch_missing", lambda: True)
    if agreed:
        dependencies.ensure()
    else:
        with pytest.raises(dependencies.NotInstalled, match="was not installed"):
            dependencies.ensure()
    assert calls[0]["askConfirmation"] is True


def test_nothing_is_installed_while_testing(dependencies, monkeypatch):
    monkeypatch.setattr(slicer.app, "testingEnabled", lambda: True)
    monkeypatch.setattr(dependencies, "missing", lambda: ["scipy>=1.9"])
    with pytest.raises(dependencies.NotInstalled, match="while testing"):
        dependencies.ensure()


def test_a_package_that_a_worker_is_just_importing_is_there(dependencies, monkeypatch):
    """OpenCV has no spec while it is imported, and Python's own question then raises."""
    half = types.ModuleType("cv2")
    half.__spec__ = None
    monkeypatch.setitem(sys.modules, "cv2", half)
    assert dependencies._is_there("cv2")
