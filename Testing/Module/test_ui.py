"""`MedColor.ui` names only properties, signals and slots that exist: Qt Designer's loader passes over wrong ones in silence."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from xml.etree import ElementTree

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
UI = REPOSITORY / "MedColor" / "Resources" / "UI" / "MedColor.ui"
INTROSPECTED = REPOSITORY.parent / "shared" / "slicer-widgets.json"

# The custom widgets of the panel as Slicer 5.8 has them: own properties, the Qt class whose properties they share, slots.
CUSTOM = {
    "qMRMLWidget": (set(), "QWidget", {"setMRMLScene(vtkMRMLScene*)"}),
    "qMRMLNodeComboBox": (
        {"currentNodeID", "currentNodeId", "nodeTypes", "showHidden", "showChildNodeTypes", "hideChildNodeTypes",
         "baseName", "noneEnabled", "addEnabled", "removeEnabled", "editEnabled", "renameEnabled",
         "interactionNodeSingletonTag", "selectNodeUponCreation", "noneDisplay", "sizeAdjustPolicy"},
        "QWidget",
        {"setMRMLScene(vtkMRMLScene*)"},
    ),
    "ctkCollapsibleButton": (
        {"collapsed", "collapsedHeight", "flat", "contentsFrameShape", "contentsFrameShadow", "contentsLineWidth",
         "contentsMidLineWidth", "buttonTextAlignment", "indicatorAlignment"},
        "QAbstractButton",
        set(),
    ),
    "ctkSliderWidget": (
        {"decimals", "singleStep", "pageStep", "minimum", "maximum", "value", "prefix", "suffix", "tickInterval",
         "tickPosition", "synchronizeSiblings", "spinBoxAlignment", "tracking", "spinBoxVisible", "popupSlider",
         "invertedAppearance", "invertedControls"},
        "QWidget",
        set(),
    ),
    "ctkPathLineEdit": (
        {"label", "filters", "currentPath", "options", "settingKey", "showBrowseButton", "showHistoryButton",
         "sizeAdjustPolicy", "minimumContentsLength", "nameFilters"},
        "QWidget",
        set(),
    ),
}  # fmt: skip
NEEDS_NO_TOOL_TIP = {"QLabel", "QProgressBar", "ctkCollapsibleButton", "qMRMLWidget"}


def qt_properties(class_name: str) -> set[str]:
    widgets = pytest.importorskip("PySide6.QtWidgets", reason="PySide6-Essentials is not installed")
    meta = getattr(widgets, class_name).staticMetaObject
    return {meta.property(index).name() for index in range(meta.propertyCount())}


def allowed_properties(class_name: str) -> set[str]:
    own, base, _slots = CUSTOM.get(class_name, (set(), class_name, set()))
    return own | qt_properties(base)


def lint(text: str) -> list[str]:
    """What is wrong with a .ui file, one line each."""
    root = ElementTree.fromstring(text)
    problems, names = [], []
    for widget in root.iter("widget"):
        kind, name = widget.get("class"), widget.get("name")
        names.append(name)
        static = {p.get("name") for p in widget.findall("property") if p.get("stdset") != "0"}
        problems += [f"{name}: {kind} has no property {bad}" for bad in sorted(static - allowed_properties(kind))]
        if kind not in NEEDS_NO_TOOL_TIP and "toolTip" not in static:
            problems.append(f"{name}: no tool-tip")
        if kind not in CUSTOM and not kind.startswith("Q"):
            problems.append(f"{name}: {kind} is not among the custom widgets")
    problems += [f"{name}: used twice" for name in set(names) if names.count(name) > 1]
    custom = {c.findtext("class") for c in root.iter("customwidget")}
    used = {w.get("class") for w in root.iter("widget")}
    problems += [f"{kind}: not declared as custom widget" for kind in sorted((used & set(CUSTOM)) - custom)]
    kinds = {w.get("name"): w.get("class") for w in root.iter("widget")}
    for connection in root.iter("connection"):
        receiver, slot = connection.findtext("receiver"), connection.findtext("slot")
        if slot not in CUSTOM.get(kinds.get(receiver), (0, 0, set()))[2]:
            problems.append(f"{receiver}: no slot {slot}")
    connected = {c.findtext("receiver") for c in root.iter("connection")}
    problems += [
        f"{name}: gets no scene"
        for name, kind in kinds.items()
        if kind == "qMRMLNodeComboBox" and name not in connected
    ]
    return problems


def parameter_fields() -> set[str]:
    source = (REPOSITORY / "MedColor" / "MedColorSlicer" / "parameters.py").read_text(encoding="utf-8")
    (node,) = [n for n in ast.parse(source).body if isinstance(n, ast.ClassDef)]
    return {statement.target.id for statement in node.body if isinstance(statement, ast.AnnAssign)}


def test_panel_has_no_misspelt_names():
    assert lint(UI.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("right", "wrong", "words"),
    [
        ('name="noneDisplay"', 'name="noneDisply"', "has no property noneDisply"),
        ('name="readOnly"', 'name="readonly"', "has no property readonly"),
        ('name="collapsed"', 'name="colapsed"', "has no property colapsed"),
        ("<slot>setMRMLScene(vtkMRMLScene*)</slot>", "<slot>setScene(vtkMRMLScene*)</slot>", "no slot setScene"),
        ('name="inputSelector"', 'name="outputSelector"', "used twice"),
        ("<receiver>roiSelector</receiver>", "<receiver>inputSelector</receiver>", "roiSelector: gets no scene"),
    ],
)
def test_lint_finds_mistakes(right, wrong, words):
    text = UI.read_text(encoding="utf-8")
    assert right in text
    assert any(words in problem for problem in lint(text.replace(right, wrong, 1)))


def test_parameter_names_are_fields_of_the_parameter_node():
    root = ElementTree.fromstring(UI.read_text(encoding="utf-8"))
    tied = [p.findtext("string") for p in root.iter("property") if p.get("name") == "SlicerParameterName"]
    assert len(tied) == len(set(tied))
    assert set(tied) <= parameter_fields()
    assert parameter_fields() - set(tied) == {
        "referencePath",
        "pickedReference",
        "referenceMaskNode",
        "referenceMaskPath",
        "bodyNode",
        "roi",
        "labels",
        "smootherOptions",
        "show3D",
    }


def test_allow_list_agrees_with_an_introspected_slicer():
    if not INTROSPECTED.is_file():
        pytest.skip(f"{INTROSPECTED.name} is not beside the repository")
    known = json.loads(INTROSPECTED.read_text(encoding="utf-8"))
    for kind, (properties, _base, slots) in CUSTOM.items():
        real = {name for name, _type in known[kind]["properties"]} | {n for n, _t in known["QWidget"]["properties"]}
        assert properties <= real, kind
        assert slots <= set(known[kind]["slots"]), kind
    root = ElementTree.fromstring(UI.read_text(encoding="utf-8"))
    for widget in root.iter("widget"):
        real = {
            n for n, _t in known["QWidget"]["properties"] + known.get(widget.get("class"), {}).get("properties", [])
        }
        used = {p.get("name") for p in widget.findall("property") if p.get("stdset") != "0"}
        assert used <= real, widget.get("name")


def test_names_used_in_the_code_are_in_the_ui():
    root = ElementTree.fromstring(UI.read_text(encoding="utf-8"))
    names = {w.get("name") for w in root.iter("widget")}
    for part in (REPOSITORY / "MedColor" / "MedColorSlicer").glob("*.py"):
        for node in ast.walk(ast.parse(part.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                owner = node.value
                is_ui = (isinstance(owner, ast.Attribute) and owner.attr == "ui") or (
                    isinstance(owner, ast.Name) and owner.id == "ui"
                )
                assert not is_ui or node.attr in names, f"{part.name}:{node.lineno} ui.{node.attr}"


# Methods that the code calls and that are neither properties, signals nor slots; all of them are in Qt 5.15, CTK or qMRML.
METHODS = {
    "QComboBox": {"addItem", "setItemText", "itemText"},
    "QListWidget": {"addItem", "row"},
    "QWidget": {"layout", "grab", "property"},
    "qMRMLNodeComboBox": {"currentNode"},
}


def names_of(known: dict, kind: str) -> set[str]:
    """What a widget of this class has in Slicer: properties, signals, slots."""
    found = set()
    for name in ("QWidget", kind):
        entry = known.get(name, {"properties": [], "signals": [], "slots": []})
        found |= {prop for prop, _type in entry["properties"]}
        found |= {method.partition("(")[0] for method in entry["signals"] + entry["slots"]}
        found |= METHODS.get(name, set())
    return found


def uses_of_widgets(tree: ast.AST):
    """(widget name, attribute, line) for every `ui.widget.attribute`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute):
            owner = node.value.value
            if getattr(owner, "attr", getattr(owner, "id", "")) == "ui":
                yield node.value.attr, node.attr, node.lineno


