"""PySide6 dressed as Slicer's `qt` and `ctk`: properties as attributes, and the few CTK and qMRML widgets of the panel.

PythonQt shows a Qt property as an attribute (`button.text = "Apply"`), PySide6 as a pair of methods. The properties are
added to the PySide6 classes from their meta-objects. As in Slicer, an attribute that the widget does not have cannot be
set, nor a property to a value of another type (PySide6 itself would take both in silence).
"""

from __future__ import annotations

import types

from PySide6 import QtCore, QtGui, QtUiTools, QtWidgets

_PROPERTY_CLASSES = (
    QtCore.QObject, QtWidgets.QWidget, QtWidgets.QFrame, QtWidgets.QLabel, QtWidgets.QAbstractButton,
    QtWidgets.QPushButton, QtWidgets.QCheckBox, QtWidgets.QComboBox, QtWidgets.QAbstractSpinBox, QtWidgets.QSpinBox,
    QtWidgets.QDoubleSpinBox, QtWidgets.QProgressBar, QtWidgets.QAbstractScrollArea, QtWidgets.QPlainTextEdit,
    QtWidgets.QAbstractItemView, QtWidgets.QListView, QtWidgets.QListWidget, QtWidgets.QLineEdit,
    QtWidgets.QAbstractSlider, QtWidgets.QSlider,
)  # fmt: skip


_KINDS = {"bool": (bool,), "int": (int,), "uint": (int,), "double": (int, float), "QString": (str,)}


def _attribute(name: str, kind: str = "QString") -> property:
    def read(self):
        return QtCore.QObject.property(self, name)

    def write(self, value):
        if type(value) not in _KINDS.get(kind, (type(value),)):
            raise ValueError(f"{self.metaObject().className()}.{name} is a {kind}, not {value!r}")
        if not QtCore.QObject.setProperty(self, name, value):
            raise AttributeError(f"{self.metaObject().className()}.{name} cannot be set to {value!r}")

    return property(read, write)


def _add_properties() -> None:
    for cls in _PROPERTY_CLASSES:
        meta = cls.staticMetaObject
        for index in range(meta.propertyOffset(), meta.propertyCount()):
            name, kind = meta.property(index).name(), meta.property(index).typeName()
            setattr(cls, name, _attribute(name, kind))
    QtCore.QObject.name = _attribute("objectName")


def _no_new_attributes(self, name, value) -> None:
    attribute = getattr(type(self), name, None)
    if isinstance(attribute, QtCore.Property):
        QtCore.QObject.setProperty(self, name, value)
    elif hasattr(type(attribute), "__set__"):
        attribute.__set__(self, value)
    elif name.startswith("_") or isinstance(value, QtCore.SignalInstance):  # what the widgets below and PySide6 keep
        self.__dict__[name] = value
    else:
        raise AttributeError(f"{type(self).__name__} has no attribute {name} to be set")


def _forbid_new_attributes() -> None:
    for module in (QtCore, QtWidgets):
        for cls in vars(module).values():
            if isinstance(cls, type) and issubclass(cls, QtCore.QObject):
                cls.__setattr__ = _no_new_attributes


class MrmlWidget(QtWidgets.QWidget):
    """qMRMLWidget: hands the scene to the widgets that the .ui connects."""

    mrmlSceneChanged = QtCore.Signal(object)
    isEntered = True

    def setMRMLScene(self, scene):
        self.mrmlSceneChanged.emit(scene)
        for child in self.findChildren(NodeComboBox):
            child.setMRMLScene(scene)


