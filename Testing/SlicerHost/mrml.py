"""Slicer's real MRML without Slicer: a scene with its logics, and a 3-D view that renders off screen.

Everything here comes from the `slicer-core` wheel (pinned to 5.12.4.0: Slicer's stable line, built on VTK 9.6.0, and
the first one whose wheel holds the volume rendering logic and displayable manager this file uses). One view per
process: the displayable manager factory is a singleton.
"""

from __future__ import annotations

import os
import sys
import tempfile
import types

import numpy as np
import slicer
import vtk

HERE = os.path.dirname(os.path.abspath(__file__))
REPOSITORY = os.path.dirname(os.path.dirname(HERE))

# Slicer's automatic preset for 8-bit volumes, in the least form its logic accepts (it crashes without one). The curve
# is as unsuitable for colour as the original: nearly black, half invisible.
PRESETS = """<MRML version="Slicer4" userTags="">
<VolumeProperty id="vtkMRMLVolumePropertyNode1" name="US-Fetal" interpolation="1" shade="1" diffuse="0.9" ambient="0.1"
 specular="0.2" specularPower="10" scalarOpacity="8 0 0 60 0 120 0.6 255 0.8" gradientOpacity="4 0 1 255 1"
 colorTransfer="8 0 0 0 0 255 1 0.8 0.6" ></VolumeProperty>
<VolumeProperty id="vtkMRMLVolumePropertyNode2" name="CT-Bones" interpolation="1" shade="1" diffuse="1" ambient="0.1"
 specular="0.2" specularPower="10" scalarOpacity="8 -1000 0 150 0 641 0.7 3071 0.7" gradientOpacity="4 0 1 255 1"
 colorTransfer="8 -1000 0 0 0 3071 1 0.9 0.7" ></VolumeProperty>
</MRML>
"""


class HostScene:
    """A scene wired like Slicer's: application logic, colours, subject hierarchy, volume rendering."""

    def __init__(self) -> None:
        sys.path[:0] = [path for path in (REPOSITORY, os.path.join(REPOSITORY, "MedColor")) if path not in sys.path]
        self.scene = slicer.vtkMRMLScene()
        self.application_logic = slicer.vtkSlicerApplicationLogic()
        self.application_logic.SetMRMLScene(self.scene)
        self.application_logic.GetColorLogic().SetMRMLScene(self.scene)
        self.application_logic.GetColorLogic().AddDefaultColorNodes()
        self._views, self._slices = vtk.vtkCollection(), vtk.vtkCollection()
        self.application_logic.SetViewLogics(self._views)
        self.application_logic.SetSliceLogics(self._slices)
        self.scene.AddNode(slicer.vtkMRMLSubjectHierarchyNode())
        self._allow_bundles()
        self.rendering_logic = self._volume_rendering_logic()
        slicer.mrmlScene = self.scene
        modules = types.SimpleNamespace()
        modules.volumerendering = types.SimpleNamespace(logic=lambda: self.rendering_logic)
        slicer.modules = modules

    def _allow_bundles(self) -> None:
        """MRB files are unpacked below the cache of remote files."""
        self._cache_folder = tempfile.TemporaryDirectory()
        self._cache, self._data_manager = slicer.vtkCacheManager(), slicer.vtkDataIOManager()
        self._cache.SetRemoteCacheDirectory(self._cache_folder.name)
        self._cache.SetMRMLScene(self.scene)
        self.scene.SetCacheManager(self._cache)
        self._data_manager.SetCacheManager(self._cache)
        self.scene.SetDataIOManager(self._data_manager)

    def _volume_rendering_logic(self):
        logic = slicer.vtkSlicerVolumeRenderingLogic()
        self._share = tempfile.TemporaryDirectory()
        with open(os.path.join(self._share.name, "presets.xml"), "w", encoding="utf-8") as stream:
            stream.write(PRESETS)
        logic.SetModuleShareDirectory(self._share.name)
        logic.SetMRMLScene(self.scene)
        logic.SetMRMLApplicationLogic(self.application_logic)
        self.application_logic.SetModuleLogic("VolumeRendering", logic)
        logic.ChangeVolumeRenderingMethod("vtkMRMLGPURayCastVolumeRenderingDisplayNode")
        return logic


class OffscreenView:
    """One 3-D view of Slicer, drawn into memory; `render()` returns (height, width, 3) uint8, row 0 on top."""

    def __init__(self, host: HostScene, layout_name: str = "1", size: int = 200, background=(0.0, 0.0, 0.0)) -> None:
        self.host = host
        self.renderer = vtk.vtkRenderer()
        self.renderer.SetBackground(*background)
        self.window = vtk.vtkRenderWindow()
        self.window.SetOffScreenRendering(True)
        self.window.SetShowWindow(False)
        self.window.SetMultiSamples(0)
        self.window.SetSize(size, size)
        self.window.AddRenderer(self.renderer)
        self.interactor = vtk.vtkGenericRenderWindowInteractor()
        self.interactor.SetRenderWindow(self.window)
        self.group = slicer.vtkMRMLDisplayableManagerGroup()
        self.group.SetRenderer(self.renderer)
        self.group.Initialize(_displayable_managers(host.application_logic), self.renderer)
        self.view_logic = slicer.vtkMRMLViewLogic()
        self.view_logic.SetMRMLApplicationLogic(host.application_logic)
        self.view_logic.SetMRMLScene(host.scene)
        self.node = self.view_logic.AddViewNode(layout_name)
        self.background = background
        self.make_plain()
        self.group.SetMRMLDisplayableNode(self.node)

    def make_plain(self) -> None:
        """No box, no labels, one background; clearing the scene brings Slicer's own back."""
        self.node.SetBoxVisible(False)
        self.node.SetAxisLabelsVisible(False)
        self.node.SetBackgroundColor(*self.background)
        self.node.SetBackgroundColor2(*self.background)

    def look_at(self, bounds, direction=(0.0, 1.0, 0.0), distance_mm=400.0) -> None:
        """Parallel projection along `direction` (RAS), fitted to `bounds`."""
        camera = self.renderer.GetActiveCamera()
        center = np.array([(bounds[0] + bounds[1]) / 2, (bounds[2] + bounds[3]) / 2, (bounds[4] + bounds[5]) / 2])
        camera.SetParallelProjection(True)
        camera.SetFocalPoint(*center)
        camera.SetPosition(*(center + distance_mm * np.asarray(direction)))
        camera.SetViewUp(0, 0, 1)
        camera.SetParallelScale(max(bounds[1] - bounds[0], bounds[5] - bounds[4]) / 2 * 1.1)
        self.renderer.ResetCameraClippingRange()

    def render(self) -> np.ndarray:
        from vtk.util.numpy_support import vtk_to_numpy

        self.window.Render()
        grab = vtk.vtkWindowToImageFilter()
        grab.SetInput(self.window)
        grab.ReadFrontBufferOff()
        grab.Update()
        image = grab.GetOutput()
        width, height, _ = image.GetDimensions()
        return vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, -1)[::-1, :, :3].copy()


def _displayable_managers(application_logic):
    factory = slicer.vtkMRMLThreeDViewDisplayableManagerFactory.GetInstance()
    factory.SetMRMLApplicationLogic(application_logic)
    for name in ("VolumeRendering", "Camera", "View"):
        manager = f"vtkMRML{name}DisplayableManager"
        if not factory.IsDisplayableManagerRegistered(manager):
            factory.RegisterDisplayableManager(manager)
    return factory
