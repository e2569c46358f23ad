"""The panel over real MRML: what its controls are tied to, what can be pressed and why not, what is said before Apply."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import types

import pytest
import slicer
from host_fixtures import color_node, grey_node, label_node
from panel_fixtures import PICTURE, wait_for
from panel_fixtures import shown as shown_widget

MODULE_FOLDER = os.path.join(os.path.dirname(__file__), "..", "..", "MedColor")


# --- set-up ---------------------------------------------------------------------------------------------------------


def test_setup_imports_nothing_heavy(qt_host):
    """In a process of its own: other cases of this file do import torch."""
    code = (
        f"import sys; sys.path.insert(0, r'{os.path.dirname(__file__)}'); import host_fixtures, mrml, slicer_like; "
        "from PySide6 import QtWidgets; app = QtWidgets.QApplication([]); host = mrml.HostScene(); "
        "slicer_like.install(host, app); sys.modules['torch'] = sys.modules['cv2'] = sys.modules['scipy'] = None; "
        "import MedColor, qt, slicer; parent = slicer.qMRMLWidget(); parent.setLayout(qt.QVBoxLayout()); "
        "panel = MedColor.MedColorWidget(parent); panel.setup(); print(panel.ui.applyButton.toolTip)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Select a volume to colour." in done.stdout


def test_only_light_imports_at_module_top():
    """What Slicer loads at start-up names no heavy package outside functions."""
    heavy = {"torch", "cv2", "scipy", "numpy", "SimpleITK", "safetensors"}  # MedColorLib itself loads none of them
    files = [os.path.join(MODULE_FOLDER, "MedColor.py")]
    parts = os.path.join(MODULE_FOLDER, "MedColorSlicer")
    files += [os.path.join(parts, name) for name in os.listdir(parts) if name.endswith(".py")]
    for path in files:
        with open(path, encoding="utf-8") as stream:
            tree = ast.parse(stream.read())
        for node in tree.body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            assert not heavy & {name.split(".")[0] for name in names}, path


def test_texts_are_translatable_as_written():
    """`_()` takes plain strings: an f-string would never be found by the translation tools."""
    parts = os.path.join(MODULE_FOLDER, "MedColorSlicer")
    calls = 0
    for name in os.listdir(parts):
        if not name.endswith(".py"):
            continue
        with open(os.path.join(parts, name), encoding="utf-8") as stream:
            tree = ast.parse(stream.read())
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "_":
                calls += 1
                assert isinstance(node.args[0], ast.Constant), f"{name}:{node.lineno}"
    assert calls > 50


def test_every_field_has_a_control_bound_both_ways(ready):
    from MedColorSlicer import parameters

    hand_bound = {
        "referencePath", "pickedReference", "roi", "labels", "smootherOptions", "show3D", "bodyNode", "referenceMaskNode",
        "referenceMaskPath",
    }  # fmt: skip
    bound = {w.property("SlicerParameterName"): w for w in vars(ready.ui).values() if w.property("SlicerParameterName")}
    fields = set(parameters.MedColorParameterNode.__annotations__)
    assert set(bound) == fields - hand_bound
    p = ready.parameters
    check_node_control(p, "roi", ready.ui.roiSelector)
    check_node_control(p, "labels", ready.ui.labelsSelector)
    check_node_control(p, "bodyNode", ready.ui.bodySelector)
    check_node_control(p, "referenceMaskNode", ready.ui.referenceMaskSelector)
    for name, widget in bound.items():
        kind = type(widget).__name__
        if kind == "NodeComboBox":
            check_node_control(p, name, widget)
        elif kind == "QComboBox":
            for index in (widget.count - 1, 0, 1):
                widget.currentIndex = index
                first = getattr(p, name)
                widget.currentIndex = 0
                setattr(p, name, first)
                assert widget.currentIndex == index, name
            assert widget.count == len({widget.itemText(n) for n in range(widget.count)})
        elif kind == "QCheckBox":
            for value in (True, False, True):
                widget.checked = value
                assert getattr(p, name) is value
                setattr(p, name, not value)
                assert widget.checked is (not value)
        else:
            middle = 0.25 if widget.maximum <= 1 else 4
            widget.value = middle
            assert getattr(p, name) == middle
            setattr(p, name, middle * 2)
            assert widget.value == middle * 2


def check_node_control(p, name, widget):
    make = {
        "inputVolume": grey_node,
        "roi": lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLMarkupsROINode"),
        "labels": label_node,
        "bodyNode": label_node,
        "referenceMaskNode": label_node,
    }.get(name, lambda: color_node(PICTURE))
    first, second = make(), make()
    widget.setCurrentNode(first)
    assert getattr(p, name) is first
    setattr(p, name, second)
    assert widget.currentNode() is second
    setattr(p, name, None)
    assert widget.currentNode() is None


def test_choices_and_defaults_are_those_of_the_library(panel):
    from MedColorSlicer import parameters

    from MedColorLib import parameters as library
    from MedColorLib.rendering import presets

    assert list(library.PRESETS) == parameters.PRESETS
    assert sorted(library.FEATURES) == sorted(parameters.FEATURES)
    assert sorted(library.SMOOTHERS) == sorted(parameters.SMOOTHERS)
    assert sorted(library.LUMINANCE) == sorted(parameters.LUMINANCES)
    assert parameters.settings_from(panel.parameters) == library.Settings()
    assert panel.parameters.opacity == presets.DEFAULT_OPACITY


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("referencePathLineEdit", "referencePath"),
        ("referenceFolderLineEdit", "referencePath"),
        ("referenceMaskLineEdit", "referenceMaskPath"),
    ],
)
def test_path_is_bound_both_ways(panel, tmp_path, name, field):
    line = getattr(panel.ui, name)
    line.currentPath = str(tmp_path)
    assert getattr(panel.parameters, field) == str(tmp_path)
    setattr(panel.parameters, field, "/elsewhere")
    assert line.currentPath == "/elsewhere"


def test_selectors_offer_the_right_nodes(ready):
    labels = label_node()
    segmentation = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode")
    roi = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLMarkupsROINode")
    offered = ready.ui.inputSelector.nodes()
    assert ready.parameters.inputVolume in offered
    assert labels not in offered
    assert ready.parameters.referenceNode not in offered
    assert ready.ui.roiSelector.nodes() == [roi]
    assert set(ready.ui.labelsSelector.nodes()) == {labels, segmentation}


@pytest.mark.parametrize(
    ("source", "visible"),
    [
        ("files", {"referencePathLineEdit"}),
        ("node", {"referenceSelector"}),
        ("recommended", {"referenceFolderLineEdit", "recommendButton", "recommendedList"}),
        ("sample", set()),
    ],
)
def test_rows_follow_the_kind_of_reference(panel, source, visible):
    panel.parameters.referenceSource = source
    rows = {
        "referencePathLineEdit",
        "referenceFolderLineEdit",
        "referenceSelector",
        "recommendButton",
        "recommendedList",
    }
    assert {name for name in rows if shown_widget(getattr(panel.ui, name))} == visible


# --- what is missing -------------------------------------------------------------------------------------------------

MISSING = {
    "no volume": (lambda p: setattr(p, "inputVolume", None), "Select a volume"),
    "volume without voxels": (
        lambda p: setattr(p, "inputVolume", slicer.mrmlScene.AddNewNodeByClass("vtkMRMLScalarVolumeNode")),
        "no voxels",
    ),
    "no reference": (lambda p: setattr(p, "referenceNode", None), "Select a colour volume"),
    "no path": (lambda p: setattr(p, "referenceSource", "files"), "Choose a colour picture"),
    "absent path": (
        lambda p: (setattr(p, "referenceSource", "files"), setattr(p, "referencePath", "/absent")),
        "no file or folder",
    ),
    "nothing recommended": (lambda p: setattr(p, "referenceSource", "recommended"), "press Recommend"),
    "empty window": (
        lambda p: (setattr(p, "windowAutomatic", False), setattr(p, "windowLow", 300.0)),
        "window is empty",
    ),
    "slices outside": (lambda p: (setattr(p, "allSlices", False), setattr(p, "lastSlice", 6)), "within 0 to 5"),
    "slices reversed": (lambda p: (setattr(p, "allSlices", False), setattr(p, "firstSlice", 3)), "within 0 to 5"),
    "output is the reference": (lambda p: setattr(p, "outputVolume", p.referenceNode), "is the reference"),
}


@pytest.mark.parametrize("case", MISSING)
def test_apply_says_what_is_missing(ready, case):
    assert ready.ui.applyButton.enabled
    change, words = MISSING[case]
    change(ready.parameters)
    assert not ready.ui.applyButton.enabled
    assert not ready.ui.previewButton.enabled
    assert words in ready.ui.applyButton.toolTip
    ready.plan.ask()
    assert words in ready.ui.planText.plainText


def test_first_volume_of_the_scene_is_chosen(panel):
    grey = grey_node()
    panel.exit()
    panel.enter()
    assert panel.parameters.inputVolume is grey


def test_plan_and_times_are_readable_before_apply(ready, monkeypatch):
    import MedColorLib
    from MedColorLib.run.expected_error import NOT_MEASURED, expected_error

    plan = types.SimpleNamespace(text=lambda: "left out: nothing", slices=tuple(range(40)), features="embedded")
    monkeypatch.setattr(MedColorLib, "make_plan", lambda *_, **_options: plan)
    wait_for(lambda: ready.ui.planText.plainText.startswith("left out: nothing"))
    measured = expected_error(MedColorLib.Settings(preset=ready.parameters.preset), "embedded")
    assert len(ready.ui.planLabel.text.splitlines()) == 2
    assert ready.ui.planLabel.text.startswith("40 slices, about")
    assert max(map(len, ready.ui.planLabel.text.splitlines())) < 60, "two lines on the screen, too"
    assert not shown_widget(ready.ui.planText)
    ready.ui.planDetailsButton.click()
    assert shown_widget(ready.ui.planText)
    assert ready.ui.planText.plainText.endswith(
        f"Colour error to expect: {measured.text() if measured else NOT_MEASURED}"
    )
    assert [ready.ui.presetComboBox.itemText(n).split(" (about ")[0] for n in range(3)] == ["Draft", "Balanced", "Full"]
    assert "min" in ready.ui.presetComboBox.itemText(2)
    shown = [ready.ui.presetComboBox.itemText(n) for n in range(3)]
    ready.exit()
    ready.enter()
    assert [ready.ui.presetComboBox.itemText(n) for n in range(3)] == shown


def test_times_are_learnt_from_runs(ready):
    from MedColorSlicer import panel_plan

    first = panel_plan.seconds_per_slice("full")
    panel_plan.learn("full", 10, 30.0)
    assert panel_plan.seconds_per_slice("full") == 3.0 != first
    panel_plan.learn("full", 0, 30.0)
    assert panel_plan.seconds_per_slice("full") == 3.0
    panel_plan.learn("full", 1, first)


def test_plan_error_is_shown_in_its_place(ready, monkeypatch):
    import MedColorLib
    from MedColorLib.errors import InputError

    def fail(*_, **_options):
        raise InputError("the picture has no colour")

    monkeypatch.setattr(MedColorLib, "make_plan", fail)
    wait_for(lambda: ready.ui.planText.plainText == "the picture has no colour")