def test_what_the_code_asks_of_a_widget_an_introspected_slicer_has():
    if not INTROSPECTED.is_file():
        pytest.skip(f"{INTROSPECTED.name} is not beside the repository")
    known = json.loads(INTROSPECTED.read_text(encoding="utf-8"))
    kinds = {w.get("name"): w.get("class") for w in ElementTree.parse(UI).getroot().iter("widget")}
    seen = 0
    for part in (REPOSITORY / "MedColor" / "MedColorSlicer").glob("*.py"):
        for widget, attribute, line in uses_of_widgets(ast.parse(part.read_text(encoding="utf-8"))):
            seen += 1
            assert attribute in names_of(known, kinds[widget]), f"{part.name}:{line} {widget}.{attribute}"
    assert seen > 60
    assert "tooltip" not in names_of(known, "QPushButton")


def test_names_of_slicer_and_its_application_are_there():
    """`slicer.util.x` and `slicer.app.x` of the module exist in Slicer 5.8."""
    if not INTROSPECTED.is_file():
        pytest.skip(f"{INTROSPECTED.name} is not beside the repository")
    known = json.loads(INTROSPECTED.read_text(encoding="utf-8"))
    folders = (REPOSITORY / "MedColor", REPOSITORY / "MedColor" / "MedColorSlicer", REPOSITORY / "Testing" / "Slicer")
    seen = set()
    for part in (path for folder in folders for path in folder.glob("*.py")):
        for node in ast.walk(ast.parse(part.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute):
                owner = ast.unparse(node.value)
                if owner in ("slicer.util", "slicer.app"):
                    seen.add(f"{owner}.{node.attr}")
                    assert node.attr in known[owner], f"{part.name}:{node.lineno} {owner}.{node.attr}"
    assert len(seen) > 20
