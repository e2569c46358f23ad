"""Fixtures of the cases that run in a process of their own (`Testing/Module/test_in_host.py` starts them).

The library's colouring is replaced by a quick stand-in where a case is about the scene or the panel.
"""

from __future__ import annotations

import os
import sys
import time
import types

import numpy as np
import pytest

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

LEFT, RIGHT = (200, 120, 60), (60, 120, 200)
SOLID = 0.88  # hardly anything shines through
SIZE = 120  # pixels; software rendering takes a third of a second for such a picture


@pytest.fixture(scope="session")
def host():
    """Slicer's scene and logics, without Qt."""
    import mrml
    import slicer_like

    scene_host = mrml.HostScene()
    slicer_like.install(scene_host)
    return scene_host


@pytest.fixture(scope="session")
def qt_host(tmp_path_factory):
    """The same with PySide6 dressed as Slicer's Qt, and settings of its own."""
    import mrml
    import slicer_like
    from PySide6 import QtCore, QtWidgets

    application = QtWidgets.QApplication([])
    application.setOrganizationName("MedColorTests")
    settings = str(tmp_path_factory.mktemp("settings"))
    QtCore.QSettings.setPath(QtCore.QSettings.NativeFormat, QtCore.QSettings.UserScope, settings)
    scene_host = mrml.HostScene()
    slicer_like.install(scene_host, application)
    return scene_host


@pytest.fixture
def scene(host):
    """An empty scene."""
    empty(host.scene)
    return host.scene


@pytest.fixture(scope="session")
def view(host):
    """The 3-D view that Slicer calls 1."""
    import mrml

    return mrml.OffscreenView(host, "1", SIZE)


@pytest.fixture(scope="session")
def second_view(host, view):
    """The 3-D view that Slicer calls 2."""
    import mrml

    return mrml.OffscreenView(host, "2", SIZE)


@pytest.fixture
def rendering_show(scene):
    """The module's part of that name, over an empty scene."""
    from MedColorSlicer import rendering_show

    return rendering_show


@pytest.fixture
def rendering(scene):
    """The module's part of that name, over an empty scene."""
    from MedColorSlicer import rendering

    return rendering


def empty(scene):
    """Close the scene; Slicer makes the subject hierarchy anew at once, here it has to be asked for."""
    import slicer

    scene.Clear(0)
    slicer.vtkMRMLSubjectHierarchyNode.GetSubjectHierarchyNode(scene)


@pytest.fixture
def library(monkeypatch):
    """MedColorLib with a stand-in for `colorize`, whose calls are kept."""
    import MedColorLib

    stand_in = StandIn()
    monkeypatch.setattr(MedColorLib, "colorize", stand_in)
    monkeypatch.setattr(MedColorLib, "colorize_time_points", stand_in.time_points)
    return stand_in


class StandIn:
    """Colours by position in no time; can be slowed down, or made to fail half way."""

    def __init__(self):
        self.calls, self.steps, self.error, self.pause_seconds = [], 4, None, 0.0
        self.guards, self.finished, self.report = [], 0, {}
        self.in_the_middle = lambda: None

    def time_points(self, volumes, references, settings, progress, cancelled, guard):
        from MedColorLib.run.timepoints import share_of

        grids = {(volume.array.shape, volume.ijk_to_ras.tobytes()) for volume in volumes}
        assert len(grids) == 1, "the library refuses several"
        for n, volume in enumerate(volumes):
            colored = self(volume, references, settings, share_of(progress, n, len(volumes)), cancelled, guard)
            colored.report["time_point"] = {"number": n + 1, "of": len(volumes), "matches_of": min(n + 1, 2)}
            yield colored

    def __call__(self, volume, references, settings=None, progress=None, cancelled=None, guard=None):
        from MedColorLib.errors import Cancelled
        from MedColorLib.volume import ColorVolume

        self.calls.append((volume, references, settings))
        self.guards.append(guard)
        for step in range(self.steps):
            if progress:
                progress(step / self.steps, f"slice {step}")
            if step == self.steps // 2:
                self.in_the_middle()
                if self.error:
                    raise self.error
            time.sleep(self.pause_seconds)
            if cancelled and cancelled():
                raise Cancelled
        rgb = np.zeros((*volume.array.shape, 3), np.uint8)
        rgb[..., :] = (150, 100, 50)
        rgb[volume.array == 0] = 0
        if settings.region:
            inside = np.zeros(rgb.shape[:3], bool)
            inside[tuple(slice(*ends) for ends in settings.region)] = True
            rgb[~inside] = 0
        self.finished += 1
        report = {"settings": settings.to_dict(), "made_by": "stand-in", **self.report}
        confidence = (volume.array != 0).astype(np.uint8) * 75 if settings.confidence else None
        return ColorVolume(rgb, volume.ijk_to_ras, report, confidence=confidence)


