"""Small equivalents of the parts of Slicer's Python that the `slicer-core` wheel does not hold and the module uses.

With MEDCOLOR_SLICER_PYTHON set to the folder that holds an installed Slicer's `slicer/parameterNodeWrapper`, that
original is used in place of the small one, so that the panel's bindings are tried with it too.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import json
import os
import sys
import types
import typing

import slicer
import vtk


class Choice:
    def __init__(self, choices):
        self.choices = list(choices)


class WithinRange:
    def __init__(self, minimum, maximum):
        self.minimum, self.maximum = minimum, maximum


_RESERVED = {
    "allParameters", "default", "isCached", "dataType", "getValue", "setValue", "connectGui", "connectParametersToGui",
    "disconnectGui", "StartModify", "EndModify", "AddObserver", "RemoveObserver", "Modified", "parameterNode",
}  # fmt: skip


def parameterNodeWrapper(cls):
    """Typed fields over a vtkMRMLScriptedModuleNode: nodes as references, everything else as text."""
    hints = typing.get_type_hints(cls, include_extras=True)
    fields = {name: _Field(name, hint, getattr(cls, name, None)) for name, hint in hints.items()}
    reserved = sorted(_RESERVED & set(fields))
    if reserved:
        raise ValueError(f"names of the wrapper itself: {', '.join(reserved)}")
    for name, field in fields.items():
        setattr(cls, name, property(field.read, field.write))
    cls._fields = fields
    for name in ("__init__", "connectParametersToGui", "disconnectGui", "AddObserver", "RemoveObserver", "_update"):
        setattr(cls, name, getattr(_Wrapper, name))
    return cls


class _Field:
    def __init__(self, name, hint, default):
        self.name = name
        self.type, *self.annotations = typing.get_args(hint) if typing.get_origin(hint) else (hint,)
        self.is_node = isinstance(self.type, type) and issubclass(self.type, slicer.vtkMRMLNode)
        self.default = default if default is not None or self.is_node else self.type()

    def read(self, wrapper):
        node = wrapper.parameterNode
        if self.is_node:
            return node.GetNodeReference(self.name)
        text = node.GetParameter(self.name)
        return json.loads(text) if text else self.default

    def write(self, wrapper, value):
        if self.is_node:
            wrapper.parameterNode.SetNodeReferenceID(self.name, value.GetID() if value else None)
            return
        if not isinstance(value, (int, float) if self.type is float else self.type):
            raise TypeError(f"{self.name}: expected {self.type.__name__}, got {value!r}")
        value = self.type(value)
        for rule in self.annotations:
            if isinstance(rule, Choice) and value not in rule.choices:
                raise ValueError(f"{self.name}: {value!r} is not one of {rule.choices}")
            if isinstance(rule, WithinRange) and not rule.minimum <= value <= rule.maximum:
                raise ValueError(f"{self.name}: {value} is outside {rule.minimum} to {rule.maximum}")
        wrapper.parameterNode.SetParameter(self.name, json.dumps(value))


class _Wrapper:
    def __init__(self, parameterNode, prefix=None):
        self.parameterNode, self._connections, self._from_node = parameterNode, {}, False

    def AddObserver(self, event, callback, priority=0.0):
        return self.parameterNode.AddObserver(event, callback, priority)

    def RemoveObserver(self, tag):
        self.parameterNode.RemoveObserver(tag)

    def connectParametersToGui(self, mapping):
        unknown = set(mapping) - set(self._fields)
        if unknown:
            raise ValueError(f"SlicerParameterName without a field: {sorted(unknown)}")
        tag = len(self._connections)
        undo = [_connect(self, self._fields[name], widget) for name, widget in mapping.items()]
        observer = self.parameterNode.AddObserver(vtk.vtkCommand.ModifiedEvent, lambda *_: self._update(tag))
        self._connections[tag] = (undo, observer)
        self._update(tag)
        return tag

    def _update(self, tag):
        if self._from_node:
            return
        self._from_node = True
        try:
            for field, write, _disconnect in self._connections[tag][0]:
                write(getattr(self, field.name))
        finally:
            self._from_node = False

    def disconnectGui(self, tag):
        undo, observer = self._connections.pop(tag)
        self.parameterNode.RemoveObserver(observer)
        for _field, _write, disconnect in undo:
            disconnect()


def _connect(wrapper, field, widget):
    """Tie a widget to a field; returns (field, write to the widget, disconnect)."""
    import ctk
    import qt

    kind = type(widget)
    if kind is slicer.qMRMLNodeComboBox:
        widget.nodeTypes = [field.type.__name__]
        read, write, signal = widget.currentNode, widget.setCurrentNode, widget.currentNodeChanged
    elif kind is qt.QComboBox:
        choices = next(rule.choices for rule in field.annotations if isinstance(rule, Choice))
        widget.clear()
        widget.addItems(choices)
        signal = widget.currentIndexChanged
        read = lambda: choices[widget.currentIndex]  # noqa: E731
        write = lambda value: setattr(widget, "currentIndex", choices.index(value))  # noqa: E731
    elif kind is qt.QCheckBox:
        signal = widget.stateChanged
        read, write = (lambda: widget.checked), (lambda value: setattr(widget, "checked", value))
    elif kind in (qt.QSpinBox, qt.QDoubleSpinBox, ctk.ctkSliderWidget):
        limits = next(rule for rule in field.annotations if isinstance(rule, WithinRange))
        widget.minimum, widget.maximum = limits.minimum, limits.maximum
        signal = widget.valueChanged
        read, write = (lambda: widget.value), (lambda value: setattr(widget, "value", value))
    else:
        raise RuntimeError(f"{kind.__name__} cannot be tied to {field.name}")

    def changed(*_arguments):
        if not wrapper._from_node:
            setattr(wrapper, field.name, read())

    signal.connect(changed)
    return field, write, lambda: signal.disconnect(changed)


class SampleDataLogic:
    """What Slicer 5.8 checks when a sample is registered; the keywords are all that it takes."""

    def __init__(self):
        self.sources = {}

    def registerCustomSampleDataSource(
        self, category="Custom", sampleName=None, uris=None, fileNames=None, nodeNames=None, customDownloader=None,
        thumbnailFileName=None, loadFileTypes=None, loadFiles=None, loadFileProperties=None, checksums=None,
        loadFileType=None,
    ):  # fmt: skip
        assert isinstance(category, str) and isinstance(sampleName, str)
        assert loadFileType is None, "deprecated"
        lists = {"fileNames": fileNames, "nodeNames": nodeNames, "checksums": checksums, "loadFileTypes": loadFileTypes}
        if isinstance(uris, str):
            assert not any(isinstance(value, (list, tuple)) for value in lists.values())
        else:
            count = len(uris)  # None fails here, as it does in Slicer
            assert isinstance(fileNames, (list, tuple)) and len(fileNames) == count
            assert all(value is None or len(value) == count for value in lists.values())
        self.sources[sampleName] = {
            **lists, "category": category, "uris": uris, "customDownloader": customDownloader,
            "thumbnailFileName": thumbnailFileName, "loadFiles": loadFiles, "loadFileProperties": loadFileProperties,
        }  # fmt: skip


class ScriptedLoadableModule:
    def __init__(self, parent):
        self.parent = parent
        self.moduleName = type(self).__name__

    def resourcePath(self, name):
        return os.path.join(os.path.dirname(slicer.util.modulePath(self.moduleName)), "Resources", name)


class ScriptedLoadableModuleWidget:
    def __init__(self, parent=None):
        super().__init__()
        self.moduleName = type(self).__name__[: -len("Widget")]
        self.parent = parent
        self.layout = parent.layout()

    def setup(self):
        pass

    def resourcePath(self, name):
        return os.path.join(os.path.dirname(slicer.util.modulePath(self.moduleName)), "Resources", name)

    def onReload(self):
        slicer.util.reloadScriptedModule(self.moduleName)


class ScriptedLoadableModuleLogic:
    def __init__(self, parent=None):
        self.moduleName = type(self).__name__[: -len("Logic")]

    def getParameterNode(self):
        node = slicer.mrmlScene.GetSingletonNode(self.moduleName, "vtkMRMLScriptedModuleNode")
        if node is None:
            node = slicer.mrmlScene.CreateNodeByClass("vtkMRMLScriptedModuleNode")
            node.UnRegister(None)
            node.SetSingletonTag(self.moduleName)
            node.SetName(self.moduleName)
            node = slicer.mrmlScene.AddNode(node)
        node.SetAttribute("ModuleName", self.moduleName)
        return node


def _unittest_case():
    import unittest

    return unittest.TestCase


class Application:
    """`slicer.app` without a main window."""

    applicationName = "Slicer"

    def __init__(self, qt_application=None):
        self._qt, self.connected = qt_application, {}

    def connect(self, signal, slot):
        if signal not in ("startupCompleted()", "aboutToQuit()", "lastWindowClosed()"):
            raise ValueError(f"signal {signal} does not exist")
        self.connected.setdefault(signal, []).append(slot)

    def disconnect(self, signal, slot):
        """Whether it was connected."""
        known = slot in self.connected.get(signal, [])
        if known:
            self.connected[signal].remove(slot)
        return known

    def emit(self, signal):
        for slot in list(self.connected.get(signal, [])):
            slot()

    def processEvents(self):
        if self._qt:
            self._qt.processEvents()

    def testingEnabled(self):
        return True

    def layoutManager(self):
        return None

    def topLevelWidgets(self):
        """No main window among them."""
        return []


def install(host, qt_application=None) -> None:
    """Complete the `slicer` package for one process."""
    slicer.app = Application(qt_application)
    translation = _module("slicer.i18n")
    translation.tr = lambda text, *_: text
    translation.translate = lambda _context, text: text
    scripted = _module("slicer.ScriptedLoadableModule")
    for cls in (ScriptedLoadableModule, ScriptedLoadableModuleWidget, ScriptedLoadableModuleLogic):
        setattr(scripted, cls.__name__, cls)
    scripted.ScriptedLoadableModuleTest = type("ScriptedLoadableModuleTest", (_unittest_case(),), {})
    if qt_application is not None:
        _install_widgets()
    _install_parameter_node_wrapper()
    module_file = os.path.join(os.path.dirname(os.path.dirname(os.path.dirname(__file__))), "MedColor", "MedColor.py")
    slicer.util.modulePath = lambda _name: module_file


def _module(name):
    module = types.ModuleType(name)
    module.__spec__ = importlib.machinery.ModuleSpec(name, None)
    sys.modules[name] = module
    setattr(slicer, name.rpartition(".")[2], module)
    return module


def _install_widgets() -> None:
    import qt_like_pythonqt as dressed

    sys.modules["qt"], sys.modules["ctk"] = dressed.make_qt(), dressed.make_ctk()
    slicer.qMRMLWidget, slicer.qMRMLNodeComboBox = dressed.MrmlWidget, dressed.NodeComboBox
    for name in ("qMRMLSliderWidget", "qMRMLSpinBox", "qMRMLRangeWidget", "qMRMLCollapsibleButton"):
        setattr(slicer, name, type(name, (), {}))


def _install_parameter_node_wrapper() -> None:
    original = os.environ.get("MEDCOLOR_SLICER_PYTHON")
    if original:
        slicer.__path__.append(os.path.join(original, "slicer"))
        importlib.import_module("slicer.parameterNodeWrapper")
        return
    module = _module("slicer.parameterNodeWrapper")
    module.Choice, module.WithinRange, module.parameterNodeWrapper = Choice, WithinRange, parameterNodeWrapper
