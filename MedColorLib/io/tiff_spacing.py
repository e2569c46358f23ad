"""Voxel sizes in TIFF: of OME's and ImageJ's words, and of the resolution tags where they are not those of a printer."""

from __future__ import annotations

import math

_MM = {
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1.0),
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm", "\\u00b5m", "micron", "microns", "micrometer", "micrometre"), 1e-3),
    **{"nm": 1e-6, "cm": 10.0, "m": 1e3, "in": 25.4, "inch": 25.4, "\u00c5": 1e-7, "pm": 1e-9},
}
# fmt: off
PRINTERS = {  # dots per inch
    72, 75, 90, 96, 100, 120, 144, 150, 180, 200, 240, 300, 350, 360,
    400, 600, 720, 1200, 2400,
}
# fmt: on


def spacing_mm(file, index: int, series) -> tuple[tuple[float | None, float | None, float | None], str]:
    """((i, j, k) in millimetres or None, where they are from)."""
    if file.is_ome and any(found := _ome_spacing(file.ome_metadata, index)):
        return found, "OME"
    plane = next((page for page in series.pages if page is not None), None)
    tags = {} if plane is None else plane.aspage().tags
    across = [_ratio(tags, 282), _ratio(tags, 283)]  # pixels per unit along x, y
    if file.is_imagej:
        return _imagej_spacing(file.imagej_metadata or {}, across)
    unit = tags.get(296)
    unit_mm = {2: 25.4, 3: 10.0}.get(2 if unit is None else int(unit.value))
    printed = unit_mm == 25.4 and all(ratio and round(ratio, 2) in PRINTERS for ratio in across)
    if unit_mm is None or not all(across) or printed:
        return (None, None, None), ""
    return (unit_mm / across[0], unit_mm / across[1], None), "the resolution tags"


def _imagej_spacing(
    words: dict, across: list[float | None]
) -> tuple[tuple[float | None, float | None, float | None], str]:
    scale = _MM.get(str(words.get("unit", "")).strip().lower())
    if scale is None:
        return (None, None, None), ""
    step = words.get("spacing")
    step = abs(float(step)) * scale if isinstance(step, (int, float)) and step else None
    i, j = (scale / ratio if ratio else None for ratio in across)
    return (i, j, step), "ImageJ"


def _ratio(tags, code: int) -> float | None:
    tag = tags.get(code)
    try:
        above, below = tag.value
        return above / below if above > 0 and below > 0 else None
    except (AttributeError, TypeError, ValueError):
        return None


def _ome_spacing(text: str, index: int) -> tuple[float | None, float | None, float | None]:
    from xml.etree import ElementTree

    try:
        pixels = [e for e in ElementTree.fromstring(text).iter() if e.tag.endswith("}Pixels") or e.tag == "Pixels"]
    except ElementTree.ParseError:
        return None, None, None
    if index >= len(pixels):
        return None, None, None

    def size(axis: str) -> float | None:
        scale = _MM.get(pixels[index].get(f"PhysicalSize{axis}Unit", "\u00b5m").lower())
        try:
            value = float(pixels[index].get(f"PhysicalSize{axis}", "nan"))
        except ValueError:
            return None
        return value * scale if scale and math.isfinite(value) and value > 0 else None

    return size("X"), size("Y"), size("Z")
