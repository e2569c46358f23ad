"""Network weights on this machine: found, recognised, converted once, read tensor by tensor.

Looked for in `MEDCOLOR_WEIGHTS` (a file or a folder), then in the cache folder that the platform prescribes. A
safetensors file is used where it lies, quantised or not; any other is converted once into the cache, under the hash of
its content, so that no pickle is read twice. `weights.json` says where the files come from.
"""

from __future__ import annotations

import functools
import json
import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Callable

from ..errors import SettingsError, WeightsError
from .architectures import ARCHITECTURES, identify
from .checkpoints import is_safetensors, open_checkpoint
from .download import download, sha256_of
from .network_weights import NetworkWeights, convert_weights

_logger = logging.getLogger("MedColorLib")
_SUFFIXES = (".safetensors", ".pth", ".pt", ".npz", ".caffemodel")  # which files of a folder are worth opening


@dataclass(frozen=True)
class WeightsFile:
    """A file known to hold a network.

    Attributes:
        path: the file to hand to `load_weights`.
        network: "vgg19" or "gray-vgg19".
        source: the convention of its tensors' names, for reports.
        preprocessing: see `architectures.Identity`.
        has_descriptor: fc6 is in the file.
    """

    path: Path
    network: str
    source: str
    preprocessing: str
    has_descriptor: bool


def cache_folder() -> Path:
    """Return where MedColor keeps weights: the platform's cache folder for `MedColor`, subfolder `weights`."""
    from platformdirs import user_cache_path

    return user_cache_path("MedColor", appauthor=False) / "weights"


def manifest() -> dict[str, dict]:
    """Return `weights.json`: url, size, SHA-256, licence and citation of each network's weights."""
    return json.loads(Path(__file__).with_name("weights.json").read_text(encoding="utf-8"))


def find_weights(network: str = "vgg19") -> WeightsFile | None:
    """Find the weights of a network: `MEDCOLOR_WEIGHTS` first, then the cache folder.

    A file that `MEDCOLOR_WEIGHTS` names must be good; in a folder, files that are not are passed over with a warning.

    Args:
        network: "vgg19" or "gray-vgg19".

    Returns:
        The first file found, or None.

    Raises:
        SettingsError: no such network.
        WeightsError: `MEDCOLOR_WEIGHTS` names something missing, damaged or of another kind.
    """
    if network not in ARCHITECTURES:
        raise SettingsError(f"network {network!r} is not one of {', '.join(ARCHITECTURES)}")
    for path, named_by_user in _candidates():
        try:
            found = inspect_weights(path)
        except WeightsError as error:
            if named_by_user:
                raise
            _logger.warning("passed over: %s", error)
            continue
        if found.network == network:
            return found
    return None


def _candidates() -> Iterator[tuple[Path, bool]]:
    named = os.environ.get("MEDCOLOR_WEIGHTS", "").strip()
    if named:
        path = Path(named).expanduser()
        if path.is_dir():
            yield from ((file, False) for file in _files_in(path))
        elif path.exists():
            yield path, True
        else:
            raise WeightsError(f"MEDCOLOR_WEIGHTS names {named}, which does not exist; correct it or unset it")
    yield from ((file, False) for file in _files_in(cache_folder()))


def _files_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    files = [file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES and file.is_file()]
    return sorted(files, key=lambda file: (file.suffix.lower() != ".safetensors", file.name))  # the quick ones first


def inspect_weights(path: Path) -> WeightsFile:
    """Tell what a file of weights holds, without loading it.

    Raises:
        WeightsError: it cannot be read, is damaged, or holds no network known here; the message says what was found.
    """
    checkpoint = open_checkpoint(_conversion_of(path) or Path(path))
    identity = identify(checkpoint)
    has_descriptor = "fc6.weight" in identity.names
    return WeightsFile(Path(path), identity.network, identity.source, identity.preprocessing, has_descriptor)


