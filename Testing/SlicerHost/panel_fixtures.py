"""The panel over real MRML, as fixtures of the cases that click it."""

from __future__ import annotations

import sys
import time
import types

import numpy as np
import pytest
import slicer
import vtk
from host_fixtures import color_node, empty, grey_node

PICTURE = np.random.default_rng(0).integers(0, 256, (1, 16, 16, 3), dtype=np.uint8)


@pytest.fixture
def panel(qt_host, monkeypatch):
    """The panel in an empty scene, with plans answered at once; nothing may go wrong unseen in a slot."""
    import qt

    import MedColor

    empty(slicer.mrmlScene)
    uncaught = []
    monkeypatch.setattr(sys, "excepthook", lambda *error: uncaught.append(error))
    widget = open_panel(MedColor, qt)
    yield widget
    close_panel(slicer.modules.medcolor.widgetRepresentation().self())
    assert not uncaught, uncaught[0]


def open_panel(module, qt):
    parent = slicer.qMRMLWidget()
    parent.setLayout(qt.QVBoxLayout())
    parent.setMRMLScene(slicer.mrmlScene)
    widget = module.MedColorWidget(parent)
    widget.setup()
    representation = types.SimpleNamespace(self=lambda: widget, isEntered=True, enter=widget.enter, exit=widget.exit)
    slicer.modules.medcolor = types.SimpleNamespace(widgetRepresentation=lambda: representation)
    return widget


def close_panel(widget):
    widget.cleanup()
    widget.parent.setMRMLScene(None)
    widget.parent.deleteLater()


@pytest.fixture
def ready(panel, library, monkeypatch):
    """The panel with everything chosen that Apply needs."""
    from MedColorSlicer import dependencies

    monkeypatch.setattr(dependencies, "ensure", lambda: None)
    library.pause_seconds = 0.03
    panel.parameters.inputVolume = grey_node()
    panel.parameters.referenceNode = color_node(PICTURE, "picture")
    panel.parameters.referenceSource = "node"
    return panel


def shown(widget):
    return not widget.isHidden()


def wait_for(condition, seconds=30):
    import qt

    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        qt.QApplication.processEvents()
        time.sleep(0.005)


def ui_settled():
    """What was put off to the next turn of the event loop has happened."""
    import qt

    for _turn in range(3):
        qt.QApplication.processEvents()


def warp(scene, millimetres=1.0):
    """A transform without a matrix: from the world to what lies under it, so far along every axis."""
    node = scene.AddNewNodeByClass("vtkMRMLGridTransformNode", "warp")
    grid = vtk.vtkImageData()
    grid.SetDimensions(4, 4, 4)
    grid.SetSpacing(16, 16, 16)
    grid.AllocateScalars(vtk.VTK_DOUBLE, 3)
    grid.GetPointData().GetScalars().Fill(millimetres)
    transform = slicer.vtkOrientedGridTransform()
    transform.SetDisplacementGridData(grid)
    node.SetAndObserveTransformFromParent(transform)
    return node


def turned(scene, degrees):
    node = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "turn")
    transform = vtk.vtkTransform()
    transform.RotateX(degrees)
    node.SetMatrixTransformToParent(transform.GetMatrix())
    return node


@pytest.fixture
def red_view(ready):
    """The red slice view; as a singleton it would outlive the scene."""
    view = slicer.vtkMRMLSliceNode()
    for put in (view.SetName, view.SetLayoutName, view.SetSingletonTag):
        put("Red")
    slicer.mrmlScene.AddNode(view)
    yield view
    ready.exit()
    slicer.mrmlScene.RemoveNode(view)
