"""What a user can choose, with ranges and defaults. One frozen dataclass; a wrong value raises with the remedy."""

from __future__ import annotations

import hashlib
import math
import operator
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from numbers import Real
from typing import Any, Literal, get_args

import numpy as np

from .errors import InputError, SettingsError
from .volume import Volume

# What type checkers and editors see of the choices; the tuples below are what is checked when a program runs.
PresetName = Literal["draft", "balanced", "full"]
FeaturesName = Literal["auto", "embedded", "vgg19", "gray-vgg19"]
SmootherName = Literal["auto", "regression", "fgs", "guided", "domain-transform", "wls"]
LuminanceName = Literal["natural", "keep", "paper"]
ReconstructionName = Literal["warp", "lbfgs"]
PlaneName = Literal["transverse", "acquired"]

FEATURES: tuple[str, ...] = get_args(FeaturesName)
AVERAGING = ("fgs", "domain-transform", "wls")  # weights of one sign: S(w d) / S(w) stays between the values of d
SMOOTHERS: tuple[str, ...] = get_args(SmootherName)
LUMINANCE: tuple[str, ...] = get_args(LuminanceName)
RECONSTRUCTIONS: tuple[str, ...] = get_args(ReconstructionName)
PLANES: tuple[str, ...] = get_args(PlaneName)


@dataclass(frozen=True)
class Preset:
    """How deep to go. `stop_layer`, `context` and `components` concern VGG-19: MedColor's own features have one layer.

    Attributes:
        grid_px: side of the raster on which slices are matched.
        stop_layer: last layer of the analogy, 5 (coarsest) to 1.
        smoother: what `smoother="auto"` means.
        context: whether body-relative position and grey join the features (they are not in the paper).
        gamma: what `gamma=None` means together with the paper's luminance; with the scan's own it is off
            (`Settings.resolved_gamma`).
        weighted: whether matches count by how far they can be trusted (they do not in the paper).
        components: principal components of the reference on which features of layers 4 and finer are compared; None
            compares whole features, as in the paper. Mean CIEDE2000 on 15 pairs: 1.906 with whole features, 1.903 with
            128, 1.901 with 96, 1.904 with 64, 1.932 with 32.
    """

    grid_px: int
    stop_layer: int
    smoother: str
    context: bool
    gamma: bool
    weighted: bool
    components: int | None


PRESETS: dict[str, Preset] = {
    "draft": Preset(160, 3, "regression", context=True, gamma=False, weighted=True, components=96),
    "balanced": Preset(256, 3, "regression", context=True, gamma=False, weighted=True, components=96),
    "full": Preset(256, 1, "fgs", context=False, gamma=True, weighted=False, components=None),
}


class BodyMask:
    """The body as the user gives it: a label volume in memory, not 0 where the body is.

    Attributes:
        labels: (k, j, i) in its place, or at the scan's where `placed` is False.
        placed: whether the place of the labels is known, so that it can be compared with the scan's.
    """

    def __init__(self, labels: Volume, placed: bool) -> None:
        self.labels, self.placed = labels, placed

    def __deepcopy__(self, memo) -> BodyMask:
        return self  # never altered

    def __str__(self) -> str:
        """Name and content, for reports."""
        digest = hashlib.sha256()
        for plane in self.labels.array:
            digest.update(np.ascontiguousarray(plane).data)
        return f"mask {self.labels.name}, SHA-256 {digest.hexdigest()}"


