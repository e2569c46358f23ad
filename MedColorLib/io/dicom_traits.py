"""What tells DICOM images at one place apart: echo, b-value, acquisition, time point and the like.

Names are for notes and lists; values are numbers or codes, no free text of the header.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

# Words for people -> keyword or private tag (group, element), first found. In the order in which they are tried.
_TRAITS: dict[str, tuple] = {
    "image type": ("FrameType", "ImageType"),
    "component": ("ComplexImageComponent", (0x2005, 0x1011), (0x0043, 0x102F)),
    "stack": ("StackID",),
    "echo time (ms)": ("EffectiveEchoTime", "EchoTime"),
    "echo": ("EchoNumbers",),
    "inversion time (ms)": ("InversionTimes", "InversionTime"),
    "b-value": ("DiffusionBValue", (0x0019, 0x100C), (0x2001, 0x1003), (0x0043, 0x1039)),
    "slice thickness (mm)": ("SliceThickness",),
    "kernel": ("ConvolutionKernel",),
    "energy (kV)": ("KVP",),
    "flip angle": ("FlipAngle",),
    "repetition time (ms)": ("RepetitionTime",),
    "sequence": ("PulseSequenceName", "SequenceName"),
    "field of view (mm)": ("ReconstructionDiameter",),
    "filter": ("FilterType",),
    "contrast agent": ("ContrastBolusAgent",),
    "description": ("SeriesDescription",),
    "energy window": ("EnergyWindowVector",),
    "detector": ("DetectorVector",),
    "time point": ("TemporalPositionIndex", "TemporalPositionIdentifier"),
    "cardiac phase (%)": ("NominalPercentageOfCardiacPhase",),
    "phase": ("PhaseVector", (0x2001, 0x1008)),
    "rotation": ("RotationVector",),
    "time slot": ("TimeSlotVector",),
    "time slice": ("TimeSliceVector",),
    "angle": ("AngularViewVector",),
    "acquisition": ("FrameAcquisitionNumber", "AcquisitionNumber"),
    "trigger time (ms)": ("NominalCardiacTriggerDelayTime", "TriggerTime"),
    "gradient": ("DiffusionGradientOrientation",),
    "reference time (ms)": ("FrameReferenceTime",),
    "acquisition time": (
        "FrameReferenceDateTime",
        "FrameAcquisitionDateTime",
        "AcquisitionDateTime",
        "AcquisitionTime",
    ),
    "content time": ("ContentTime",),
}
TRAITS = tuple(_TRAITS)
CONTRASTS = ("component", "echo", "echo time (ms)", "inversion time (ms)", "b-value")  # never parts of one volume
TIMES = ("acquisition", "acquisition time", "content time", "reference time (ms)", "trigger time (ms)", "gradient")
TIME_POINTS = (  # what the time points of one series differ in
    *(name for name in TIMES if name != "gradient"),
    "time point",
    "cardiac phase (%)",
    "phase",
    "time slot",
    "time slice",
)
HIDDEN = (
    "acquisition time",
    "content time",
    "gradient",
    "contrast agent",
    "description",
)  # their values are told by rank
_ROUGH = {"echo time (ms)": 2, "slice thickness (mm)": 3}  # significant digits
_MAX_TOKENS = 8


class Words:
    """What data sets say, by keyword or private tag: the value of the first that has it, each looked up once."""

    def __init__(self, *parts) -> None:
        """The nearest data set first; dictionaries of values and other `Words` may be among them."""
        self._parts, self._known = parts, {}

    def get(self, source, default=None):
        """The value, or `default` where it is missing, empty or unreadable."""
        if source not in self._known:
            self._known[source] = next((v for part in self._parts if (v := _value(part, source)) is not None), None)
        found = self._known[source]
        return default if found is None else found


def values_of(items: Iterable) -> dict:
    """Keyword or private tag -> value of all elements of data sets, the first of a name; unreadable ones are left out."""
    found: dict = {}
    for item in items:
        tags = list(item.keys())  # iterating gives elements, and raises at a damaged one
        for tag in tags:
            try:
                element = item[tag]
                found.setdefault(element.keyword or (tag.group, tag.element), element.value)
            except Exception:  # whatever a damaged element makes pydicom raise
                continue
    return found


def traits_of(words: Words) -> dict[str, Any]:
    """The traits that a header gives."""
    found = {}
    for name, sources in _TRAITS.items():
        for source in sources:
            value = words.get(source)
            if value is not None:
                found[name] = _plain(name, value)
                break
    return found


def frame_traits(words: Words, own: dict, number: int) -> tuple[dict[str, Any], float | None]:
    """(traits, number that orders frames without a position) of a frame; `own`: what it does not share with others."""
    found = traits_of(words)
    for name in ("energy window", "detector", "phase", "rotation", "time slot", "time slice", "angle"):
        vector = _TRAITS[name][0]
        values = words.get(vector)
        if values is not None:
            found[name] = _nth(values, number)
    indices = own.get("DimensionIndexValues")
    for place, index in enumerate(indices if hasattr(indices, "__len__") else [] if indices is None else [indices]):
        found[f"dimension {place + 1}:"] = int(index)
    slices = words.get("SliceVector")
    if slices is not None:
        return found, float(_nth(slices, number) - 1)
    place = own.get("InStackPositionNumber")
    return found, None if place is None else float(place)


def _nth(values, number: int) -> int:
    values = values if hasattr(values, "__len__") else [values]
    return int(values[number])


def _value(part, source):
    """The element's value, or None where it is missing, empty or unreadable."""
    try:
        value = part.get(source)
        if hasattr(value, "VR"):  # data sets give elements by tag
            value = value.value
    except Exception:  # whatever a damaged element makes pydicom raise
        return None
    return None if value is None or (hasattr(value, "__len__") and not len(value)) else value


def _plain(name: str, value):
    """Hashable and comparable: a number, a text, or a tuple of them."""
    if isinstance(value, bytes):
        return value[:16].hex()
    if hasattr(value, "__len__") and not isinstance(value, str):
        values = tuple(_plain("", part) for part in list(value)[:_MAX_TOKENS])
        return values if name == "image type" or len(values) != 1 else values[0]
    if isinstance(value, str) and name != "image type":
        value = value.strip(" \0")
    try:
        number = float(value)
    except (TypeError, ValueError):
        return (str(value).strip(" \0"),) if name == "image type" else str(value).strip(" \0")
    return float(f"{number:.{_ROUGH[name]}g}") if name in _ROUGH else number
