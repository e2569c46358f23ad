"""`Testing/Slicer/run_in_slicer.py` ends Slicer with the right status; Slicer and the module are stand-ins here."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "Slicer" / "run_in_slicer.py"
SLICER = """
import sys, types
def exit(status):
    print("EXIT", status, flush=True)
util = types.SimpleNamespace(EXIT_SUCCESS=0, EXIT_FAILURE=1, exit=exit, mainWindow=lambda: None)
app = types.SimpleNamespace(processEvents=lambda: None)
"""
MODULE = """
import sys, time, unittest
class MedColorTest(unittest.TestCase):
    def test_it(self):
        {body}
"""
BODIES = {
    "pass": ("pass", {}, 0, "1 tests, 0 failed, 0 skipped"),
    "failure": ("self.fail('odd')", {}, 1, "1 tests, 1 failed"),
    "error": ("1 / 0", {}, 1, "ZeroDivisionError"),
    "skip": ("self.skipTest('no view')", {}, 0, "test_it: no view"),
    "skip counts": ("self.skipTest('no view')", {"MEDCOLOR_SKIP_NOTHING": "1"}, 1, "1 skipped"),
    "slot": ("sys.excepthook(ValueError, ValueError('in a slot'), None)", {}, 1, "UNCAUGHT ValueError: in a slot"),
}


def run(tmp_path, module: str, **environment: str) -> subprocess.CompletedProcess:
    (tmp_path / "slicer.py").write_text(SLICER, encoding="utf-8")
    (tmp_path / "MedColor.py").write_text(module, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), **environment}
    return subprocess.run(
        [sys.executable, str(SCRIPT)], env=environment, capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.parametrize("case", BODIES)
def test_status_says_what_happened(tmp_path, case):
    body, environment, status, words = BODIES[case]
    done = run(tmp_path, MODULE.format(body=body), **environment)
    assert f"EXIT {status}" in done.stdout, done.stderr
    assert words in done.stdout + done.stderr


def test_module_that_cannot_be_imported_or_has_no_tests_is_a_failure(tmp_path):
    assert "EXIT 1" in run(tmp_path, "raise ImportError('broken')").stdout
    assert "EXIT 1" in run(tmp_path, "import unittest\nclass MedColorTest(unittest.TestCase):\n    pass").stdout


def test_what_hangs_is_ended_and_named(tmp_path):
    done = run(tmp_path, MODULE.format(body="time.sleep(50)"), MEDCOLOR_TIMEOUT="0.5")
    assert done.returncode == 1
    assert "test_it" in done.stderr
