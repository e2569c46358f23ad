"""Stage *features*: grey slices -> five maps of features, coarse layers for meaning, fine layers for detail.

| name | features | needs |
| --- | --- | --- |
| `embedded` | MedColor's own network, which does not see contrast (`contrast_net`) | nothing: the default |
| `vgg19` | VGG-19 relu1_1 ... relu5_1, luminance in all three planes (the paper, Liao et al. 2017) | weights |
| `gray-vgg19` | VGG-19 with batch normalisation trained on luminance (He et al. 2018) | weights |

`auto` takes `embedded`, which is nearer to the truth than VGG-19 on the benchmark and faster; with the preset `full`, the paper's
way, `vgg19` where its weights are found.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ..errors import SettingsError, WeightsError

if TYPE_CHECKING:
    from torch import Tensor

_DESCRIBED_TOGETHER = 16  # pictures that go through the network at once

EXTRACTORS = ("embedded", "vgg19", "gray-vgg19")

# How strongly body-relative position and grey join the features: (position, luminance); 1 counts as much as the features.
# The own features need no grey; how position joins them is in `matching.contrast_match`.
CONTEXT_WEIGHTS = {"vgg19": (0.5, 0.5), "gray-vgg19": (0.5, 0.5)}

OWN_WEIGHTS = Path(__file__).with_name("contrast_net.safetensors")
# Of the own features: what the coarsest level says of the place in the body is left out, so that hue follows tissue.
OWN_CONTEXT = 0.0


class Extractor(Protocol):
    """What a feature network offers.

    Attributes:
        name: one of EXTRACTORS.
    """

    name: str

    def extract(self, luminance: Tensor, layers: Sequence[int]) -> dict[int, Tensor]:
        """(N, 1, H, W) float32 display grey 0..1, H and W multiples of 16 -> layer l: (N, C, H / 2^(l-1), W / 2^(l-1)).

        Only the layers asked for (1 finest .. 5 coarsest) are returned, and nothing deeper is computed.
        """
        ...

    def descriptor(self, luminance: Tensor) -> Tensor:
        """(N, 1, H, W) -> (N, D): one vector per slice for the recommendation of references."""
        ...

    def provenance(self) -> dict:
        """What the features depend on beside the picture, JSON-ready: hashes of weights, settings; for features that are kept."""
        ...


def choose_features(name: str, preset: str = "balanced") -> str:
    """Resolve `auto`; check that a named network exists.

    Args:
        preset: `full`, the paper's way, takes the paper's network for `auto` where its weights are found.

    Raises:
        SettingsError: unknown name.
        WeightsError: the network was asked for by name and its weights are not here.
    """
    if name not in ("auto", *EXTRACTORS):
        raise SettingsError(f"features: {name!r} is not one of auto, {', '.join(EXTRACTORS)}")
    if name == "embedded" or (name == "auto" and preset != "full"):
        return "embedded"
    from .weights import find_weights

    if name == "auto":
        return "vgg19" if find_weights("vgg19") is not None else "embedded"
    if find_weights(name) is None:
        raise WeightsError(
            f"features {name}: no weights found; run 'medcolor weights fetch {name}', set MEDCOLOR_WEIGHTS to a file or "
            "folder that holds them, or use --features embedded"
        )
    return name


def make_extractor(name: str, device: str = "cpu") -> Extractor:
    """Build the extractor `name` (already resolved by `choose_features`) on a torch device."""
    if name == "embedded":
        from .contrast_net import Contrast

        return Contrast(device)
    from .weights import find_weights, load_weights

    found = find_weights(name)
    if found is None:
        raise WeightsError(f"features {name}: the weights disappeared; run 'medcolor weights fetch {name}'")
    weights = load_weights(found.path)
    if name == "vgg19":
        from .vgg19 import VGG19

        return VGG19(weights, device=device)
    from .gray_vgg19 import GrayVGG19

    return GrayVGG19(weights, device=device)


@functools.lru_cache(maxsize=1)
def own_weights_sha256() -> str:
    """Hash of the own features' weights.

    Raises:
        WeightsError: they cannot be read.
    """
    try:
        return hashlib.sha256(OWN_WEIGHTS.read_bytes()).hexdigest()
    except OSError as error:
        raise WeightsError(
            f"{OWN_WEIGHTS.name}: the weights of the own features cannot be read ({error.strerror}); install MedColor anew"
        ) from error


def unit_descriptors(extractor: Extractor, greys: Iterable[np.ndarray], device: str = "cpu") -> np.ndarray:
    """Describe pictures for comparison by scalar product, which is then the cosine similarity.

    Args:
        greys: n planes (H, W), display grey 0..1, on one grid; taken a few at a time.

    Returns:
        (n, D) float32, rows of length 1 (0 for a picture without any feature).
    """
    import torch

    rows, remaining = [], iter(greys)
    while planes := list(itertools.islice(remaining, _DESCRIBED_TOGETHER)):
        luminance = torch.from_numpy(np.stack(planes))[:, None].to(device)
        rows.append(extractor.descriptor(luminance).float().cpu().numpy())
    return unit_rows(np.concatenate(rows))


def unit_rows(table: np.ndarray) -> np.ndarray:
    """(n, D) rows scaled to length 1, float32; a row of zeros stays one."""
    table = table.astype(np.float32)
    return table / np.maximum(np.linalg.norm(table, axis=1, keepdims=True), 1e-12)
