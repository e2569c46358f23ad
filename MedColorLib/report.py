"""The report: versions, machine, memory; written as JSON."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
from pathlib import Path

import numpy as np

from .output import atomic_output

_PACKAGES = (
    *("medcolor", "torch", "numpy", "scipy", "opencv-contrib-python-headless", "pillow", "SimpleITK", "pydicom"),
    *("tifffile", "vtk", "safetensors"),
)


def environment(device: str) -> dict:
    """Versions of what took part, and the machine by kind (never by name)."""
    from importlib.metadata import PackageNotFoundError, version

    import torch

    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "source checkout" if name == "medcolor" else "not installed"
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPU, {torch.get_num_threads()} threads"
    name = torch.cuda.get_device_name(device) if device.startswith("cuda") else device
    return {"versions": versions, "machine": machine, "device": name}


def voxels_sha256(array: np.ndarray) -> str:
    """SHA-256 (hex) of an array's values in C order and the machine's byte order, without a copy of the whole."""
    digest = hashlib.sha256()
    native = array.dtype.newbyteorder("=")
    for plane in array:
        digest.update(np.ascontiguousarray(plane, native).data)
    return digest.hexdigest()


def peak_memory_mb() -> float | None:
    """Largest resident memory of this process so far in MB; None where the platform does not tell."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1e6 if sys.platform == "darwin" else 1e3), 1)


def write_report(report: dict, path: str | Path) -> None:
    """Write the report as JSON; complete or not at all.

    Raises:
        OutputError: the folder is missing or cannot be written.
    """
    with atomic_output(path) as temporary:
        temporary.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
