"""Part of the panel: what will be done and left out, and how long it may take; worked out beside the user's work."""

from __future__ import annotations

import re
import threading

import qt
import slicer
from slicer.i18n import tr as _

from . import dependencies, parameters, running

_DELAY_MS = 400  # after the last change
_POLL_MS = 50
_PATIENCE_SECONDS = 5.0  # a thread that outlives Python takes Slicer down with it
_WAIT_SECONDS = 0.02  # in each poll the worker gets the interpreter for this long
# Seconds per slice on two processor cores, before anything was measured on this computer.
_FIRST_GUESS = {"draft": 0.15, "balanced": 0.4, "full": 8.0}


class PlanPart:
    """Keeps the plan text up to date: one worker at a time, and only the latest question is answered."""

    def __init__(self, panel) -> None:
        self.panel, self.ui = panel, panel.ui
        self._worker, self._answer, self._asked, self._stale = None, None, None, False
        self._slices = None  # how many the latest plan colours
        self._settings = None  # those of the latest question
        self._delay, self._poll = qt.QTimer(), qt.QTimer()
        self._delay.setSingleShot(True)
        self._delay.setInterval(_DELAY_MS)
        self._poll.setInterval(_POLL_MS)
        self._delay.timeout.connect(self.ask)
        self._poll.timeout.connect(self._look)
        self.ui.planDetailsButton.toggled.connect(self._onDetails)
        self.ui.planDetailsButton.enabled = False

    def changed(self) -> None:
        """Something the plan depends on may have changed."""
        self._delay.start()

    def stop(self) -> None:
        """The panel is going away; a worker that still runs ends unheard, if it can before Python itself does."""
        self._delay.stop()
        self._poll.stop()
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.join(_PATIENCE_SECONDS)

    def ask(self) -> None:
        """Begin to work out the plan for the present choices."""
        panel, p = self.panel, self.panel.parameters
        if p is None or panel.job:
            return
        missing = panel.whatIsMissing()
        if missing:
            self._asked = None
            self._tell(missing)
            return
        if dependencies.torch_missing() or dependencies.missing():
            names = ", ".join((["torch"] if dependencies.torch_missing() else []) + dependencies.missing())
            self._tell(
                _(
                    "Python packages are missing: {names}. Apply asks before it installs them; the plan is shown after "
                    "that."
                ).format(names=names)
            )
            return
        question = self._question(p)
        if question == self._asked:
            return
        if self._worker is not None:
            self._stale = True
            return
        self._asked = question
        try:
            self._settings, pictures = parameters.settings_from(p), panel.inputs.references()
            compute = panel.logic.planner(p.inputVolume, pictures, self._settings, **panel.nodes.arguments())
        except Exception as error:  # what is wrong is said in the plan's place
            self._tell(panel.explain(error))
            return
        self._tell(_("Looking at the volume..."))
        self._answer = {}
        self._worker = threading.Thread(target=_work, args=(compute, self._answer), daemon=True, name="MedColor plan")
        self._worker.start()
        self._poll.start()

    def _question(self, p) -> tuple:
        image = p.inputVolume.GetImageData()
        values = [getattr(p, name) for name in _PLAN_FIELDS]
        count = self.panel.volumes.count()
        return (p.inputVolume.GetID(), image.GetMTime(), count, *self.panel.nodes.state(), *values)

    def _look(self) -> None:
        if self._worker is None:
            self._poll.stop()
            return
        self._worker.join(_WAIT_SECONDS)
        if self._worker.is_alive():
            return
        self._poll.stop()
        self._worker = None
        if self._stale:
            self._stale = False
            self.ask()
        elif "error" in self._answer:
            self._tell(self.panel.explain(self._answer["error"]))
        else:
            self._show(self._answer["plan"])

    def _show(self, plan) -> None:
        """The plan, and the colour error that the benchmark measured with these settings."""
        from MedColorLib.run.expected_error import NOT_MEASURED, expected_error

        error = expected_error(self._settings, plan.features)
        # columns of spaces are for fixed-width type; the panel has none
        text = re.sub(r"(?m)^  (\w[\w ]*?) {2,}", r"\1: ", plan.text())
        expected = _("Colour error to expect: {error}").format(error=error.text() if error else NOT_MEASURED)
        count = self.panel.volumes.count() if self.panel.parameters else 1
        self._slices = count * len(plan.slices)
        self.showTimes()
        about = running.readable_seconds(seconds_per_slice(self._settings.preset) * max(self._slices, 1))
        of = _(" of {count} volumes like this one").format(count=count) if count > 1 else ""
        short = _("{slices} slices{of}, about {time} with {features} features.").format(
            slices=self._slices, of=of, time=about, features=plan.features
        )
        about_error = _("Colour error: not measured with these settings")
        if error:
            about_error = _("Colour error {low:.1f} to {high:.1f} CIEDE2000 on test pairs.").format(
                low=error.low, high=error.high
            )
        self._tell(f"{short}\n{about_error}", f"{text}\n{expected}")

    def _tell(self, short: str, details: str = "") -> None:
        """Two lines at most in the panel; all of it behind the button."""
        self.ui.planLabel.text, self.ui.planText.plainText = short, details or short
        self.ui.planDetailsButton.enabled = bool(details)
        self._onDetails()

    def _onDetails(self, *_checked) -> None:
        self.ui.planText.visible = bool(self.ui.planDetailsButton.checked and self.ui.planDetailsButton.enabled)

    def showTimes(self) -> None:
        """Beside the names of the presets, how long each may take; nothing before there is a plan."""
        if self._slices is None:
            return
        names = {"draft": _("Draft"), "balanced": _("Balanced"), "full": _("Full")}
        for index, preset in enumerate(parameters.PRESETS):
            about = running.readable_seconds(seconds_per_slice(preset) * max(self._slices, 1))
            text = _("{preset} (about {time})").format(preset=names[preset], time=about)
            self.ui.presetComboBox.setItemText(index, text)


def seconds_per_slice(preset: str) -> float:
    """What a slice took the last time on this computer, or a first guess."""
    return slicer.util.settingsValue(f"MedColor/SecondsPerSlice/{preset}", _FIRST_GUESS[preset], converter=float)


def learn(preset: str, slices: int, seconds: float) -> None:
    """Remember how long a run took."""
    if slices > 0:
        qt.QSettings().setValue(f"MedColor/SecondsPerSlice/{preset}", seconds / slices)


_PLAN_FIELDS = (
    "referenceSource", "referencePath", "pickedReference", "preset", "features", "smoother", "smootherAutomatic",
    "smootherOptions", "coherenceMm", "luminance", "lightness", "gamma", "exposure", "exposureGain",
    "referenceMaskPath", "body", "groupLabels", "windowAutomatic", "windowLow", "windowHigh",
    "allSlices", "firstSlice", "lastSlice", "device",
)  # fmt: skip


def _work(compute, answer: dict) -> None:
    try:
        with running.a_core_for_the_window():
            answer["plan"] = compute()
    except Exception as error:  # handed over and shown in the panel
        answer["error"] = error
