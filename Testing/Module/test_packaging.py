"""The extension configures, registers its tests and installs complete, with a stub in Slicer's place."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
STUB = REPOSITORY / "Testing" / "SlicerHost" / "StubSlicer"
MODULES = Path("lib", "Slicer-0.0", "qt-scripted-modules")


def cmake_version() -> tuple[int, ...]:
    """Of the one that is installed; empty where there is none."""
    if shutil.which("cmake") is None:
        return ()
    said = subprocess.run(["cmake", "--version"], capture_output=True, text=True, check=True).stdout
    return tuple(map(int, re.search(r"(\d+)\.(\d+)", said).groups()))


pytestmark = pytest.mark.skipif(cmake_version() < (3, 20), reason="cmake 3.20 or later is not installed")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """(build folder, install folder) of the extension as an extension build makes them."""
    build, install = tmp_path_factory.mktemp("build"), tmp_path_factory.mktemp("install")
    for command in (
        ["cmake", "-S", REPOSITORY, "-B", build, f"-DSlicer_DIR={STUB}", "-DBUILD_TESTING=ON", "-Wno-dev"],
        ["cmake", "--install", build, "--prefix", install],
    ):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    return build, install / MODULES


def files_below(folder: Path, *endings: str) -> set[str]:
    found = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return {name for name in found if name.endswith(endings) and "__pycache__" not in name}


def test_library_is_installed_whole_beside_the_module(built):
    installed = files_below(built[1] / "MedColorLib", ".py", ".json", ".typed", ".safetensors")
    assert installed == files_below(REPOSITORY / "MedColorLib", ".py", ".json", ".typed", ".safetensors")


def test_module_is_installed_whole(built):
    expected = files_below(REPOSITORY / "MedColor", ".py", ".png", ".ui", "requirements.txt")
    installed = {name for name in files_below(built[1], ".py", ".png", ".ui", ".txt") if "MedColorLib/" not in name}
    assert installed == expected
    assert {"MedColor.py", "MedColorSlicer/logic.py", "Resources/UI/MedColor.ui", "Resources/requirements.txt",
            "Resources/Icons/MedColor.png"} <= installed  # fmt: skip


def test_no_data_or_tests_are_installed(built):
    names = files_below(built[1], "")
    assert not [name for name in names if name.startswith("Testing") or name.endswith((".npz", ".md"))]
    weights = [name.rpartition("/")[2] for name in names if name.endswith(".safetensors")]
    assert weights == ["contrast_net.safetensors"], "MedColor's own, and no other network's"


def test_installed_library_is_importable_on_its_own(built):
    code = "import MedColorLib, os; print(os.path.dirname(MedColorLib.__file__))"
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=built[1], env=clean, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).resolve() == (built[1] / "MedColorLib").resolve()


def test_ctest_runs_slicer_with_and_without_main_window(built):
    listing = subprocess.run(["ctest", "-N"], cwd=built[0], capture_output=True, text=True, check=True).stdout
    names = set(re.findall(r"Test +#\d+: (\S+)", listing))
    assert {"py_nomainwindow_run_in_slicer", "py_mainwindow_run_in_slicer", "py_nomainwindow_MedColor",
            "py_nomainwindow_qSlicerMedColorModuleGenericTest"} <= names  # fmt: skip
    script = (built[0] / "Testing" / "Slicer" / "CTestTestfile.cmake").read_text(encoding="utf-8")
    assert "--no-main-window" in script


def test_index_entry_agrees_with_cmake(built):
    entry = json.loads((REPOSITORY / "Resources" / "MedColor.json").read_text(encoding="utf-8"))
    allowed = {"$schema", "category", "scm_url", "scm_revision", "scm_type", "build_dependencies",
               "build_subdirectory", "enabled", "tier"}  # fmt: skip
    assert {"$schema", "category", "scm_url"} <= set(entry) <= allowed
    metadata = dict(line.split("=", 1) for line in (built[0] / "metadata.txt").read_text(encoding="utf-8").splitlines())
    assert metadata["HOMEPAGE"] == entry["scm_url"].removesuffix(".git")
    assert metadata["DEPENDS"].split() == (entry["build_dependencies"] or ["NA"])
    text = (REPOSITORY / "CMakeLists.txt").read_text(encoding="utf-8")
    assert re.search(r"^project\(MedColor\)$", text, re.MULTILINE), "the index compares this with MedColor.json"


def test_metadata_urls_name_files_of_the_repository(built):
    metadata = (built[0] / "metadata.txt").read_text(encoding="utf-8")
    urls = re.findall(r"https://raw\.githubusercontent\.com/[^/]+/[^/]+/main/(\S+)", metadata)
    assert urls
    missing = [name for name in urls if not (REPOSITORY / name).is_file()]
    assert not missing


def test_rules_of_the_extensions_index():
    """What the index's own checker greps, and what its reviewers ask of a description, JSON and README."""
    text = (REPOSITORY / "CMakeLists.txt").read_text(encoding="utf-8")
    for name in ("ICONURL", "SCREENSHOTURLS"):  # one quoted string in one set()
        assert len(re.findall(rf'set\(EXTENSION_{name} "[^"$]+"\)', text)) == 1 == text.count(f"EXTENSION_{name} "), (
            name
        )
    (description,) = re.findall(r'set\(EXTENSION_DESCRIPTION "(.*)"\)', text)
    assert 1 <= len(re.findall(r"\.(?: |$)", description)) <= 2
    licence = text.index("EXTENSION_LICENSE_FILE"), text.index("EXTENSION_README_FILE")
    assert max(licence) < text.index("include(${Slicer_USE_FILE})"), "else Slicer's own licence is packaged"
    raw = (REPOSITORY / "Resources" / "MedColor.json").read_bytes()
    assert b"\r" not in raw and raw.endswith(b"\n")
    entry = json.loads(raw)
    assert re.search(r"catalog-entry-schema-v1\.0\.[12]\.json", entry["$schema"]) and entry["scm_url"].endswith(".git")
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    assert readme.startswith("# MedColor") and "Apache-2.0" in readme and "Devkota" in readme
    assert re.search(r"!\[.*\]\(Resources/Screenshots/", readme)


def test_icon_has_the_size_the_index_asks_for():
    for icon in (REPOSITORY / "Resources/Icons/MedColor.png", REPOSITORY / "MedColor/Resources/Icons/MedColor.png"):
        header = icon.read_bytes()[:24]
        assert header[:8] == b"\x89PNG\r\n\x1a\n"
        assert (int.from_bytes(header[16:20], "big"), int.from_bytes(header[20:24], "big")) == (128, 128)


def test_stub_refuses_an_extension_without_license(tmp_path):
    """The stub can fail: without EXTENSION_LICENSE_FILE Slicer would silently package its own licence."""
    project = tmp_path / "CMakeLists.txt"
    project.write_text(
        "cmake_minimum_required(VERSION 3.20)\nproject(X NONE)\nfind_package(Slicer REQUIRED)\n"
        "include(${Slicer_USE_FILE})\n",
        encoding="utf-8",
    )
    command = ["cmake", "-S", tmp_path, "-B", tmp_path / "build", f"-DSlicer_DIR={STUB}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "EXTENSION_LICENSE_FILE" in done.stderr
