"""Stage *recommend*: which references of a library look most like a volume (the paper, section 3.3).

Cosine similarity of one descriptor per picture: the own features on a raster of 8 x 8, or fc6 of VGG-19 where that is asked
for. Pictures and slices are compared on the same raster, body outline on body outline. Photographs are kept face up
and face down, so each is described both ways and the likelier one counts. A library is described once; the index in the
cache knows files by size and time, descriptors by content.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..errors import Cancelled, InputError, SettingsError
from ..features import unit_descriptors
from ..references.library import library_folder, read_reference
from ..references.pictures import pictures_in
from ..scan.grid import choose_grid
from ..volume import Volume
from .orientation import turned

log = logging.getLogger("MedColorLib")

_GRID_PX = 256
# Left and right of a body differ little. A CT head against a library of itself, remapped and warped (41 pictures, 5 mm):
# mean error 2 mm; upside down and described one way only, 10 mm with fc6.
_WAYS = ("as it is", "upside down")


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
    """The `top` references of a library for a volume, or for one of its slices; for many questions see `Recommender`.

    Args:
        volume: scalars (k, j, i).
        library: folder of colour pictures, searched with its subfolders, or the name of a library (`library list`). It is
            described once (0.1 to 1 s a picture).
        slice_index: transverse slice counted from the feet; None takes the mean over seven slices of the body.
        features: "auto", "vgg19", "gray-vgg19" or "embedded".
        progress, cancelled: as for `colorize`; cancelling keeps what has been described.

    Returns:
        (path, cosine similarity -1..1), best first.

    Raises:
        SettingsError: `top` is below 1.
        InputError: no such library, no usable picture in it, or no body in the volume or slice.
        Cancelled: `cancelled()` returned True.
    """
    return Recommender(library, features, device).recommend(volume, top, slice_index, progress, cancelled)


class Recommender:
    """Answers many questions about one library: the network, the index and the last volume's body stay in memory.

    The first question loads the network, describes what is new in the library and finds the volume's body; the next ones
    cost one pass through the network. `look_again` takes up pictures that were added since.
    """

    def __init__(self, library: str | Path, features: str = "auto", device: str = "auto") -> None:
        """Args as for `recommend`.

        Raises:
            InputError: no such library.
            SettingsError, WeightsError, DeviceError: as for `colorize`.
        """
        from ..device import choose_device
        from ..features import choose_features

        self.library = library_folder(library)
        self._features, self._device = choose_features(features), choose_device(device)
        self._extractor = None
        self._paths: list[Path] = []
        self._descriptors: np.ndarray | None = None
        self._seen = None

    def recommend(
        self,
        volume: Volume,
        top: int = 3,
        slice_index: int | None = None,
        progress: Callable[[float, str], None] | None = None,
        cancelled: Callable[[], bool] | None = None,
    ) -> list[tuple[str, float]]:
        """See the function `recommend`."""
        if isinstance(top, bool) or not isinstance(top, int) or top < 1:
            raise SettingsError(f"recommend: expected a whole number of at least 1 to name, got {top!r}")
        greys = self._greys(volume, slice_index)
        if self._descriptors is None:
            self.look_again(progress, cancelled)
        queries = unit_descriptors(self._extractor, greys, self._device)
        # one picture lies one way for all slices of a volume
        scores = (self._descriptors @ queries.T).mean(axis=2).max(axis=1)
        best = np.argsort(-scores, kind="stable")[:top]
        return [(str(self._paths[i]), float(scores[i])) for i in best]

    def look_again(
        self,
        progress: Callable[[float, str], None] | None = None,
        cancelled: Callable[[], bool] | None = None,
    ) -> None:
        """Describe what is new in the library and forget what is gone."""
        from ..features import make_extractor

        if self._extractor is None:
            self._extractor = make_extractor(self._features, self._device)
        self._paths, self._descriptors = index_library(self.library, self._extractor, progress, cancelled, self._device)

    def _greys(self, volume: Volume, slice_index: int | None) -> list[np.ndarray]:
        """Grey slices on the grid: the one asked for, or seven of the body."""
        from ..scan.slices import sample_slices, slice_on_grid, window_of

        view, body = self._body_of(volume)
        if slice_index is not None and slice_index not in body.slices:
            found = f"{body.slices[0]}:{body.slices[-1] + 1}"
            raise InputError(f"slice {slice_index}: no body there; body was found in {found}")
        chosen = sample_slices(list(body.slices)) if slice_index is None else [slice_index]
        window = window_of(view, body, chosen, proposed=volume.window)
        return [slice_on_grid(view, body, window, choose_grid(_GRID_PX), k)[0] for k in chosen]

    def _body_of(self, volume: Volume):
        from ..scan.body import find_body
        from ..scan.intensity import check_values
        from ..scan.planes import planes_of
        from ..scan.slices import slice_order

        if self._seen is None or self._seen[0] is not volume:
            check_values(volume.array, volume.name)
            order = slice_order(volume.ijk_to_ras)
            view = planes_of(order.view(volume.array))
            _, *pixel_mm = (float(volume.spacing_mm[2 - axis]) for axis in order.axes)
            self._seen = (volume, view, find_body(view, tuple(pixel_mm)))
        return self._seen[1:]


def index_library(
    library: str | Path,
    extractor,
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    device: str = "cpu",
) -> tuple[list[Path], np.ndarray]:
    """Describe what is new in a library; returns the usable pictures and their unit descriptors (n, 2, D) float32.

    The two descriptors of a picture are as it is and upside down. Pictures that cannot be used are left out and named in
    the log. One picture is in memory at a time.
    """
    folder = library_folder(library)
    files = sorted(pictures_in(folder, below=True))
    if not files:
        raise InputError(f"library {folder.name}: holds no picture (PNG, JPEG, TIFF ...)")
    index = _Index(extractor, device)
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

    def __init__(self, extractor, device: str) -> None:
        from ..features.weights import cache_folder

        provenance = getattr(extractor, "provenance", dict)()
        name = f"{extractor.name}-{provenance.get('sha256', 'none')[:12]}-{_GRID_PX}x{len(_WAYS)}.safetensors"
        self._path = cache_folder() / "library" / name
        self._extractor, self._device = extractor, device
        self._changed = False
        self.descriptors: dict[str, np.ndarray] = {}
        self._files: dict[str, str] = {}
        self._load()

    def key_of(self, path: Path) -> str | None:
        """Content hash of a picture that is described; None when it cannot be used."""
        try:
            status = path.stat()
            stamp = f"{path.resolve()}|{status.st_size}|{status.st_mtime_ns}"
            if stamp not in self._files:
                content = hashlib.sha256(path.read_bytes()).hexdigest()
                self._changed = True
                self._files[stamp] = content if content in self.descriptors else self._describe(path, content)
        except OSError as error:
            log.warning("left out of the library: %s: cannot be read (%s)", path.name, error.strerror)
            return None
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
        from ..references.photograph import on_grid

        try:
            reference = read_reference(path)
        except InputError as error:
            log.warning("left out of the library: %s", error)
            return ""
        grey = on_grid(reference, choose_grid(_GRID_PX))[0]
        ways = (turned(grey, way) for way in _WAYS)
        self.descriptors[content] = unit_descriptors(self._extractor, ways, self._device).astype(np.float16)
        return content
