"""Light in the 3-D views: a plain lamp at the camera, or ambient shadows, jittered rays and shadows within the volume.

Ambient shadows darken folds and hollows, as daylight does; Slicer's views have them since 5.4, VTK's ray caster has shadows
within a volume since 9.2. Each is used where it is there; where none is, jittered rays are all there is. Shadows darken:
lighting of MedColor's volumes is raised by as much.
"""

from __future__ import annotations

import logging
import time

import slicer
import vtk

from . import rendering, three_d_views

_ATTRIBUTE = "MedColor.Light"  # on a view node: "realistic" or "plain"; absent: never asked
_PATIENCE_SECONDS = 0.1  # a view that takes longer to draw stays with the plain lamp unless asked
_SCATTERING, _REACH = 0.4, 0.1
_RAISED = 1.1  # ambient and diffuse light, to make up for _SCATTERING
_WITHOUT_SHADOWS = "realistic light without ambient shadows: VTK %s draws no volumes beside them; jittered rays remain"
_MANAGER = "vtkMRMLVolumeRenderingDisplayableManager"


def views(scene) -> list:
    """All 3-D view nodes."""
    return [
        scene.GetNthNodeByClass(n, "vtkMRMLViewNode") for n in range(scene.GetNumberOfNodesByClass("vtkMRMLViewNode"))
    ]


def is_on(scene) -> bool:
    """Whether the views have realistic light."""
    return any(view.GetAttribute(_ATTRIBUTE) == "realistic" for view in views(scene))


def switch(scene, realistic: bool) -> None:
    """Realistic or plain light in all 3-D views."""
    if realistic and not _shadows_know_volumes():
        logging.info(_WITHOUT_SHADOWS, vtk.vtkVersion.GetVTKVersion())
    _light(scene, views(scene), realistic)


def spread(scene) -> None:
    """Views that a layout made since take the light of the others."""
    new = [view for view in views(scene) if not view.GetAttribute(_ATTRIBUTE)]
    if new and is_on(scene):
        _light(scene, new, True)


def _light(scene, some_views, realistic: bool) -> None:
    for view in some_views:
        with slicer.util.NodeModify(view):
            view.SetAttribute(_ATTRIBUTE, "realistic" if realistic else "plain")
            if hasattr(view, "SetVolumeRenderingSurfaceSmoothing"):  # jittered rays: no wood grain on flat surfaces
                view.SetVolumeRenderingSurfaceSmoothing(bool(realistic))
            if hasattr(
                view, "SetShadowsVisibility"
            ):  # off where a scene of a newer Slicer had them and none could be seen
                view.SetShadowsVisibility(bool(realistic) and _shadows_know_volumes())
                view.SetAmbientShadowsSizeScale(0.3)
            if hasattr(view, "SetAmbientShadowsVolumeOpacityThreshold"):
                view.SetAmbientShadowsVolumeOpacityThreshold(0.25)
    for display in _displays(scene):
        apply_to(display)


def apply_to(display) -> None:
    """Shadows within the volume of a display, and as much more light, as its scene's views have it."""
    from MedColorLib.rendering import presets

    realistic = is_on(display.GetScene())
    shadowed = False
    for mapper in _mappers(display):
        if hasattr(mapper, "SetVolumetricScatteringBlending"):
            mapper.SetVolumetricScatteringBlending(_SCATTERING if realistic else 0.0)
            mapper.SetGlobalIlluminationReach(_REACH if realistic else 0.0)
            shadowed = realistic
    raised = _RAISED if shadowed else 1.0
    node = display.GetVolumePropertyNode()
    prop = node.GetVolumeProperty()
    with slicer.util.NodeModify(node):
        prop.SetAmbient(min(presets.AMBIENT * raised, 1.0))
        prop.SetDiffuse(presets.DIFFUSE * raised)


def first_time(scene) -> None:
    """When a result is shown: realistic light where the driver is quick, unless somebody chose before."""
    if any(view.GetAttribute(_ATTRIBUTE) for view in views(scene)):
        return
    seconds = _seconds_per_frame()
    if seconds is not None:
        switch(scene, seconds < _PATIENCE_SECONDS)


def _shadows_know_volumes() -> bool:
    """An older pass for ambient shadows (seen: VTK 9.1 as Debian has it) leaves volumes out of the picture altogether."""
    return hasattr(getattr(vtk, "vtkSSAOPass", None), "SetVolumeOpacityThreshold")


def _displays(scene) -> list:
    count = scene.GetNumberOfNodesByClass(rendering.DISPLAY_CLASS)
    found = [scene.GetNthNodeByClass(n, rendering.DISPLAY_CLASS) for n in range(count)]
    return [node for node in found if node.GetAttribute(rendering.OPACITY_ATTRIBUTE) and node.GetVolumePropertyNode()]


def _mappers(display) -> list:
    """What draws a display, one for each 3-D view that it may be seen in."""
    volume = display.GetDisplayableNode()
    managers = [view.displayableManagerByClassName(_MANAGER) for view in three_d_views.all_views()]
    mappers = [manager.GetVolumeMapper(volume) for manager in managers if manager and volume]
    return [mapper for mapper in mappers if mapper]


def _seconds_per_frame():
    """How long the first 3-D view takes to draw; None without a view, or while none can be drawn."""
    view = next(iter(three_d_views.shown_views()), None)
    if view is None or not view.visible:
        return None
    view.forceRender()  # the first frame compiles shaders and hands the voxels over
    start = time.monotonic()
    view.forceRender()
    return time.monotonic() - start
