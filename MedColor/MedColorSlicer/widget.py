"""The panel's life cycle, and how it keeps in line with a scene that changes while it is open."""

from __future__ import annotations

import sys

import slicer
import vtk
from slicer.i18n import tr as _
from slicer.ScriptedLoadableModule import ScriptedLoadableModuleWidget
from slicer.util import VTKObservationMixin

from . import rendering_guard, scene
from .logic import MedColorLogic
from .panel_display import DisplayPart
from .panel_inputs import InputsPart
from .panel_live import LivePart
from .panel_nodes import NodesPart
from .panel_plan import PlanPart
from .panel_preview import PreviewPart
from .panel_run import Runs
from .panel_smoother import SmootherPart
from .panel_volumes import VolumesPart
from .scene_watch import SceneWatch


class MedColorWidget(Runs, ScriptedLoadableModuleWidget, VTKObservationMixin):
    """The module's panel. Widgets are tied to the parameter node; the logic does the work."""

    def __init__(self, parent=None):
        ScriptedLoadableModuleWidget.__init__(self, parent)
        VTKObservationMixin.__init__(self)
        self.logic = None
        self._message = ""
        self._lastInput = None  # ID of the volume that the output was last brought in line with
        self._parameterNode = None
        self._guiTag, self._guiObservers, self._updateTag = None, [], None
        self._closed = False
        self._lost = False  # the parameter node was removed under the open panel

    # --- life cycle -------------------------------------------------------------------------------------------------

    def setup(self):
        ScriptedLoadableModuleWidget.setup(self)
        self._uiWidget = slicer.util.loadUI(self.resourcePath("UI/MedColor.ui"))
        self.layout.addWidget(self._uiWidget)
        self.ui = slicer.util.childWidgetVariables(self._uiWidget)
        self._uiWidget.setMRMLScene(slicer.mrmlScene)
        self.logic = MedColorLogic()
        rendering_guard.guard_of(slicer.mrmlScene)
        self.inputs = InputsPart(self)
        self.nodes = NodesPart(self)
        self.volumes = VolumesPart(self)
        self.smoother = SmootherPart(self)
        self.display = DisplayPart(self)
        self.preview = PreviewPart(self)
        self.plan = PlanPart(self)
        self.live = LivePart(self)
        self.ui.applyButton.clicked.connect(self.onApply)
        self.watch = SceneWatch(slicer.mrmlScene, self)
        slicer.app.connect("lastWindowClosed()", self._onLastWindowClosed)
        self._showBusy(False)
        self._useParameterNode()

    def cleanup(self):
        """The panel is about to be deleted: at exit, and before a reload."""
        self._closed = True
        self._onLastWindowClosed()
        slicer.app.disconnect("lastWindowClosed()", self._onLastWindowClosed)
        self.plan.stop()
        self.live.stop()
        self._setParameterNode(None)
        self.watch.stop()
        self.removeObservers()

    def _onLastWindowClosed(self):
        """Slicer is about to quit, and waits for what runs."""
        if self.job:
            self.job.cancel()

    def enter(self):
        self._useParameterNode()

    def exit(self):
        self.live.stop()
        self.preview.remove()
        self._setParameterNode(None)

    def onReload(self):
        """Slicer reloads MedColor.py alone; the parts and the library are dropped so that they are read again too."""
        rendering_guard.release_guards()
        for name in [n for n in sys.modules if n.split(".")[0] in ("MedColorLib", "MedColorSlicer")]:
            del sys.modules[name]
        ScriptedLoadableModuleWidget.onReload(self)

    @property
    def parameters(self):
        """The parameter node in use, or None while the panel is not shown or the scene is closing."""
        return self._parameterNode

    def _useParameterNode(self):
        self._setParameterNode(self.logic.getParameterNode())
        self._chooseInput()

    def _chooseInput(self):
        """The first volume that can be coloured, while none is chosen."""
        if self._parameterNode and not self._parameterNode.inputVolume:
            for node in slicer.util.getNodesByClass("vtkMRMLScalarVolumeNode"):
                if not scene.input_problem(node) and not scene.is_confidence(node):
                    self._parameterNode.inputVolume = node
                    break

    def _outputOfInput(self):
        """A result belongs to the volume it was made from; another volume gets one of its own."""
        p = self._parameterNode
        chosen = p.inputVolume.GetID() if p.inputVolume else ""
        if chosen == self._lastInput:
            return
        self._lastInput = chosen
        if p.outputVolume and p.inputVolume and not scene.may_be_filled_from(p.outputVolume, p.inputVolume):
            p.outputVolume = scene.result_of(p.inputVolume)

    def _setParameterNode(self, parameterNode):
        self._lost = False
        if self._parameterNode:
            self._disconnectControls()
            # not by the mixin: it would keep the wrapper, and every one of its own observers, until the panel is closed
            self._parameterNode.RemoveObserver(self._updateTag)
        self._parameterNode, self._lastInput = parameterNode, None
        if parameterNode:
            self._connectControls()
            self.inputs.nameChoices()
            self.plan.showTimes()
            self._updateTag = parameterNode.AddObserver(vtk.vtkCommand.ModifiedEvent, self.update)
            self.update()
        else:
            self.watch.follow(())

    def _connectControls(self):
        """Tie the controls to the parameter node, and note every observer that this adds.

        Before Slicer 5.12 connectGui returns no tag, and disconnectGui leaves its observer behind. That observer and the
        wrapper hold each other; once Python collects the two, the node, which lives on in the scene, calls a function
        that is no more, and Slicer crashes.
        """
        wrapper, tags = self._parameterNode, []
        add = wrapper.AddObserver

        def add_and_note(*arguments):
            tags.append(add(*arguments))
            return tags[-1]

        controls = {widget.property("SlicerParameterName"): widget for widget in vars(self.ui).values()}
        wrapper.AddObserver = add_and_note
        try:
            self._guiTag = wrapper.connectParametersToGui({name: w for name, w in controls.items() if name})
        finally:
            del wrapper.AddObserver  # the class has its own
        self._guiObservers = tags

    def _disconnectControls(self):
        self._parameterNode.disconnectGui(self._guiTag)
        for tag in self._guiObservers:
            self._parameterNode.RemoveObserver(tag)
        self._guiTag, self._guiObservers = None, []

    # --- the scene changes -------------------------------------------------------------------------------------------

    def onSceneStart(self):
        """The scene is about to be closed, read or restored; the parameter node, too, may be exchanged."""
        if self.job:
            self.job.cancel(_("The scene was closed or another one opened; nothing was coloured."))
        self.live.forget()
        self.preview.forget()
        self.display.forget()
        self._setParameterNode(None)
        self.say("")

    def onSceneEnd(self):
        """What the scene holds now; as on entering."""
        self.display.update()
        if not self._closed and getattr(self.parent, "isEntered", True):
            self._useParameterNode()

    def onNodeRemoved(self, node):
        """A node is gone."""
        self.stopFor(node)
        self.preview.onNodeRemoved(node)
        self.live.onNodeRemoved(node)
        if self._parameterNode and node is self._parameterNode.parameterNode:
            self._setParameterNode(None)
            self._lost = True

    def onSceneChanged(self, volumesAdded: bool):
        """Nodes came, went or changed."""
        if self._lost and not self._closed:  # somebody removed the choices themselves: new ones
            self._useParameterNode()
        if self._closed or not self._parameterNode:
            return
        if volumesAdded and self.job is None:
            self._chooseInput()
        self.display.onSceneChanged()
        self.update()

    # --- what can be done now ----------------------------------------------------------------------------------------

    def update(self, _caller=None, _event=None):
        """Bring the panel in line with the parameter node."""
        if not self._parameterNode or self._closed:
            return
        self._outputOfInput()
        p, ui = self._parameterNode, self.ui
        nodes = (p.inputVolume, p.outputVolume, p.referenceNode, *self.nodes.nodes(), *self.volumes.others())
        self.watch.follow(scene.behind(*nodes, *self.display.watched()))
        self.inputs.update()
        self.nodes.update()
        self.volumes.update()
        self.smoother.update()
        self.display.update()
        self.say(self._message)
        ui.windowLowSpinBox.enabled = ui.windowHighSpinBox.enabled = not p.windowAutomatic
        ui.lightnessSlider.enabled = p.luminance == "natural"
        ui.firstSliceSpinBox.enabled = ui.lastSliceSpinBox.enabled = not p.allSlices
        if self.job is None:
            missing = self.whatIsMissing()
            ui.applyButton.enabled = ui.previewButton.enabled = not missing
            ui.applyButton.toolTip = missing or _("Colour the volume.")
            ui.previewButton.toolTip = missing or _("Colour the slice shown in the red view, in seconds.")
            ui.followCheckBox.enabled = self.live.on or not missing
            self.plan.changed()
            self.live.changed()

    def whatIsMissing(self) -> str:
        """Why Apply cannot be pressed, as a sentence; empty if it can."""
        p = self._parameterNode
        if p is None:
            return _("The scene is being closed.")
        problem = scene.input_problem(p.inputVolume) or self.inputs.problem() or self.nodes.problem()
        if problem:
            return problem
        if p.outputVolume is not None and p.outputVolume is p.referenceNode and p.referenceSource == "node":
            return _("The coloured volume is the reference; select another one or none.")
        if not p.windowAutomatic and p.windowLow >= p.windowHigh:
            return _("The window is empty: its lower value must be below the upper one.")
        slices = scene.stack_of(p.inputVolume)[1]
        if not p.allSlices and not p.firstSlice <= p.lastSlice < slices:
            return _("The slice range must lie within 0 to {last}.").format(last=slices - 1)
        return ""

    # --- messages ----------------------------------------------------------------------------------------------------

    def say(self, text: str):
        """A line below the buttons; what the state of the scene adds to it follows by itself."""
        self._message = text
        self.sayAgain()

    def sayAgain(self):
        """What the state of the scene adds may have changed."""
        notes = (self.display.note(), self.live.note()) if self._parameterNode else ()
        self.ui.statusLabel.text = " ".join(part for part in (self._message, *notes) if part)
