"""Light on the stage: a plain lamp at the viewer, or light from the upper left whose shadows fall into the body.

Volumetric shadows are VTK's own (9.2 and later); where a VTK has none, the lamps and the jittered rays are all there is.
Shadows darken: the picture is made as bright again as under the plain lamp.
"""

from __future__ import annotations

import logging

import numpy as np

from ..errors import SettingsError

_LOG = logging.getLogger("MedColorLib")

LIGHTS = ("plain", "realistic")
_SCATTERING = 0.25  # of 1: at 0.5 shadows alone give form, and a face is flat
_REACH = 0.3  # of the volume's size that shadows are looked for
_KEY = ((-1.0, 1.2, 1.6), 0.6)  # place of the main lamp as the camera sees it (right, up, towards), and its strength
_FILL = ((0.0, 0.0, 1.0), 0.9)
_GAIN = (0.8, 2.5)  # least and most


def check_light(light: str) -> None:
    """Refuse a light that is none.

    Raises:
        SettingsError: not one of `LIGHTS`.
    """
    if light not in LIGHTS:
        raise SettingsError(f"light: expected one of {', '.join(LIGHTS)}, got {light!r}")


def set_lamps(renderer: object, light: str) -> None:
    """Put the lamps of a light into a renderer; they move with the camera."""
    from vtkmodules.vtkRenderingCore import vtkLight

    renderer.RemoveAllLights()
    if light == "plain":
        lamp = vtkLight()
        lamp.SetLightTypeToHeadlight()
        renderer.AddLight(lamp)
        return
    for place, strength in (_KEY, _FILL):
        lamp = vtkLight()
        lamp.SetLightTypeToCameraLight()
        lamp.SetPosition(*place)
        lamp.SetFocalPoint(0.0, 0.0, 0.0)
        lamp.SetIntensity(strength)
        renderer.AddLight(lamp)


def has_shadows(mapper: object) -> bool:
    """Whether this VTK's ray caster knows shadows within a volume."""
    return hasattr(mapper, "SetVolumetricScatteringBlending") and hasattr(mapper, "SetGlobalIlluminationReach")


def set_shadows(volume: object, light: str) -> None:
    """Jittered rays and shadows within the volume for realistic light; without them for plain light."""
    mapper, realistic = volume.GetMapper(), light == "realistic"
    mapper.SetUseJittering(1 if realistic else 0)
    if has_shadows(mapper):
        mapper.SetVolumetricScatteringBlending(_SCATTERING if realistic else 0.0)
        mapper.SetGlobalIlluminationReach(_REACH if realistic else 0.0)
    elif realistic:
        _LOG.info("rendering: this VTK has no shadows within volumes; lamps from the side are used without them")


def gain(plain: np.ndarray, lit: np.ndarray) -> float:
    """By how much a picture (H, W, 3) has to be brightened to be as bright as the plain one of the same view."""
    seen = plain.max(axis=-1) > 8
    if not seen.any() or not lit[seen].any():
        return 1.0
    return float(np.clip(plain[seen].mean() / lit[seen].mean(), *_GAIN))