def grey_node(name="head", shape=(6, 8, 10), matrix=None, dtype=np.int16):
    """A scalar volume node with distinct voxels, none of them 0."""
    import slicer

    voxels = np.arange(1, 1 + np.prod(shape)).reshape(shape).astype(dtype)
    return slicer.util.addVolumeFromArray(voxels, np.eye(4) if matrix is None else matrix, name)


def label_node(voxels=None, name="tissues"):
    """A label map node, by default on the grid of `grey_node()`: the lower half of the slices 1, the upper half 2."""
    import slicer

    if voxels is None:
        voxels = np.ones((6, 8, 10), np.uint8)
        voxels[3:] = 2
    return slicer.util.addVolumeFromArray(voxels, np.eye(4), name, nodeClassName="vtkMRMLLabelMapVolumeNode")


def color_node(rgb, name="colored"):
    """A colour volume node as MedColor makes them."""
    import slicer

    node = slicer.util.addVolumeFromArray(np.asarray(rgb), name=name, nodeClassName="vtkMRMLVectorVolumeNode")
    node.SetVoxelVectorType(node.VoxelVectorTypeColorRGB)
    return node


def two_colors(size=48, radius=18, left=LEFT, right=RIGHT):
    """(k, j, i, 3): a ball of two colours in black; i below the middle is `left`."""
    center = (size - 1) / 2
    k, j, i = np.mgrid[:size, :size, :size]
    inside = (k - center) ** 2 + (j - center) ** 2 + (i - center) ** 2 < radius**2
    rgb = np.zeros((size, size, size, 3), np.uint8)
    rgb[inside & (i < center)] = left
    rgb[inside & (i > center)] = right
    return rgb


def layout_of(*views):
    """The layout manager of a Slicer with these 3-D views, in this order, as `slicer.app.layoutManager` gives it."""
    manager = types.SimpleNamespace(
        threeDViewCount=len(views), threeDWidget=lambda n: types.SimpleNamespace(threeDView=lambda: views[n])
    )
    return lambda: manager


def view_widget(name="1", visible=True, mapped=None, **more):
    """A 3-D view of Slicer's window; `drawn` holds what was drawn, which is nothing while it is hidden.

    Args:
        mapped: whether the layout has it; as `visible` by default.
        more: attributes in place of the stand-in's.
    """
    import slicer

    node = slicer.vtkMRMLViewNode()
    node.SetLayoutName(name)
    node.SetMappedInLayout(visible if mapped is None else mapped)
    view = types.SimpleNamespace(visible=visible, drawn=[], asked=[], mrmlViewNode=lambda: node)
    view.forceRender = lambda: view.drawn.append(name) if view.visible else None
    view.scheduleRender = lambda: view.asked.append(name)
    view.resetFocalPoint = lambda: None
    view.displayableManagerByClassName = lambda _name: None
    vars(view).update(more)
    return view


def node_ids(scene):
    """What is in a scene, to compare before and after."""
    return [scene.GetNthNode(n).GetID() for n in range(scene.GetNumberOfNodes())]


def look(view, node):
    """What a 3-D view draws of a node, seen from behind: (SIZE, SIZE, 3) int."""
    bounds = [0.0] * 6
    node.GetRASBounds(bounds)
    view.make_plain()
    view.look_at(bounds)
    return view.render().astype(int)


def sides(picture):
    """Colours at the centres of the two halves; RAS x grows to the left of the picture, seen from behind."""
    middle, beside = SIZE // 2, SIZE // 5
    return picture[middle, middle + beside], picture[middle, middle - beside]