@dataclass(frozen=True)
class Settings:
    """Parameters of `colorize`.

    Attributes:
        preset: "draft", "balanced" or "full" (the paper's five layers).
        features: "auto" takes "embedded", MedColor's own network; with the preset "full", the paper's way, VGG-19 where its
            weights are found.
        smoother: "auto" takes the preset's; "regression" (colour as a function of luminance within a neighbourhood),
            "fgs" (the paper), "guided", "domain-transform", "wls".
        smoother_options: values of the smoother's own parameters by name, such as {"lam": 16.0, "iterations": 3}; None
            takes their defaults. Names, ranges and defaults: `filters.smoother_options(smoother)`.
        luminance: "natural" takes the reference's lightness for each tissue, with the scan's own detail on it; "keep" leaves the
            scan's own; "paper" lets the reference's through as the paper's equation does.
        lightness: 0..1, with natural luminance: from the scan's own lightness (0) to the reference's (1).
        gamma: colour transfer between gamma 1/2 and 2 (the paper, section 4.1); None takes the preset's, and only with the
            paper's luminance.
        window: (low, high) in the volume's units, or None for the file's window or robust percentiles.
        slices: (start, stop) of transverse slices to colour, counted from the feet; None for all. Others stay black.
        region: ((k0, k1), (j0, j1), (i0, i1)) voxels of the array to colour, stops not included; None for all. The rest
            stays black, but the whole slice takes part in the matching.
        body: "auto" finds the body; "all" takes all of the picture; else where the body is: a label volume on the scan's
            grid, not 0 there, as the path of a file, a `Volume` or an array (k, j, i) of whole numbers or bool.
        plane: "transverse", or "acquired" to take the array's first axis as the stack.
        device: "auto", "cpu", "cuda", "cuda:1", "mps".
        coherence_mm: neighbouring slices share their evidence of colour with a Gaussian of this width along the stack; 0
            colours each slice by itself. With the smoother "guided", and without weights (preset "full" but for its
            smoother "regression"), only near changes of reference.
        confidence: whether the result carries its confidence as a volume, too.
        seed: of the random search, 0 .. 2^63 - 1.
        reconstruction: how features come one layer down: "warp" (the reference's own finer features) or "lbfgs" (the
            deconvolution of Liao et al.).
        batch: slices that go through the network together.
        exposure: "auto" brings the tissue of the references to one brightness and neutral light, "off" leaves them; a number
            (0.1 to 10) is the gain in linear light.
        reference_masks: paths of pictures that say what is tissue in the references, one for each in their order ("auto" or
            None: found); for a folder a folder of masks. None: found in all.
    """

    preset: PresetName = "balanced"
    features: FeaturesName = "auto"
    smoother: SmootherName = "auto"
    smoother_options: dict | None = None
    luminance: LuminanceName = "natural"
    lightness: float = 0.85
    gamma: bool | None = None
    window: tuple[float, float] | None = None
    slices: tuple[int, int] | None = None
    region: tuple[tuple[int, int], tuple[int, int], tuple[int, int]] | None = None
    body: str | os.PathLike | np.ndarray | Volume | BodyMask = "auto"
    plane: PlaneName = "transverse"
    device: str = "auto"
    coherence_mm: float = 8.0
    confidence: bool = False
    seed: int = 0
    reconstruction: ReconstructionName = "warp"
    batch: int = 4
    exposure: Literal["auto", "off"] | float = "auto"
    reference_masks: tuple[str | None, ...] | None = None

    def __post_init__(self) -> None:
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        _one_of("preset", self.preset, tuple(PRESETS))
        _one_of("features", self.features, FEATURES)
        _one_of("smoother", self.smoother, SMOOTHERS)
        _one_of("luminance", self.luminance, LUMINANCE)
        _one_of("plane", self.plane, PLANES)
        _one_of("reconstruction", self.reconstruction, RECONSTRUCTIONS)
        _set(self, "body", _body(self.body))
        if not isinstance(self.device, str) or not self.device:
            raise SettingsError(f"device: expected a name such as auto, cpu or cuda, got {self.device!r}")
        if self.gamma is not None and not isinstance(self.gamma, bool):
            raise SettingsError(f"gamma: expected True, False or None (the preset's), got {self.gamma!r}")
        if not isinstance(self.confidence, bool):
            raise SettingsError(f"confidence: expected True or False, got {self.confidence!r}")
        if self.smoother_options is not None:
            _set(self, "smoother_options", _smoother_options(self))
        if self.window is not None:
            _set(self, "window", _window(self.window))
        if self.slices is not None:
            _set(self, "slices", _range(self.slices))
        if self.region is not None:
            _set(self, "region", _region(self.region))
        if isinstance(self.lightness, bool) or not isinstance(self.lightness, Real) or not 0 <= self.lightness <= 1:
            raise SettingsError(
                f"lightness: expected a number from 0 (the scan's) to 1 (the reference's), got {self.lightness!r}"
            )
        _set(self, "exposure", _exposure(self.exposure))
        if self.reference_masks is not None:
            _set(self, "reference_masks", _masks(self.reference_masks))
        _set(self, "coherence_mm", _number(self.coherence_mm))
        if self.coherence_mm is None or not 0 <= self.coherence_mm <= 1000:
            raise SettingsError(f"coherence_mm: expected 0 to 1000 mm, got {given['coherence_mm']!r}")
        for name, highest, text in (("seed", 2**63 - 1, "from 0 to 2^63 - 1"), ("batch", math.inf, "of at least 1")):
            value = _whole(given[name])
            if value is None or not (name == "batch") <= value <= highest:
                raise SettingsError(f"{name}: expected a whole number {text}, got {given[name]!r}")
            _set(self, name, value)

    @property
    def resolved_smoother(self) -> str:
        """The smoother after `auto` has been replaced."""
        return PRESETS[self.preset].smoother if self.smoother == "auto" else self.smoother

    @property
    def weighs_matches(self) -> bool:
        """Whether matches count by their confidence, and slices share their evidence."""
        smoother = self.resolved_smoother
        return smoother == "regression" or (PRESETS[self.preset].weighted and smoother in AVERAGING)

    @property
    def components(self) -> int | None:
        """On how many principal components features are compared; None: on all, as the deconvolution needs them."""
        return PRESETS[self.preset].components if self.reconstruction == "warp" else None

    @property
    def resolved_gamma(self) -> bool:
        """Whether gamma is used after None has been replaced: only where the paper's luminance comes out as well.

        Between its encoding and decoding a* and b* go with the luminance they lie on. Decoded on the scan's own they are wrong
        where that differs from the photograph's: `full` on thorax pairs 2.9 / 4.0 / 6.4 / 6.0 CIEDE2000 as it is / g^0.6 /
        two-to-one / inverted, without gamma 3.3 / 3.3 / 3.5 / 3.3, with gamma and the paper's luminance 2.8 / 2.9 / 3.1 / 3.7.
        """
        if self.gamma is None:
            return PRESETS[self.preset].gamma and self.luminance == "paper"
        return self.gamma

    def to_dict(self) -> dict:
        """Plain data, JSON-ready. Of a mask in memory its name and SHA-256."""
        data = asdict(self)
        return {**data, "body": str(data["body"])}

    @classmethod
    def from_dict(cls, data: dict) -> Settings:
        """The inverse of `to_dict`, but for a body that was a mask in memory.

        Raises:
            SettingsError: an unknown key or a wrong value.
        """
        if not isinstance(data, Mapping):
            raise SettingsError(f"settings: expected names and values, got {type(data).__name__}")
        known = {field.name for field in fields(cls)}
        unknown = sorted(str(name) for name in set(data) - known)
        if unknown:
            raise SettingsError(f"settings: unknown {', '.join(unknown)}; known are {', '.join(sorted(known))}")
        return replace(cls(), **data)


