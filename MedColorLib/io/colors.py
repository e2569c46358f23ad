"""Colour volumes in: RGB or RGBA of 8 bits as NRRD, NIfTI or MetaImage.

They are read by the readers of scans, not by ITK: damaged headers of MetaImage end its process, damaged packed voxels are
what its memory held, and it opens any file that a header names.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from .metaimage import read_meta_colors
from .nifti import load_nifti, nifti_array, nifti_matrix
from .nrrd import nrrd_array, nrrd_axes, nrrd_header, nrrd_matrix
from .voxel_data import check_size

_CHANNELS = (3, 4)


def read_colors(path: Path, max_bytes: int) -> tuple[np.ndarray, np.ndarray]:
    """(k, j, i, 3 or 4) uint8, and (4, 4) IJK to RAS.

    Raises:
        InputError: damaged, no such volume, or more than `max_bytes`; the reason alone.
    """
    name = path.name.lower()
    if name.endswith((".nrrd", ".nhdr")):
        return _of_nrrd(path, max_bytes)
    if name.endswith((".mha", ".mhd")):
        array, matrix = read_meta_colors(path, max_bytes, _checked)
        return array, matrix
    return _of_nifti(path, max_bytes)


def _checked(kind: str, shape: Sequence[int], channels: int) -> None:
    """Refuse what is no colour volume; `shape`: along i, j, k."""
    if kind == "uint8" and len(shape) == 3 and channels in _CHANNELS:
        return
    raise InputError(
        f"not a colour volume; expected three-dimensional RGB or RGBA of 8 bits, got {kind} of "
        f"{' x '.join(map(str, shape))} with {channels} component{'s' * (channels != 1)}"
    )


def _of_nrrd(path: Path, max_bytes: int) -> tuple[np.ndarray, np.ndarray]:
    header = nrrd_header(path)
    spatial, other = nrrd_axes(header)
    sizes = [int(size) for size in header["sizes"]]
    kind = {"uchar": "uint8", "unsigned char": "uint8", "uint8_t": "uint8"}.get(header["type"], header["type"])
    if len(other) > 1:
        _checked(kind, sizes, 1)
    _checked(kind, [sizes[axis] for axis in spatial], sizes[other[0]] if other else 1)
    array = np.moveaxis(nrrd_array(path, header, max_bytes), len(sizes) - 1 - other[0], -1)
    shape = [sizes[axis] for axis in reversed(spatial)]
    return array.reshape(*shape, sizes[other[0]]), nrrd_matrix(header, spatial, [])


def _of_nifti(path: Path, max_bytes: int) -> tuple[np.ndarray, np.ndarray]:
    image = load_nifti(path)
    dtype, shape = image.get_data_dtype(), image.shape
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if dtype.names:  # RGB24, RGBA32
        _checked("uint8" if dtype.itemsize == len(dtype.names) else str(dtype), shape, len(dtype.names))
        array = nifti_array(image, check_size(shape, dtype, max_bytes), path).reshape(shape[::-1])
        values = np.ascontiguousarray(array).view(np.uint8).reshape(*array.shape, len(dtype.names))
        return values, nifti_matrix(image, [])
    vector = len(shape) == 5 and shape[3] == 1
    _checked(dtype.name, shape[:3] if vector else shape, shape[4] if vector else 1)
    array = nifti_array(image, check_size(shape, dtype, max_bytes), path)
    return np.moveaxis(array.reshape(shape[4], *shape[2::-1]), 0, -1), nifti_matrix(image, [])
