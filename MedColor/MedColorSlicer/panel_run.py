"""Part of the panel: Apply and Cancel, one run at a time, what stops it, and where errors become messages."""

from __future__ import annotations

import json
import logging

import slicer
from slicer.i18n import tr as _

from . import dependencies, running, scene
from .labels import grouped_by_name
from .panel_plan import learn
from .parameters import settings_from

_LOG = logging.getLogger("MedColorLib")


class Runs:
    """Mixed into the panel; needs its `ui`, `logic`, `watch`, `preview`, `display`, `plan` and parameter node."""

    job = None  # running.Job while something is being computed
    _inWork: tuple = ()  # the nodes it is about: it ends when one of them goes

    def onApply(self, _checked=False):
        """Apply, or Cancel while something runs."""
        if self.job:
            self.job.cancel()
            self.ui.applyButton.enabled = False
            self.say(_("Cancelling..."))
            return
        p = self._parameterNode
        self.runJob(self._apply, volume=p.inputVolume, others=(p.outputVolume,))

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
        self.display.showResult(parameters, grey, node, here=self._parameterNode is not None)
        done = _("Done in {time}: {name}.").format(
            time=running.readable_seconds(job.elapsed_seconds()), name=node.GetName()
        )
        if grouped_by_name(parameters.labels):
            done += " " + _("The segments were grouped by what they are called; the log has the groups.")
        return done

    def _learn(self, node, job):
        """How long this took, for the times shown beside the presets."""
        report = json.loads(node.GetAttribute(scene.REPORT_ATTRIBUTE))
        slices = len(report.get("plan", {}).get("slices", ()))
        learn(report["settings"]["preset"], slices, job.elapsed_seconds())
        if not self._closed:
            self.plan.showTimes()

    def runJob(self, action, needsPackages: bool = True, volume=None, others=()):
        """Run `action(job)` with progress bar and Cancel; its text, or what went wrong, is shown below the buttons.

        Args:
            volume: node whose voxels are computed with; when they are replaced, what is computed is worth nothing, and the
                run ends at once.
            others: nodes that the result needs; the run ends when one of them, or `volume`, is removed.
        """
        if self.job:
            return
        self.job = running.Job()
        self._inWork = tuple(node for node in (volume, *others) if node is not None)
        self.watch.guard(volume, self._onSpoiled)
        self._showBusy(True)
        self.say("")
        try:
            if needsPackages:
                dependencies.ensure()
            message = action(self.job)
        except Exception as error:  # the one place where errors become messages
            message = self.explain(error)
        finally:
            self.watch.release()
            self.job, self._inWork = None, ()
            running.status("")
            if not self._closed:
                self._showBusy(False)
        if not self._closed:
            self.say(message or "")
            self.update()

    def _onSpoiled(self):
        self.job.cancel(_("The volume was changed while it was being coloured; nothing was changed. Apply again."))

    def stopFor(self, node):
        """A node was removed: the run that needs it ends."""
        if self.job and node in self._inWork:
            self.job.cancel(_("{name} was removed; the rest of the scene is as it was.").format(name=node.GetName()))

    def runResponsive(self, function):
        """Compute in a worker thread while the window lives on."""
        return running.run_responsive(function, self._keepAlive)

    def _keepAlive(self):
        fraction, text, left = self.job.state()
        if not self._closed:
            bar = self.ui.progressBar
            bar.value = round(1000 * fraction)
            remaining = _(", {time} left").format(time=running.readable_seconds(left)) if left is not None else ""
            bar.format = f"%p% {text}{remaining}"
        running.status(_("MedColor: {percent} % {text}").format(percent=round(100 * fraction), text=text))
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

    def explain(self, error: BaseException) -> str:
        """What a person can do about an error; the log gets the rest."""
        from MedColorLib.errors import Cancelled, MedColorError

        if isinstance(error, Cancelled):
            return (self.job.reason if self.job else "") or _("Cancelled; the scene is as it was.")
        if isinstance(error, MedColorError):
            return str(error)
        if isinstance(error, MemoryError):
            return _("Not enough memory. Crop the volume, or choose the preset draft or a slice range.")
        if isinstance(error, ModuleNotFoundError):
            return str(dependencies.absent(error))
        _LOG.error("unexpected error", exc_info=error)
        return _("Unexpected error: {error}. The error log (View menu) has the details.").format(
            error=f"{type(error).__name__}: {error}"
        )