def _body(value) -> str | BodyMask:
    if isinstance(value, BodyMask):
        return value
    if isinstance(value, Volume):
        return BodyMask(value, placed=True)
    if isinstance(value, np.ndarray):
        try:
            return BodyMask(Volume(value, name="given"), placed=False)
        except InputError as error:
            raise SettingsError(f"body: a mask is an array (k, j, i) of whole numbers or bool; {error}") from error
    if isinstance(value, (str, os.PathLike)) and str(value):
        return str(value)
    raise SettingsError(f"body: expected auto, all, or a label volume (path or array), got {value!r}")


def _set(settings: Settings, name: str, value: object) -> None:
    object.__setattr__(settings, name, value)  # it is frozen for everybody else


def _one_of(name: str, value: object, allowed: tuple[str, ...]) -> None:
    if not isinstance(value, str) or value not in allowed:
        raise SettingsError(f"{name}: {value!r} is not one of {', '.join(allowed)}")


def _whole(value: Any) -> int | None:
    """A whole number of any kind, also NumPy's, as int; None for anything else, True and 2.0 among it."""
    try:
        return None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        return None


def _number(value: Any) -> float | None:
    """A finite number of any kind as float (an int stays one); None for anything else, text among it."""
    if isinstance(value, (bool, str, bytes)):
        return None
    try:
        return value if isinstance(value, int) else float(value) if math.isfinite(value) else None
    except (TypeError, ValueError, OverflowError):
        return None


