"""The module against Slicer's real MRML (and PySide6 for the panel), each file of cases in a process of its own.

The displayable manager factory and `slicer.mrmlScene` are one per process, and importing Slicer's package must not
touch the other tests. What failed is in the output of the inner run.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

HOST = Path(__file__).resolve().parents[1] / "SlicerHost"
# PySide6-Essentials 6.8.3: later ones (seen: 6.12.0) lose references to None and end Python before 3.12 with an abort.
PANEL = (
    "cases_panel.py",
    "cases_panel_anything.py",
    "cases_panel_bad_input.py",
    "cases_panel_choices.py",
    "cases_panel_display.py",
    "cases_panel_live.py",
    "cases_panel_reload.py",
    "cases_panel_running.py",
    "cases_panel_scene.py",
    "cases_panel_smoother.py",
)
NEEDS = dict.fromkeys(PANEL, ("slicer_core", "PySide6"))
ORIGINAL = "MEDCOLOR_SLICER_PYTHON"


def missing_packages(names) -> list[str]:
    return [name for name in names if importlib.util.find_spec(name) is None]


def run_cases(name: str, **environment: str) -> subprocess.CompletedProcess:
    plugins = ["-p", "host_fixtures", "-p", "panel_fixtures", "-p", "no:cacheprovider"]
    command = [sys.executable, "-m", "pytest", *plugins, str(HOST / name)]
    paths = [str(HOST), os.environ.get("PYTHONPATH", "")]
    return subprocess.run(
        [*command, "-q", "-m", ""],
        env={
            **{k: v for k, v in os.environ.items() if k != ORIGINAL},
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            **environment,
        },
        cwd=HOST.parents[1],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


QUICK = ("cases_dependencies.py", "cases_scene.py")
CASES = [
    pytest.param(path.name, marks=[] if path.name in QUICK else [pytest.mark.slow])
    for path in sorted(HOST.glob("cases_*.py"))
]


@pytest.mark.parametrize("name", CASES)
def test_cases(name):
    lacking = missing_packages(NEEDS.get(name, ("slicer_core",)))
    if lacking:
        pytest.skip(f"not installed: {', '.join(lacking)}")
    done = run_cases(name)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]


@pytest.mark.slow
@pytest.mark.parametrize("name", PANEL)
def test_panel_with_parameter_nodes_of_an_installed_slicer(name):
    """Slicer's own parameterNodeWrapper in place of the host's small one."""
    folder = os.environ.get(ORIGINAL)
    if not folder:
        pytest.skip(f"{ORIGINAL} does not name the Python folder of an installed Slicer (bin/Python)")
    done = run_cases(name, **{ORIGINAL: folder})
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-3000:]
