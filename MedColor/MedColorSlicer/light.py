"""Light in the 3-D views: a plain lamp at the camera, or ambient shadows, jittered rays and a brighter lamp to make up.

Ambient shadows darken folds and hollows, as daylight does. Slicer has them since 5.4; where a view does not know them,
the rest of the realistic light is all there is. What darkens is made up for by the view's own shift of intensity.
"""

from __future__ import annotations

import time

import slicer

_ATTRIBUTE = "MedColor.Light"  # on a view node: "realistic" or "plain"; absent: never asked
_PATIENCE_SECONDS = 0.1  # a view that takes longer to draw stays with the plain lamp unless asked


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
    for view in views(scene):
        with slicer.util.NodeModify(view):
            view.SetAttribute(_ATTRIBUTE, "realistic" if realistic else "plain")
            if hasattr(view, "SetVolumeRenderingSurfaceSmoothing"):  # jittered rays: no wood grain on flat surfaces
                view.SetVolumeRenderingSurfaceSmoothing(bool(realistic))
            if hasattr(view, "SetShadowsVisibility"):
                view.SetShadowsVisibility(bool(realistic))
                view.SetAmbientShadowsSizeScale(0.3)
            if hasattr(view, "SetAmbientShadowsVolumeOpacityThreshold"):
                view.SetAmbientShadowsVolumeOpacityThreshold(0.25)


def first_time(scene) -> None:
    """When a result is shown: realistic light where the driver is quick, unless somebody chose before."""
    if any(view.GetAttribute(_ATTRIBUTE) for view in views(scene)):
        return
    seconds = _seconds_per_frame()
    if seconds is not None:
        switch(scene, seconds < _PATIENCE_SECONDS)


def _seconds_per_frame():
    """How long the first 3-D view takes to draw; None without a view."""
    manager = slicer.app.layoutManager()
    if manager is None or manager.threeDViewCount == 0:
        return None
    view = manager.threeDWidget(0).threeDView()
    view.forceRender()  # the first frame compiles shaders and hands the voxels over
    start = time.monotonic()
    view.forceRender()
    return time.monotonic() - start
