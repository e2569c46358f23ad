"""Which tensors the two networks consist of, and under which names the world's files hold them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from ..errors import WeightsError
from .checkpoints import REMEDY, Checkpoint

PREPROCESSINGS = ("oxford", "torchvision", "gray")
POOL5_SIDE = 7  # of a 224 x 224 picture, for which fc6 was trained


@dataclass(frozen=True)
class Architecture:
    """VGG-19's layout (Simonyan and Zisserman 2014, configuration E) up to fc6.

    Attributes:
        name: "vgg19" or "gray-vgg19".
        widths: channels of the five blocks. Narrow ones make small networks for tests.
        depths: 3 x 3 convolutions in each block.
        descriptor_width: outputs of fc6, 0 for a network that ends at pool5.
        batch_norm: every convolution, and the input, is followed by batch normalisation (He et al. 2018).
    """

    name: str
    widths: tuple[int, ...] = (64, 128, 256, 512, 512)
    depths: tuple[int, ...] = (2, 2, 4, 4, 4)
    descriptor_width: int = 4096
    batch_norm: bool = False

    def convolutions(self) -> dict[str, tuple[int, int]]:
        """Return (inputs, outputs) by name, conv1_1 to conv5_4, in the order of computation."""
        table, inputs = {}, 3
        for block, (width, depth) in enumerate(zip(self.widths, self.depths), start=1):
            for index in range(1, depth + 1):
                table[f"conv{block}_{index}"] = (inputs, width)
                inputs = width
        return table

    def required(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the tensors without which the network does not exist, by MedColor's names."""
        shapes: dict[str, tuple[int, ...]] = {}
        if self.batch_norm:
            shapes.update({"data_bn.running_mean": (3,), "data_bn.running_var": (3,)})
        for name, (inputs, outputs) in self.convolutions().items():
            shapes.update({f"{name}.weight": (outputs, inputs, 3, 3), f"{name}.bias": (outputs,)})
            if self.batch_norm:
                shapes.update({f"{name}_bn.running_mean": (outputs,), f"{name}_bn.running_var": (outputs,)})
        return shapes

    def optional(self) -> dict[str, tuple[int, ...]]:
        """Return the shapes of what a file may leave out: fc6, and the gain and shift of a batch normalisation."""
        shapes: dict[str, tuple[int, ...]] = {}
        if self.descriptor_width:
            inputs = self.widths[-1] * POOL5_SIDE**2
            shapes.update({"fc6.weight": (self.descriptor_width, inputs), "fc6.bias": (self.descriptor_width,)})
        if self.batch_norm:
            widths = {"data_bn": 3, **{f"{name}_bn": out for name, (_, out) in self.convolutions().items()}}
            for name, width in widths.items():
                shapes.update({f"{name}.weight": (width,), f"{name}.bias": (width,)})
        return shapes


ARCHITECTURES: dict[str, Architecture] = {
    "vgg19": Architecture("vgg19"),
    "gray-vgg19": Architecture("gray-vgg19", batch_norm=True, descriptor_width=0),
}


@dataclass(frozen=True)
class Identity:
    """What a file turned out to hold.

    Attributes:
        network: key of ARCHITECTURES.
        source: the convention of names, for reports.
        preprocessing: "oxford" (B, G, R in 0..255 minus means), "torchvision" (R, G, B in 0..1, mean and deviation of
            ImageNet) or "gray" (lightness in 0..255; the network's first batch normalisation does the rest).
        names: the file's name of each tensor, by MedColor's name; absent optional tensors are left out.
        quantised: tensors are uint8 with NAME.scale and NAME.min, w = min + scale * q.
    """

    network: str
    source: str
    preprocessing: str
    names: Mapping[str, str]
    quantised: bool = False


def _torchvision_names(architecture: Architecture) -> dict[str, str]:
    names, position = {}, 0
    previous = "1"
    for name in architecture.convolutions():
        position += name[4] != previous  # a pooling layer stands between blocks
        previous = name[4]
        for part in ("weight", "bias"):
            names[f"{name}.{part}"] = f"features.{position}.{part}"
        position += 2  # the convolution and its ReLU
    names.update({"fc6.weight": "classifier.0.weight", "fc6.bias": "classifier.0.bias"})
    return names


def _same_names(architecture: Architecture) -> dict[str, str]:
    return {name: name for name in (*architecture.required(), *architecture.optional())}


