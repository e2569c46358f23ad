"""Tells the panel what happens in the scene while it is open: nodes and whole scenes that come, go or change.

Every way a node can change counts: new voxels, another name, another or a moved or hardened transform, shown or hidden
elsewhere. What is seen many times in one go (a scene that is read, a volume that is loaded) is told once, afterwards.
"""

from __future__ import annotations

import qt
import slicer
import vtk
from slicer.util import VTKObservationMixin

# The integer is what VTK calls the event; the classes may lack the name in Python.
_VOXELS = getattr(slicer.vtkMRMLVolumeNode, "ImageDataModifiedEvent", 18001)
_EVENTS = (
    vtk.vtkCommand.ModifiedEvent,
    _VOXELS,
    getattr(slicer.vtkMRMLTransformableNode, "TransformModifiedEvent", 15000),
    getattr(slicer.vtkMRMLDisplayableNode, "DisplayModifiedEvent", 17000),
)


class SceneWatch(VTKObservationMixin):
    """Observes the scene, and the nodes that it is told to follow."""

    def __init__(self, scene, panel) -> None:
        """Args: panel: has onSceneStart(), onSceneEnd(), onNodeRemoved(node), onSceneChanged(volumes added: bool)."""
        VTKObservationMixin.__init__(self)
        self.panel, self._scene = panel, scene
        self._followed: list = []
        self._awaited: list = []  # volumes that were added before they had voxels
        self._job = VTKObservationMixin()
        self._added = False
        self._later = qt.QTimer()
        self._later.setSingleShot(True)
        self._later.setInterval(0)
        self._later.timeout.connect(self._tell)
        for start in (scene.StartCloseEvent, scene.StartImportEvent, scene.StartRestoreEvent):
            self.addObserver(scene, start, self._onStart)
        for end in (scene.EndCloseEvent, scene.EndImportEvent, scene.EndRestoreEvent):
            self.addObserver(scene, end, self._onEnd)
        self.addObserver(scene, scene.NodeAddedEvent, self._onAdded)
        self.addObserver(scene, scene.NodeRemovedEvent, self._onRemoved)

    def stop(self) -> None:
        """The panel is going away."""
        self._later.stop()
        self.release()
        self.removeObservers()
        self._followed, self._awaited = [], []

    def follow(self, nodes) -> None:
        """From now on changes of just these nodes are told; None and doubles are passed over."""
        wanted = [node for n, node in enumerate(nodes) if node is not None and node not in nodes[:n]]
        if wanted == self._followed:
            return
        for node in self._followed:
            for event in _EVENTS:
                self.removeObserver(node, event, self._onChanged)
        self._followed = wanted
        for node in wanted:
            for event in _EVENTS:
                self.addObserver(node, event, self._onChanged)

    def guard(self, node, spoiled) -> None:
        """Call `spoiled()` at once when the voxels of this node are replaced, until `release`."""
        if node is not None:
            self._job.addObserver(node, _VOXELS, lambda *_: spoiled())

    def release(self) -> None:
        """What `guard` began ends."""
        self._job.removeObservers()

    def _onStart(self, _scene, _event) -> None:
        self.panel.onSceneStart()

    def _onEnd(self, _scene, _event) -> None:
        self._added = True
        self.panel.onSceneEnd()
        self._later.start()

    @vtk.calldata_type(vtk.VTK_OBJECT)
    def _onAdded(self, _scene, _event, node) -> None:
        if node is None or not node.IsA("vtkMRMLVolumeNode"):
            return
        self._added = True
        if node.GetImageData() is None:
            self._awaited.append(node)
            self.addObserver(node, _VOXELS, self._onVoxelsCame)
        self._later.start()

    def _onVoxelsCame(self, node, _event) -> None:
        if node in self._awaited:
            self._awaited.remove(node)
            self.removeObserver(node, _VOXELS, self._onVoxelsCame)
        self._added = True
        self._later.start()

    @vtk.calldata_type(vtk.VTK_OBJECT)
    def _onRemoved(self, _scene, _event, node) -> None:
        if node in self._awaited:
            self._awaited.remove(node)
            self.removeObserver(node, _VOXELS, self._onVoxelsCame)
        self.panel.onNodeRemoved(node)
        self._later.start()

    def _onChanged(self, _node, _event) -> None:
        self._later.start()

    def _tell(self) -> None:
        added, self._added = self._added, False
        self.panel.onSceneChanged(added)
