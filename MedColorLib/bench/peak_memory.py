"""Largest memory of a process that colours a volume made by formula; run as a process of its own:

    python -m MedColorLib.bench.peak_memory SLICES SIDE

Prints JSON: peak, input and output in MB, and what the process holds beyond input and output.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from ..errors import MedColorError
from ..volume import Volume

_ANATOMY_SLICES = 25
_SPACING_MM = (2.0, 2.0, 2.0)
_LIMIT_S = 3600
_RETURNED_FROM = (
    1 << 16
)  # bytes: larger blocks go back to the system when freed (glibc), so that only what is used counts


def peak_of(slices: int, side: int) -> dict[str, float]:
    """Colour a volume in a new process and say what it held at most.

    Returns:
        "peak_mb", "input_mb", "output_mb", "beyond_mb" (peak less input and output).

    Raises:
        MedColorError: the process failed, or the platform does not tell its largest memory.
    """
    root = Path(__file__).resolve().parents[2]
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": str(_RETURNED_FROM), "MALLOC_ARENA_MAX": "1"}
    command = [sys.executable, "-m", "MedColorLib.bench.peak_memory", str(slices), str(side)]
    options = {"capture_output": True, "text": True, "timeout": _LIMIT_S, "cwd": root, "env": environment}
    try:
        done = subprocess.run(command, **options, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        raise MedColorError(f"memory of {slices} slices: the process cannot be run ({error})") from error
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise MedColorError(f"memory of {slices} slices: the process failed ({reason})")
    return json.loads(done.stdout)


def tall_phantom(slices: int, side: int) -> Volume:
    """A head stretched to any number of slices, 2 mm apart: (slices, side, side) int16 HU, no two slices alike.

    It is filled slice by slice, so that making it takes little more memory than it has.
    """
    from ..phantom import TISSUES, labels

    anatomy = labels((_ANATOMY_SLICES, side, side))
    table = np.array([hounsfield for hounsfield, _, _ in TISSUES.values()], np.float32)
    rng = np.random.default_rng(0)
    array = np.empty((slices, side, side), np.int16)
    for k in range(slices):
        level = k * _ANATOMY_SLICES // slices
        array[k] = np.rint(table[anatomy[level]] + rng.normal(0, 12, (side, side)))
    return Volume(array, np.diag([*_SPACING_MM, 1.0]), name=f"phantom of {slices} slices")


def _peak_mb() -> float:
    """Largest resident memory of this process: not of the one it was forked from, which getrusage counts, too, on Linux."""
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) * 1024 / 1e6
    from ..report import peak_memory_mb

    peak = peak_memory_mb()
    if peak is None:
        raise MedColorError("memory: this platform does not tell the largest memory of a process")
    return peak


def main(slices: int, side: int) -> dict[str, float]:
    """Colour in this process; see `peak_of`."""
    from ..parameters import Settings
    from ..phantom import section
    from ..pipeline import colorize

    volume = tall_phantom(slices, side)
    result = colorize(volume, [section()], Settings(preset="draft", features="embedded"))
    peak, given, made = _peak_mb(), volume.array.nbytes / 1e6, result.rgb.nbytes / 1e6
    return {"peak_mb": peak, "input_mb": given, "output_mb": made, "beyond_mb": peak - given - made}


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]), int(sys.argv[2]))))