class NodeComboBox(QtWidgets.QWidget):
    """qMRMLNodeComboBox over a real scene: filter by class, none entry, follows additions and removals."""

    currentNodeChanged = QtCore.Signal(object)
    nodeAddedByUser = QtCore.Signal(object)

    def __init__(self, parent=None):
        super().__init__(parent)
        self._scene, self._node, self._types, self._tags = None, None, [], []
        self._show_children, self._none_display = True, "None"
        self._box = QtWidgets.QComboBox(self)
        QtWidgets.QVBoxLayout(self).addWidget(self._box)
        self.layout().setContentsMargins(0, 0, 0, 0)
        self._box.activated.connect(self._on_activated)

    def _list(self):
        return self._types

    def _set_list(self, value):
        self._types = list(value)
        self._refresh()

    nodeTypes = QtCore.Property("QStringList", _list, _set_list)
    showChildNodeTypes = QtCore.Property(
        bool, lambda self: self._show_children, lambda self, v: setattr(self, "_show_children", v)
    )
    noneDisplay = QtCore.Property(
        str, lambda self: self._none_display, lambda self, v: setattr(self, "_none_display", v)
    )
    noneEnabled = QtCore.Property(bool, lambda self: True, lambda self, v: None)
    addEnabled = QtCore.Property(bool, lambda self: False, lambda self, v: None)
    removeEnabled = QtCore.Property(bool, lambda self: False, lambda self, v: None)
    renameEnabled = QtCore.Property(bool, lambda self: False, lambda self, v: None)

    def setMRMLScene(self, scene):
        for tag in self._tags:
            self._scene.RemoveObserver(tag)
        self._scene = scene
        events = (scene.NodeAddedEvent, scene.NodeRemovedEvent, scene.EndCloseEvent) if scene else ()
        self._tags = [scene.AddObserver(event, lambda *_: self._refresh()) for event in events]
        self._refresh()

    def nodes(self):
        if self._scene is None:
            return []
        found = [self._scene.GetNthNode(n) for n in range(self._scene.GetNumberOfNodes())]
        return [n for n in found if self._accepts(n)]

    def _accepts(self, node):
        if self._show_children:
            return any(node.IsA(name) for name in self._types)
        return node.GetClassName() in self._types

    def currentNode(self):
        return self._node

    def setCurrentNode(self, node):
        if node is not None and node not in self.nodes():
            node = None
        if node is not self._node:
            self._node = node
            self._refresh()
            self.currentNodeChanged.emit(node)

    def addNode(self):
        """What its entry "Create new ..." does."""
        node = self._scene.AddNewNodeByClass(self._types[0])
        self.setCurrentNode(node)
        self.nodeAddedByUser.emit(node)

    def _on_activated(self, index):
        self.setCurrentNode(([None, *self.nodes()])[index])

    def _refresh(self):
        nodes = self.nodes()
        self._box.clear()
        self._box.addItems([self._none_display, *[node.GetName() for node in nodes]])
        if self._node is not None and self._node not in nodes:
            self._node = None
            self.currentNodeChanged.emit(None)
        self._box.setCurrentIndex(nodes.index(self._node) + 1 if self._node else 0)


class CollapsibleButton(QtWidgets.QWidget):
    """ctkCollapsibleButton: a title over what it holds."""

    def __init__(self, parent=None):
        super().__init__(parent)
        self._text, self._collapsed = "", False
        self.setContentsMargins(0, 22, 0, 0)

    def paintEvent(self, event):
        painter = QtGui.QPainter(self)
        painter.fillRect(0, 0, self.rect.width(), 20, QtGui.QColor(215, 220, 228))
        painter.drawText(8, 15, ("▸ " if self._collapsed else "▾ ") + self._text)

    def _set_text(self, value):
        self._text = value

    def _set_collapsed(self, value):
        self._collapsed = value
        self.setMaximumHeight(22 if value else 16777215)

    text = QtCore.Property(str, lambda self: self._text, _set_text)
    collapsed = QtCore.Property(bool, lambda self: self._collapsed, _set_collapsed)


