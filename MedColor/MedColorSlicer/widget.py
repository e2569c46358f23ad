"""The panel's life cycle, Apply and Cancel, and the one place where errors become messages."""

from __future__ import annotations

import json
import logging
import sys

import slicer
import vtk
from slicer.i18n import tr as _
from slicer.ScriptedLoadableModule import ScriptedLoadableModuleWidget
from slicer.util import VTKObservationMixin

from . import comparison, dependencies, labels, rendering_guard, running, scene
from .logic import MedColorLogic
from .panel_display import DisplayPart
from .panel_inputs import InputsPart
from .panel_plan import PlanPart, learn
from .panel_preview import PreviewPart
from .panel_smoother import SmootherPart
from .parameters import settings_from

_LOG = logging.getLogger("MedColor")


class MedColorWidget(ScriptedLoadableModuleWidget, VTKObservationMixin):
    """The module's panel. Widgets are tied to the parameter node; the logic does the work."""

    def __init__(self, parent=None):
        ScriptedLoadableModuleWidget.__init__(self, parent)
        VTKObservationMixin.__init__(self)
        self.logic = None
        self.job = None  # running.Job while something is being computed
        self._inWork = None  # the volume it is computed from
        self._parameterNode = None
        self._guiTag, self._guiObservers, self._updateTag = None, [], None
        self._closed = False

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
        self.smoother = SmootherPart(self)
        self.display = DisplayPart(self)
        self.preview = PreviewPart(self)
        self.plan = PlanPart(self)
        self.ui.applyButton.clicked.connect(self.onApply)
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.StartCloseEvent, self._onSceneStartClose)
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.EndCloseEvent, self._onSceneEndClose)
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.NodeRemovedEvent, self._onNodeRemoved)
        slicer.app.connect("lastWindowClosed()", self._onLastWindowClosed)
        self._showBusy(False)
        self._useParameterNode()

    def cleanup(self):
        """The panel is about to be deleted: at exit, and before a reload."""
        self._closed = True
        self._onLastWindowClosed()
        slicer.app.disconnect("lastWindowClosed()", self._onLastWindowClosed)
        self.plan.stop()
        self._setParameterNode(None)
        self.removeObservers()

    def _onLastWindowClosed(self):
        """Slicer is about to quit, and waits for what runs."""
        if self.job:
            self.job.cancel()

    def enter(self):
        self._useParameterNode()

    def exit(self):
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
        if not self._parameterNode.inputVolume:
            for node in slicer.util.getNodesByClass("vtkMRMLScalarVolumeNode"):
                if not scene.input_problem(node):
                    self._parameterNode.inputVolume = node
                    break

    def _setParameterNode(self, parameterNode):
        if self._parameterNode:
            self._disconnectControls()
            # not by the mixin: it would keep the wrapper, and every one of its own observers, until the panel is closed
            self._parameterNode.RemoveObserver(self._updateTag)
        self._parameterNode = parameterNode
        if parameterNode:
            self._connectControls()
            self.inputs.nameChoices()
            self.plan.showTimes()
            self._updateTag = parameterNode.AddObserver(vtk.vtkCommand.ModifiedEvent, self.update)
            self.update()

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

    def _onSceneStartClose(self, _caller, _event):
        if self.job:
            self.job.cancel()
        self.preview.forget()
        self._setParameterNode(None)

    def _onSceneEndClose(self, _caller, _event):
        self.display.update()
        if getattr(self.parent, "isEntered", True):
            self._useParameterNode()

    @vtk.calldata_type(vtk.VTK_OBJECT)
    def _onNodeRemoved(self, _caller, _event, node):
        if self.job and node is self._inWork:
            self.job.cancel()
        self.preview.onNodeRemoved(node)

    # --- what can be done now ----------------------------------------------------------------------------------------

    def update(self, _caller=None, _event=None):
        """Bring the panel in line with the parameter node."""
        if not self._parameterNode or self._closed:
            return
        self.inputs.update()
        self.smoother.update()
        self.display.update()
        p, ui = self._parameterNode, self.ui
        ui.windowLowSpinBox.enabled = ui.windowHighSpinBox.enabled = not p.windowAutomatic
        ui.firstSliceSpinBox.enabled = ui.lastSliceSpinBox.enabled = not p.allSlices
        if self.job is None:
            missing = self.whatIsMissing()
            ui.applyButton.enabled = ui.previewButton.enabled = not missing
            ui.applyButton.toolTip = missing or _("Colour the volume.")
            ui.previewButton.toolTip = missing or _("Colour the slice shown in the red view, in seconds.")
            self.plan.changed()

    def whatIsMissing(self) -> str:
        """Why Apply cannot be pressed, as a sentence; empty if it can."""
        p = self._parameterNode
        if p is None:
            return _("The scene is being closed.")
        problem = scene.input_problem(p.inputVolume) or self.inputs.problem() or labels.labels_problem(p.labels)
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

    # --- running -----------------------------------------------------------------------------------------------------

    def onApply(self, _checked=False):
        """Apply, or Cancel while something runs."""
        if self.job:
            self.job.cancel()
            self.ui.applyButton.enabled = False
            self.say(_("Cancelling..."))
            return
        self.runJob(self._apply)

    def _apply(self, job):
        parameters = self._parameterNode
        grey = parameters.inputVolume
        node = self.logic.process(
            grey,
            self.inputs.references(),
            parameters.outputVolume,
            settings_from(parameters),
            job.progress,
            job.cancelled,
            roi=parameters.roi,
            run=self.runResponsive,
            labels=parameters.labels,
        )
        self.preview.remove()
        self._learn(node, job)
        if self._parameterNode:  # None when the user went to another module meanwhile
            parameters.outputVolume = node
        comparison.overlay(slicer.mrmlScene, grey, node, parameters.fade)
        return _("Done in {time}: {name}.").format(
            time=running.readable_seconds(job.elapsed_seconds()), name=node.GetName()
        )

    @staticmethod
    def _learn(node, job):
        """How long this took, for the times shown beside the presets."""
        report = json.loads(node.GetAttribute(scene.REPORT_ATTRIBUTE))
        slices = len(report.get("plan", {}).get("slices", ()))
        learn(report["settings"]["preset"], slices, job.elapsed_seconds())

    def runJob(self, action, needsPackages: bool = True):
        """Run `action(job)` with progress bar and Cancel; its text, or what went wrong, is shown below the buttons."""
        if self.job:
            return
        self.job = running.Job()
        self._inWork = self._parameterNode.inputVolume if self._parameterNode else None
        self._showBusy(True)
        self.say("")
        try:
            if needsPackages:
                dependencies.ensure()
            message = action(self.job)
        except Exception as error:  # the one place where errors become messages
            message = self.explain(error)
        finally:
            self.job, self._inWork = None, None
            if not self._closed:
                self._showBusy(False)
        if not self._closed:
            self.say(message or "")
            self.update()

    def runResponsive(self, function):
        """Compute in a worker thread while the window lives on."""
        return running.run_responsive(function, self._keepAlive)

    def _keepAlive(self):
        if not self._closed:
            fraction, text, left = self.job.state()
            bar = self.ui.progressBar
            bar.value = round(1000 * fraction)
            remaining = _(", {time} left").format(time=running.readable_seconds(left)) if left is not None else ""
            bar.format = f"%p% {text}{remaining}"
        slicer.app.processEvents()

    def _showBusy(self, busy: bool):
        ui = self.ui
        for part in (ui.inputsCollapsibleButton, ui.advancedCollapsibleButton, ui.outputCollapsibleButton):
            part.enabled = not busy
        ui.previewButton.enabled = not busy
        ui.progressBar.visible = busy
        ui.progressBar.value = 0
        ui.progressBar.format = "%p%"
        ui.applyButton.text = _("Cancel") if busy else _("Apply")
        if busy:
            ui.applyButton.enabled = True
            ui.applyButton.toolTip = _("Stop; the scene stays as it was.")

    # --- messages ----------------------------------------------------------------------------------------------------

    def say(self, text: str):
        """A line below the buttons."""
        self.ui.statusLabel.text = text

    def explain(self, error: BaseException) -> str:
        """What a person can do about an error; the log gets the rest."""
        from MedColorLib.errors import Cancelled, MedColorError

        if isinstance(error, Cancelled):
            return _("Cancelled; the scene is as it was.")
        if isinstance(error, (MedColorError, dependencies.NotInstalled)):
            return str(error)
        if isinstance(error, MemoryError):
            return _("Not enough memory. Crop the volume, or choose the preset draft or a slice range.")
        _LOG.error("unexpected error", exc_info=error)
        return _("Unexpected error: {error}. The error log (View menu) has the details.").format(
            error=f"{type(error).__name__}: {error}"
        )