def _smoother_options(settings: Settings) -> dict | None:
    from .filters import smoother_parameters  # NumPy; not needed where the defaults do

    options: Any = settings.smoother_options
    options = (
        dict(options) if isinstance(options, Mapping) else options
    )  # what else it is, is refused with what there is
    checked = smoother_parameters(settings.resolved_smoother, options)
    return {name: getattr(checked, name) for name in options} or None


def _listed(value: Any) -> list:
    """The members of a sequence; of text or anything that is none, an empty list."""
    if isinstance(value, (str, bytes, Mapping)):
        return []
    try:
        return list(value)
    except TypeError:
        return []


def _window(value) -> tuple[float, float]:
    ends = _listed(value)
    if len(ends) != 2 or any(isinstance(end, (bool, str, bytes)) or not hasattr(end, "__float__") for end in ends):
        raise SettingsError(f"window: expected two numbers LO HI, got {value!r}")
    low, high = (_number(end) for end in ends)
    if low is None or high is None or not low < high:
        said = " ".join(f"{end:g}" if isinstance(end, float) else str(end) for end in ends)
        raise SettingsError(f"window: expected finite LO < HI, got {said}")
    return float(low), float(high)


def _region(value) -> tuple:
    ranges: tuple[Any, ...] = tuple(tuple(_whole(v) for v in _listed(ends)) for ends in _listed(value))
    if len(ranges) != 3 or any(len(ends) != 2 or None in ends for ends in ranges):
        raise SettingsError(f"region: expected ((k0, k1), (j0, j1), (i0, i1)) in whole numbers, got {value!r}")
    if any(not 0 <= start < stop for start, stop in ranges):
        raise SettingsError(f"region: expected three ranges with 0 <= START < STOP, got {ranges}")
    return ranges


def _range(value) -> tuple[int, int]:
    ends: list[Any] = [_whole(v) for v in _listed(value)]
    if len(ends) != 2 or None in ends:
        raise SettingsError(f"slices: expected START and STOP in whole numbers, got {value!r}")
    start, stop = ends
    if not 0 <= start < stop:
        raise SettingsError(f"slices: expected 0 <= START < STOP, got {start}:{stop}")
    return start, stop


def _exposure(value) -> str | float:
    if value in ("auto", "off"):
        return value
    try:
        gain = float(value)
    except (TypeError, ValueError):
        gain = math.nan
    if isinstance(value, bool) or not 0.1 <= gain <= 10:
        raise SettingsError(f"exposure: expected auto, off or a gain from 0.1 to 10, got {value!r}")
    return gain


def _masks(value) -> tuple[str | None, ...]:
    if isinstance(value, (str, os.PathLike)):
        value = (value,)
    if not all(mask is None or isinstance(mask, (str, os.PathLike)) for mask in value):
        raise SettingsError("reference_masks: expected paths of pictures, one for each reference")
    return tuple(None if mask is None else os.fspath(mask) for mask in value)
