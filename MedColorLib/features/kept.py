"""Features of references kept on disk by content: the next run with the same picture and network reads them.

One safetensors file per reference in `features/` of the platform's cache folder for MedColor. Its name is a SHA-256 over the
grey picture on the raster, the network with the hash of its weights and its number type, the layers, versions, machine and number
of threads: what is read has the same bytes as what would be computed. MedColor's own features are not kept: a picture of
256 x 256 takes them 20 ms. Layers 5 to 3 of VGG-19 take 0.20 s to make, 10 ms to hash and read 6.8 MB.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import platform
import re
import secrets
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from . import Extractor

log = logging.getLogger("MedColorLib")

_NAME = re.compile(r"[0-9a-f]{64}\.safetensors")
MOST_BYTES = 500_000_000  # of all references together; those not read for the longest time are deleted first


def reference_features(
    extractor: Extractor, luminance: Tensor, layers: Sequence[int]
) -> tuple[dict[int, Tensor], bool]:
    """Features of a reference (1, 1, H, W), and whether they were read instead of made.

    A folder that cannot be written, or a damaged file, costs the time of making them and a line in the log.
    """
    if extractor.name == "embedded":
        return extractor.extract(luminance, layers), False
    path = kept_folder() / f"{_key(extractor, luminance, layers)}.safetensors"
    kept = _read(path, luminance.device, layers)
    if kept is not None:
        return kept, True
    made = {layer: values.contiguous() for layer, values in extractor.extract(luminance, layers).items()}
    _keep(path, made)
    return made, False


def kept_folder() -> Path:
    """Where features are kept: beside the weights in the platform's cache folder."""
    from .weights import cache_folder

    return cache_folder().parent / "features"


def _key(extractor: Extractor, luminance: Tensor, layers: Sequence[int]) -> str:
    import torch

    device = luminance.device
    processor = torch.cuda.get_device_name(device) if device.type == "cuda" else torch.backends.cpu.get_cpu_capability()
    what = {
        "picture": [hashlib.sha256(luminance.cpu().numpy().tobytes()).hexdigest(), list(luminance.shape)],
        "network": extractor.provenance(),
        "layers": sorted(layers),
        "code": [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(Path(__file__).parent.glob("*.py"))],
        "machine": [torch.__version__, platform.machine(), str(device), processor, torch.get_num_threads()],
    }
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


def _read(path: Path, device, layers: Sequence[int]) -> dict[int, Tensor] | None:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not path.is_file():
        return None
    try:
        kept = load_file(str(path))
        found = {layer: kept[str(layer)].to(device) for layer in layers}
        os.utime(path)  # read now: the last to be deleted
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        log.warning("features of a reference are made anew: what was kept is damaged (%s)", type(error).__name__)
        return None
    return found


def _keep(path: Path, features: dict[int, Tensor]) -> None:
    from safetensors.torch import save

    data = save({str(layer): values.cpu().contiguous() for layer, values in features.items()})
    if len(data) > MOST_BYTES:
        return
    partial = path.with_name(f".{secrets.token_hex(4)}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _make_room(path.parent, len(data))
        partial.write_bytes(data)
        os.replace(partial, path)
    except OSError as error:
        log.info("features of a reference are not kept: %s", error.strerror)
    finally:
        with contextlib.suppress(OSError):  # most often because it is not there
            partial.unlink()


def _make_room(folder: Path, needed: int) -> None:
    """Delete files that bear the names of kept features, those read longest ago first; others and links stay."""
    kept = [file for file in folder.iterdir() if _NAME.fullmatch(file.name) and not file.is_symlink()]
    files = sorted((file.stat().st_mtime, file.stat().st_size, file) for file in kept if file.is_file())
    total = needed + sum(size for _, size, _ in files)
    for _, size, file in files:
        if total <= MOST_BYTES:
            return
        file.unlink()
        total -= size