def _underscore_names(architecture: Architecture) -> dict[str, str]:
    short = {".weight": "_w", ".bias": "_b"}
    return {
        name: name.replace(long, short[long]) for name in _same_names(architecture) for long in short if long in name
    }


def _conventions(architecture: Architecture) -> list[tuple[str, str, dict[str, str]]]:
    if architecture.batch_norm:
        return [("gray VGG-19 with batch normalisation", "gray", _same_names(architecture))]
    return [
        ("Caffe names", "oxford", _same_names(architecture)),
        ("Caffe names, short", "oxford", _underscore_names(architecture)),
        ("torchvision", "torchvision", _torchvision_names(architecture)),
    ]


def identify(checkpoint: Checkpoint) -> Identity:
    """Recognise the network in a file by the names and shapes of its tensors.

    Raises:
        WeightsError: no known network, or one with tensors missing or of other shapes; the message lists them.
    """
    best: tuple[int, str] = (0, "")
    # The network with batch normalisation first: its file holds every name that plain VGG-19 needs as well.
    for architecture in sorted(ARCHITECTURES.values(), key=lambda one: not one.batch_norm):
        for source, preprocessing, names in _conventions(architecture):
            faults = _faults(checkpoint, architecture, names)
            if not faults:
                return _identity(checkpoint, architecture, source, preprocessing, names)
            present = sum(name in checkpoint.shapes for name in names.values())
            if present > best[0] and _is_candidate(checkpoint, architecture, names):
                best = (present, f"it resembles {architecture.name} ({source}), but {_listed(faults)}")
    found = ", ".join(f"{name} {shape}" for name, shape in list(checkpoint.shapes.items())[:3])
    raise WeightsError(
        f"{checkpoint.path.name}: not weights of VGG-19; "
        + (best[1] or f"expected conv1_1.weight (64, 3, 3, 3) and its like, found {found or 'no tensors'}")
        + f"; {REMEDY}"
    )


def _is_candidate(checkpoint: Checkpoint, architecture: Architecture, names: Mapping[str, str]) -> bool:
    required = architecture.required()
    return 2 * sum(names[name] in checkpoint.shapes for name in required) >= len(required)


def _faults(checkpoint: Checkpoint, architecture: Architecture, names: Mapping[str, str]) -> list[str]:
    faults = []
    required, optional = architecture.required(), architecture.optional()
    for name, shape in {**required, **optional}.items():
        found = checkpoint.shapes.get(names[name])
        if found is None and name in required:
            faults.append(f"{names[name]} {shape} is missing")
        elif found is not None and found != shape:
            faults.append(f"{names[name]} has shape {found} instead of {shape}")
    if not architecture.batch_norm:
        # Without its batch normalisation such a network computes something else, however well the rest fits.
        faults += [f"{name} belongs to another network" for name in checkpoint.shapes if name.endswith("running_mean")]
    if "fc6.weight" in names and (names["fc6.weight"] in checkpoint.shapes) != (names["fc6.bias"] in checkpoint.shapes):
        faults.append("fc6 lacks its weight or its bias")
    return faults


def _listed(faults: list[str]) -> str:
    return "; ".join(faults[:3]) + (f"; and {len(faults) - 3} more" if len(faults) > 3 else "")


def _identity(
    checkpoint: Checkpoint, architecture: Architecture, source: str, preprocessing: str, names: Mapping[str, str]
) -> Identity:
    shapes = checkpoint.shapes
    present = {name: stored for name, stored in names.items() if stored in shapes}
    quantised = f"{present['conv1_1.weight']}.scale" in shapes
    for stored in present.values() if quantised else ():
        if math.prod(shapes.get(f"{stored}.scale", (0,))) * math.prod(shapes.get(f"{stored}.min", (0,))) != 1:
            raise WeightsError(f"{checkpoint.path.name}: {stored} is quantised, but lacks its .scale or .min; {REMEDY}")
    # A file that MedColor converted says in its header what its names no longer show.
    preprocessing = checkpoint.metadata.get("medcolor_preprocessing", preprocessing)
    if preprocessing not in PREPROCESSINGS:
        raise WeightsError(f"{checkpoint.path.name}: unknown preprocessing {preprocessing!r}; {REMEDY}")
    source = checkpoint.metadata.get("medcolor_source", f"{source}, uint8" if quantised else source)
    return Identity(architecture.name, source, preprocessing, present, quantised)