class SliderWidget(QtWidgets.QWidget):
    """ctkSliderWidget: a slider and a spin box of one value."""

    valueChanged = QtCore.Signal(float)

    def __init__(self, parent=None):
        super().__init__(parent)
        self._slider, self._box = QtWidgets.QSlider(QtCore.Qt.Horizontal), QtWidgets.QDoubleSpinBox()
        self._slider.setRange(0, 1000)
        row = QtWidgets.QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self._slider)
        row.addWidget(self._box)
        self._slider.valueChanged.connect(self._from_slider)
        self._box.valueChanged.connect(self._from_box)

    def _from_slider(self, position):
        low, high = self._box.minimum, self._box.maximum
        if round((self._box.value - low) / (high - low or 1) * 1000) != position:
            self._box.value = low + (high - low) * position / 1000

    def _from_box(self, value):
        low, high = self._box.minimum, self._box.maximum
        self._slider.value = round((value - low) / (high - low or 1) * 1000)
        self.valueChanged.emit(value)

    def _of_box(name, kind):  # makes the properties below
        return QtCore.Property(kind, lambda self: getattr(self._box, name), lambda self, v: setattr(self._box, name, v))

    value, minimum, maximum = _of_box("value", float), _of_box("minimum", float), _of_box("maximum", float)
    singleStep, decimals = _of_box("singleStep", float), _of_box("decimals", int)
    suffix = _of_box("suffix", str)
    pageStep = QtCore.Property(float, lambda self: 0.1, lambda self, v: None)


class PathLineEdit(QtWidgets.QWidget):
    """ctkPathLineEdit: a path and a button to browse."""

    currentPathChanged = QtCore.Signal(str)

    def __init__(self, parent=None):
        super().__init__(parent)
        self._line = QtWidgets.QLineEdit()
        row = QtWidgets.QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self._line)
        row.addWidget(QtWidgets.QPushButton("..."))
        self._line.textChanged.connect(self.currentPathChanged.emit)

    def _set_path(self, value):
        self._line.text = value

    currentPath = QtCore.Property(str, lambda self: self._line.text, _set_path)
    showHistoryButton = QtCore.Property(bool, lambda self: False, lambda self, v: None)
    settingKey = QtCore.Property(str, lambda self: "", lambda self, v: None)


class UiLoader(QtUiTools.QUiLoader):
    """Knows the custom widgets, and keeps every widget alive while its root lives."""

    CLASSES = {  # noqa: RUF012
        "qMRMLWidget": MrmlWidget,
        "qMRMLNodeComboBox": NodeComboBox,
        "ctkCollapsibleButton": CollapsibleButton,
        "ctkSliderWidget": SliderWidget,
        "ctkPathLineEdit": PathLineEdit,
    }
    _alive: list = []  # noqa: RUF012

    def createWidget(self, class_name, parent=None, name=""):
        cls = self.CLASSES.get(class_name)
        widget = cls(parent) if cls else super().createWidget(class_name, parent, name)
        widget.setObjectName(name)
        self._alive.append(widget)
        return widget


def make_qt() -> types.ModuleType:
    """Everything of Qt in one module, as in Slicer."""
    _add_properties()
    _forbid_new_attributes()
    module = types.ModuleType("qt")
    for part in (QtCore, QtGui, QtWidgets, QtUiTools):
        module.__dict__.update({name: getattr(part, name) for name in dir(part) if name.startswith("Q")})
    module.QUiLoader = UiLoader
    return module


def make_ctk() -> types.ModuleType:
    """The CTK widgets of the panel, and stand-ins for those that Slicer's own connectors name."""
    module = types.ModuleType("ctk")
    module.ctkCollapsibleButton = CollapsibleButton
    module.ctkSliderWidget = SliderWidget
    module.ctkPathLineEdit = PathLineEdit
    for name in ("CheckBox", "CheckablePushButton", "DoubleSlider", "DoubleSpinBox", "ComboBox", "RangeWidget",
                 "DoubleRangeSlider", "DirectoryButton", "ColorPickerButton"):  # fmt: skip
        setattr(module, f"ctk{name}", type(f"ctk{name}", (), {}))
    return module
