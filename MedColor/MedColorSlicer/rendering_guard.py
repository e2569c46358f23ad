"""Keeps the rendering of results right after a preset was applied by hand, and after a scene was opened."""

from __future__ import annotations

import logging

import vtk
from slicer.util import VTKObservationMixin

from . import rendering, sequences

_VOXELS = 18001  # vtkMRMLVolumeNode's ImageDataModifiedEvent; the class may lack the name in Python


class RenderingGuard(VTKObservationMixin):
    """Observes one scene and the volume properties of MedColor's displays in it."""

    def __init__(self, scene) -> None:
        VTKObservationMixin.__init__(self)
        self._busy = False
        self._watched: list = []  # volume properties
        self._played: list = []  # volumes that show one time point after the other
        self.addObserver(scene, scene.EndCloseEvent, self._on_scene_closed)
        self.addObserver(scene, scene.EndImportEvent, self._on_scene_read)
        self.addObserver(scene, scene.EndRestoreEvent, self._on_scene_read)
        self._on_scene_read(scene, None)

    def watch(self, display) -> None:
        """Repair this display when its volume property is overwritten."""
        node = display.GetVolumePropertyNode()
        if node and node not in self._watched:
            self._watched.append(node)
            self.addObserver(node, vtk.vtkCommand.ModifiedEvent, self._on_property)
        volume_node = display.GetDisplayableNode()
        if sequences.sequence_of(volume_node) is not None and volume_node not in self._played:
            self._played.append(volume_node)
            self.addObserver(volume_node, _VOXELS, self._on_time_point)

    def _on_scene_closed(self, _scene, _event) -> None:
        for node in self._watched:  # removed from the scene; an observation would keep them in memory
            self.removeObserver(node, vtk.vtkCommand.ModifiedEvent, self._on_property)
        for volume_node in self._played:
            self.removeObserver(volume_node, _VOXELS, self._on_time_point)
        self._watched.clear()
        self._played.clear()

    def _on_scene_read(self, scene, _event) -> None:
        for display in _medcolor_displays(scene):
            self._repair(display)
            self.watch(display)

    def _on_property(self, node, _event) -> None:
        for display in _medcolor_displays(node.GetScene()):
            if display.GetVolumePropertyNode() is node:
                self._repair(display)

    def _on_time_point(self, volume_node, _event) -> None:
        """A sequence is played: the opacity curve follows the luminance range, else the body would flicker."""
        if volume_node.GetImageData() is not None:
            rendering.refresh(volume_node)

    def _repair(self, display) -> None:
        volume_node = display.GetDisplayableNode()
        if self._busy or volume_node is None or volume_node.GetImageData() is None:
            return
        self._busy = True  # the repair itself modifies the node that is observed
        try:
            if rendering.has_medcolor_look(display):
                rendering.restore_unsaved(display)
            else:
                logging.getLogger("MedColorLib").info("colour rendering restored: a preset does not suit an RGB volume")
                rendering.reset(volume_node)
        finally:
            self._busy = False


def _medcolor_displays(scene):
    if scene is None:
        return []
    kind = rendering.DISPLAY_CLASS
    nodes = [scene.GetNthNodeByClass(n, kind) for n in range(scene.GetNumberOfNodesByClass(kind))]
    return [node for node in nodes if node.GetAttribute(rendering.OPACITY_ATTRIBUTE) and node.GetVolumePropertyNode()]


_GUARDS: dict = {}


def guard_of(scene) -> RenderingGuard:
    """The guard of a scene, created the first time."""
    if scene not in _GUARDS:
        _GUARDS[scene] = RenderingGuard(scene)
    return _GUARDS[scene]


def release_guards() -> None:
    """Stop observing; needed before this file is loaded anew."""
    while _GUARDS:
        _GUARDS.popitem()[1].removeObservers()