def _conversion_of(path: Path) -> Path | None:
    """Return the safetensors file made from another file in an earlier run, if there is one."""
    folder = cache_folder() / "converted"
    try:
        state = Path(path).stat()
        if is_safetensors(path) or not folder.is_dir():
            return None
        digest = _digest(Path(path), state.st_size, state.st_mtime_ns)
    except OSError as error:
        raise WeightsError(f"weights {path}: {error.strerror}; point MEDCOLOR_WEIGHTS to a readable file") from error
    return next((file for file in sorted(folder.glob(f"*-{digest[:16]}.safetensors")) if _whole(file)), None)


def _whole(ours: Path) -> bool:
    """Tell whether a file that MedColor made is still good, and delete it otherwise: it can be made again."""
    try:
        identify(open_checkpoint(ours))
    except WeightsError as error:
        _logger.warning("made again: %s", error)
        ours.unlink()
        return False
    return True


@functools.lru_cache(maxsize=32)  # size and time are in the key: a changed file is hashed anew
def _digest(path: Path, size: int, modified_ns: int) -> str:
    return sha256_of(path)


def load_weights(path: Path) -> NetworkWeights:
    """Open a file of weights, converting it into the cache if it is not safetensors already.

    Args:
        path: a file as `find_weights` returns it, or any other of the known kinds.

    Raises:
        WeightsError: unreadable, damaged, of another network, incomplete, not finite, or no room for the conversion.
    """
    checkpoint = open_checkpoint(_conversion_of(path) or Path(path))
    if checkpoint.container != "safetensors":
        checkpoint = open_checkpoint(convert_weights(checkpoint, cache_folder() / "converted"))
    return NetworkWeights(checkpoint, identify(checkpoint))


def fetch_weights(
    network: str = "vgg19",
    progress: Callable[[int, int], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
    url: str | None = None,
    destination: Path | None = None,
) -> Path:
    """Download a network's weights, check them, and convert them for use; a broken download is taken up again.

    Args:
        network: "vgg19" or "gray-vgg19".
        progress: called with (bytes present, bytes expected).
        cancelled: asked now and then; True stops, keeping what has come for the next call.
        url: a mirror of the same file, http or https. Size and SHA-256 must be those of `weights.json` all the same.
        destination: folder, by default the cache folder.

    Returns:
        The safetensors file, in `destination`.

    Raises:
        SettingsError: no such network, or a url that is neither http nor https.
        WeightsError: not downloadable, offline, refused by the server, of another size or hash, disk full.
        Cancelled: `cancelled()` returned True.
    """
    if network not in ARCHITECTURES:
        raise SettingsError(f"network {network!r} is not one of {', '.join(ARCHITECTURES)}")
    entry = manifest()[network]
    if not (url or entry["url"]) or not entry["sha256"]:
        raise WeightsError(f"{network}: {entry['note']}")
    folder = Path(destination) if destination is not None else cache_folder()
    ready = folder / f"{network}-{entry['sha256'][:16]}.safetensors"
    if ready.exists() and _whole(ready):
        return ready
    source = folder / entry["file"]
    fetched = not source.exists()  # else a user put it there, or an earlier conversion found the disk full
    if fetched:
        expected = {"size": entry["bytes"], "sha256": entry["sha256"]}
        download(url or entry["url"], source, **expected, progress=progress, cancelled=cancelled)
    ready = convert_weights(open_checkpoint(source), folder)
    if fetched:
        source.unlink()
    else:
        _logger.info("%s was there before and stays; it is no longer needed", source)
    return ready


def weights_status() -> list[dict]:
    """Return, for each network, what is present and where the rest comes from (plain data, JSON-ready)."""
    rows = []
    for network, entry in manifest().items():
        row = {"network": network, "present": False, "path": None, "problem": None}
        try:
            found = find_weights(network)
        except WeightsError as error:
            found, row["problem"] = None, str(error)
        if found:
            row.update(present=True, path=str(found.path), source=found.source, preprocessing=found.preprocessing)
            row.update(has_descriptor=found.has_descriptor, bytes_on_disk=found.path.stat().st_size)
        row["cache_folder"] = str(cache_folder())
        rows.append(
            {**row, **{key: entry[key] for key in ("title", "url", "bytes", "sha256", "licence", "citation", "note")}}
        )
    return rows
