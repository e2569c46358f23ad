"""The tensors of one network as float32, read one by one from its file, and the conversion of a file to safetensors."""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import WeightsError
from .architectures import ARCHITECTURES, Identity, identify
from .checkpoints import REMEDY, Checkpoint
from .download import sha256_of

if TYPE_CHECKING:
    import torch

_logger = logging.getLogger("MedColorLib")
_BLOCK_ROWS = 256  # of fc6: 26 MB in float32, instead of 411 MB for the whole matrix


class NetworkWeights:
    """The tensors of one network, read from its file when asked for.

    Attributes:
        path: the safetensors file.
        network, source, preprocessing: see `WeightsFile`.
    """

    def __init__(self, checkpoint: Checkpoint, identity: Identity) -> None:
        self._checkpoint, self._identity = checkpoint, identity
        self._shapes = {**ARCHITECTURES[identity.network].required(), **ARCHITECTURES[identity.network].optional()}
        self.path = checkpoint.path
        self.network, self.source, self.preprocessing = identity.network, identity.source, identity.preprocessing

    def __contains__(self, name: str) -> bool:
        return name in self._identity.names

    @functools.cached_property
    def sha256(self) -> str:
        """Hash of the file that the weights came from, before any conversion (64 hexadecimal digits)."""
        return self._checkpoint.metadata.get("medcolor_source_sha256") or sha256_of(self.path)

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a tensor by MedColor's name, in the file or not."""
        return self._shapes[name]

    def tensor(self, name: str) -> torch.Tensor:
        """Return a tensor by MedColor's name (conv1_1.weight (O, I, 3, 3), conv1_1.bias (O,) ...) as float32.

        Raises:
            WeightsError: not in the file, of another type than its name promises, or not finite.
        """
        return self._rows(name, None).reshape(self._shapes[name])

    def row_blocks(self, name: str, rows: int = _BLOCK_ROWS) -> Iterator[tuple[int, torch.Tensor]]:
        """Yield (first row, float32 rows) of a matrix, so that fc6 never stands in memory as a whole.

        Raises:
            WeightsError: as for `tensor`.
        """
        for start in range(0, self._shapes[name][0], rows):
            yield start, self._rows(name, slice(start, start + rows))

    def stored_blocks(self, name: str, rows: int = _BLOCK_ROWS) -> Iterator[tuple[int, torch.Tensor]]:
        """As `row_blocks`, in the type of the file: the matrix is `scale * stored + low`, see `scaling`."""
        for start in range(0, self._shapes[name][0], rows):
            yield start, self._stored(name, slice(start, start + rows))

    def scaling(self, name: str) -> tuple[float, float]:
        """Return scale and low of a quantised tensor; (1, 0) for one that is stored as it is.

        Raises:
            WeightsError: not in the file, or not finite.
        """
        stored = self._name_in_file(name)
        if not self._identity.quantised:
            return 1.0, 0.0
        scale, low = (float(self._checkpoint.read(f"{stored}.{part}")) for part in ("scale", "min"))
        if not math.isfinite(scale) or not math.isfinite(low):
            raise WeightsError(f"{self.path.name}: {stored} holds NaN or infinite values; {REMEDY}")
        return scale, low

    def _name_in_file(self, name: str) -> str:
        if name not in self:
            raise WeightsError(f"{self.path.name}: has no {name}; {REMEDY}")
        return self._identity.names[name]

    def _rows(self, name: str, rows: slice | None) -> torch.Tensor:
        import torch

        scale, low = self.scaling(name)
        values = self._stored(name, rows).to(torch.float32)
        return values.mul_(scale).add_(low) if self._identity.quantised else values

    def _stored(self, name: str, rows: slice | None) -> torch.Tensor:
        """Rows in the type of the file, checked."""
        import torch

        stored = self._name_in_file(name)
        values = self._checkpoint.read(stored, rows)
        if self._identity.quantised:
            if values.dtype != torch.uint8:
                raise WeightsError(f"{self.path.name}: {stored} is {values.dtype} instead of uint8; {REMEDY}")
            return values
        if not values.is_floating_point():
            raise WeightsError(f"{self.path.name}: {stored} is {values.dtype} instead of floating point")
        values = values.to(torch.float32) if values.dtype == torch.float64 else values
        if not torch.isfinite(values).all():
            raise WeightsError(f"{self.path.name}: {stored} holds NaN or infinite values; {REMEDY}")
        return values


def convert_weights(checkpoint: Checkpoint, folder: Path) -> Path:
    """Write an opened file as safetensors under MedColor's names, or find the conversion made before.

    Convolutions become float32, fc6 float16 (its rounding, 5e-4, is below that of the 8-bit weights in use).

    Returns:
        `folder/NETWORK-HASH.safetensors`, HASH the first 16 digits of the source's SHA-256.

    Raises:
        WeightsError: wrong network, values that are not finite, or the folder cannot be written.
    """
    import torch

    identity = identify(checkpoint)
    digest = sha256_of(checkpoint.path)
    target = folder / f"{identity.network}-{digest[:16]}.safetensors"
    if target.exists():
        return target
    weights = NetworkWeights(checkpoint, identity)
    # Cloned, because in a strange file tensors may overlap, which save_file refuses.
    tensors = {name: weights.tensor(name).clone() for name in identity.names if name != "fc6.weight"}
    if "fc6.weight" in weights:
        tensors["fc6.weight"] = half = torch.empty(weights.shape("fc6.weight"), dtype=torch.float16)
        for start, rows in weights.row_blocks("fc6.weight"):
            half[start : start + len(rows)] = rows
        if not torch.isfinite(half).all():
            raise WeightsError(f"{checkpoint.path.name}: fc6.weight exceeds 65504, which VGG-19's never does; {REMEDY}")
    metadata = {
        "medcolor_source": f"{identity.source} ({checkpoint.container})",
        "medcolor_preprocessing": identity.preprocessing,
        "medcolor_source_sha256": digest,
    }
    _save(tensors, metadata, target)
    _logger.info("converted %s to %s", checkpoint.path.name, target.name)
    return target


def _save(tensors: dict[str, torch.Tensor], metadata: dict[str, str], target: Path) -> None:
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    partial = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        save_file(tensors, str(partial), metadata)
        os.replace(partial, target)
    except (OSError, SafetensorError) as error:
        raise WeightsError(
            f"{target.parent}: the converted weights cannot be written ({error}); make room there, or give a "
            "safetensors file by MEDCOLOR_WEIGHTS, which needs no conversion"
        ) from error
    finally:
        with contextlib.suppress(OSError):  # most often because it is not there
            partial.unlink()
