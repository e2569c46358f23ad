"""Part of the panel: Apply and Cancel, one run at a time, what stops it, and where errors become messages."""

from __future__ import annotations

import dataclasses
import json
import logging

import slicer
from slicer.i18n import tr as _

from . import dependencies, running, scene, sequences
from .labels import grouped_by_name
from .panel_plan import learn
from .parameters import settings_from

_LOG = logging.getLogger("MedColorLib")


@dataclasses.dataclass(frozen=True)
class Choices:
    """What was chosen when Apply was pressed: later changes of the panel concern the next run."""

    references: list
    settings: object
    nodes: dict


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
        self.live.stop()
        self.runJob(self._apply)

    def _apply(self, job):
        """Colour all that is chosen; one that cannot be coloured does not keep the others from it."""
        from MedColorLib.errors import Cancelled

        p = self._parameterNode
        choices = Choices(self.inputs.references(), settings_from(p), self.nodes.arguments())
        work = [(grey, self.volumes.sequence_of(grey)) for grey in self.volumes.chosen()]  # the panel may be left
        done, failed = [], []
        for number, (grey, sequence) in enumerate(work):
            report = sequences.share_of(job.progress, number, len(work), grey.GetName())
            try:
                done.append(self._colour(job, p, grey, sequence, choices, report))
            except Cancelled as error:
                if not done:
                    return " ".join([self.explain(error), *failed])
                text = _("Coloured before that: {names}.").format(names=", ".join(done))
                return " ".join([job.reason or _("Cancelled."), text, *failed])
            except Exception as error:
                if len(work) == 1:
                    raise
                failed.append(f"{grey.GetName()}: {self.explain(error)}")
        self.preview.remove()
        if not done:
            return " ".join(failed)
        text = _("Done in {time}: {names}.").format(
            time=running.readable_seconds(job.elapsed_seconds()), names=", ".join(done)
        )
        if grouped_by_name(p.labels):
            text += " " + _("The segments were grouped by what they are called; the log has the groups.")
        return " ".join([text, *failed])

    def _colour(self, job, p, grey, sequence, choices, report):
        """One volume, or every time point of its sequence; returns the name of the result."""
        if sequence is not None and grey.GetScene() is not None:  # it may have been removed since Apply
            return self._colourSequence(job, p, grey, sequence, choices, report)
        output = p.outputVolume if grey is p.inputVolume else scene.result_of(grey)
        if sequences.sequence_of(output) is not None:
            output = None  # it plays the colours of all time points
        self._workOn(grey, output)
        start = job.elapsed_seconds()
        node = self.logic.process(
            grey,
            choices.references,
            output,
            choices.settings,
            report,
            job.cancelled,
            run=self.runResponsive,
            **choices.nodes,
        )
        self._learn(node, job.elapsed_seconds() - start)
        self._showResult(p, grey, node)
        return node.GetName()

    def _colourSequence(self, job, p, grey, sequence, choices, report):
        self._workOn(None, grey, sequence)  # playing it in the meantime does no harm
        colored = self.logic.processSequence(
            sequence,
            choices.references,
            choices.settings,
            report,
            job.cancelled,
            run=self.runResponsive,
            nodes=choices.nodes,
        )
        player = sequences.shown(colored, grey)
        if player is not None:
            self._showResult(p, grey, player)
        matched = sequences.how_matched(colored)
        return f"{colored.GetName()} ({matched})" if matched else colored.GetName()

    def _showResult(self, p, grey, node):
        """The result of the chosen volume; those of others wait in the scene."""
        if grey is p.inputVolume:
            self.preview.remove()
            self.display.showResult(p, grey, node, here=self._parameterNode is not None)

    def _learn(self, node, seconds: float):
        """How long this took, for the times shown beside the presets."""
        report = json.loads(node.GetAttribute(scene.REPORT_ATTRIBUTE))
        slices = len(report.get("plan", {}).get("slices", ()))
        learn(report["settings"]["preset"], slices, seconds)
        if not self._closed:
            self.plan.showTimes()

    def _workOn(self, volume, *others):
        """The run ends when the voxels of a node are replaced, with which it computes: the result would be worth nothing;
        and when that node, or another one that the result needs, is removed."""
        self.watch.release()
        self._inWork = tuple(node for node in (volume, *others) if node is not None)
        self.watch.guard(volume, self._onSpoiled)

    def runJob(self, action, needsPackages: bool = True, volume=None):
        """Run `action(job)` with progress bar and Cancel; its text, or what went wrong, is shown below the buttons.

        Args:
            volume: node that is computed with; see `_workOn`.
        """
        if self.job:
            return
        self.job = running.Job()
        self._workOn(volume)
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
        self.job.cancel(_("The volume was changed while it was being coloured, which ended the run. Apply again."))

    def stopFor(self, node):
        """A node was removed: the run that needs it ends."""
        if self.job and node in self._inWork:
            self.job.cancel(_("{name} was removed, which ended the run.").format(name=node.GetName()))

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
        ui.previewButton.enabled = ui.followCheckBox.enabled = not busy
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
