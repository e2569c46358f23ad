"""Stage *recommend*: which references of a library look most like a volume (the paper, section 3.3).

Cosine similarity of one descriptor per picture: fc6 of VGG-19 where its weights are present, the embedded descriptor
otherwise. Pictures and slices are compared on the same raster, body outline on body outline. A library is described once;
the index in the cache knows files by size and time, descriptors by content.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .errors import Cancelled, InputError
from .grid import choose_grid, to_grid
from .volume import Volume

log = logging.getLogger("MedColor")

_GRID_PX = 256
_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


def recommend(
    volume: Volume,
    library: str | Path,
    top: int = 3,
    slice_index: int | None = None,
    features: str = "auto",
    device: str = "auto",
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> list[tuple[str, float]]:
    """The `top` references of a library for a volume, or for one of its slices.

    Args:
        volume: scalars (k, j, i).
        library: folder of colour pictures, searched with its subfolders. It is described once (0.1 to 1 s a picture).
        slice_index: transverse slice counted from the feet; None takes the mean over seven slices of the body.
        features: "auto", "vgg19", "gray-vgg19" or "embedded".
        progress, cancelled: as for `colorize`; cancelling keeps what has been described.

    Returns:
        (path, cosine similarity -1..1), best first.

    Raises:
        InputError: no usable picture in the folder, or no body in the volume or slice.
        Cancelled: `cancelled()` returned True.
    """
    from .device import choose_device
    from .features import choose_features, make_extractor

    extractor = make_extractor(choose_features(features), choose_device(device))
    queries = _unit(np.stack([_describe(extractor, grey) for grey in _slices(volume, slice_index)]))
    paths, descriptors = index_library(library, extractor, progress, cancelled)
    scores = (_unit(descriptors) @ queries.T).mean(axis=1)
    best = np.argsort(-scores, kind="stable")[:top]
    return [(str(paths[i]), float(scores[i])) for i in best]


def index_library(library, extractor, progress=None, cancelled=None) -> tuple[list[Path], np.ndarray]:
    """Describe what is new in a library; returns the usable pictures and their descriptors (n, D) float32.

    Pictures that cannot be used are left out and named in the log. One picture is in memory at a time.
    """
    folder = Path(library)
    if not folder.is_dir():
        raise InputError(f"library {folder}: no such folder; name a folder of colour pictures")
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in _SUFFIXES and p.is_file())
    if not files:
        raise InputError(f"library {folder.name}: holds no picture (PNG, JPEG or TIFF)")
    index = _Index(extractor)
    known: list[tuple[Path, str]] = []
    try:
        for number, path in enumerate(files):
            if cancelled is not None and cancelled():
                raise Cancelled
            if progress is not None:
                progress(number / len(files), f"reference {number + 1} of {len(files)}")
            key = index.key_of(path)
            if key is not None:
                known.append((path, key))
    finally:
        index.save()
    if not known:
        raise InputError(f"library {folder.name}: none of its {len(files)} pictures shows tissue on a plain background")
    return [path for path, _ in known], np.stack([index.descriptors[key] for _, key in known]).astype(np.float32)


class _Index:
    """Descriptors by content hash, in one safetensors file per network in the cache folder."""

    def __init__(self, extractor) -> None:
        from .features.weights import cache_folder

        provenance = getattr(extractor, "provenance", dict)()
        name = f"{extractor.name}-{provenance.get('sha256', 'none')[:12]}-{_GRID_PX}.safetensors"
        self._path = cache_folder() / "library" / name
        self._extractor = extractor
        self._changed = False
        self.descriptors: dict[str, np.ndarray] = {}
        self._files: dict[str, str] = {}
        self._load()

    def key_of(self, path: Path) -> str | None:
        """Content hash of a picture that is described; None when it cannot be used."""
        status = path.stat()
        stamp = f"{path.resolve()}|{status.st_size}|{status.st_mtime_ns}"
        if stamp not in self._files:
            self._changed = True
            content = hashlib.sha256(path.read_bytes()).hexdigest()
            if content not in self.descriptors:
                content = self._describe(path, content)
            self._files[stamp] = content
        return self._files[stamp] or None

    def save(self) -> None:
        """Write the index under a temporary name, then rename; nothing to do where nothing is new."""
        if not self._changed or not self.descriptors:
            return
        import os

        from safetensors.numpy import save_file

        keys = sorted(self.descriptors)
        temporary = self._path.with_suffix(f".{os.getpid()}.part")
        tensors = {"descriptors": np.stack([self.descriptors[k] for k in keys]).astype(np.float16)}
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            save_file(tensors, str(temporary), {"keys": json.dumps(keys), "files": json.dumps(self._files)})
            os.replace(temporary, self._path)
        except OSError as error:  # a cache that cannot be written costs time at the next call, not the answer
            log.warning("library index is not kept: %s", error.strerror)
        finally:
            if temporary.exists():
                temporary.unlink()

    def _load(self) -> None:
        from safetensors import SafetensorError, safe_open

        if not self._path.exists():
            return
        try:
            with safe_open(str(self._path), "numpy") as stored:
                metadata = stored.metadata()
                table = stored.get_tensor("descriptors")
            self.descriptors = dict(zip(json.loads(metadata["keys"]), table))
            self._files = json.loads(metadata["files"])
        except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
            log.warning("library index is damaged and made anew (%s)", error)

    def _describe(self, path: Path, content: str) -> str:
        from .reference import on_grid, prepare_reference, read_picture

        try:
            reference = prepare_reference(read_picture(str(path)), path.name)
        except InputError as error:
            log.warning("left out of the library: %s", error)
            return ""
        grey = on_grid(reference, choose_grid(_GRID_PX))[0]
        self.descriptors[content] = _describe(self._extractor, grey).astype(np.float16)
        return content


def _slices(volume: Volume, slice_index: int | None):
    """Grey slices on the grid: the one asked for, or seven of the body."""
    from .body import find_body
    from .intensity import apply_window, check_values, choose_window
    from .prepare import sample_slices
    from .slices import slice_order

    check_values(volume.array, volume.name)
    view = slice_order(volume.ijk_to_ras).view(volume.array)
    body = find_body(view)
    chosen = sample_slices(list(body.slices)) if slice_index is None else [slice_index]
    if slice_index is not None and slice_index not in body.slices:
        raise InputError(
            f"slice {slice_index}: no body there; body was found in {body.slices[0]}:{body.slices[-1] + 1}"
        )
    masks = np.stack([body.plane(k) > 0.5 for k in chosen])
    window = choose_window(view[chosen], masks if masks.any() else None, proposed=volume.window)
    grid = choose_grid(_GRID_PX)
    for k in chosen:
        j0, j1, i0, i1 = body.boxes[k]
        cover = body.plane(k)[j0:j1, i0:i1] > 0.5
        yield to_grid(apply_window(view[k, j0:j1, i0:i1], window) * cover, grid)


def _describe(extractor, grey: np.ndarray) -> np.ndarray:
    import torch

    return extractor.descriptor(torch.from_numpy(grey)[None, None])[0].float().cpu().numpy()


def _unit(rows: np.ndarray) -> np.ndarray:
    rows = rows.astype(np.float32)
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
