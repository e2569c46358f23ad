"""Part of the panel: the slices that the views show, in colour while one scrolls and moves sliders."""

from __future__ import annotations

import dataclasses
import json
import queue
import threading

import qt
import slicer
import vtk
from slicer.i18n import tr as _
from slicer.util import VTKObservationMixin

from . import comparison, dependencies, given, labels, running, scene
from .panel_preview import PARALLEL_COSINE
from .parameters import settings_from

VIEWS = ("Red", "Yellow", "Green")
_DELAY_MS, _POLL_MS = 10, 5
_WAIT_SECONDS = 0.03  # in each poll the worker gets the interpreter for this long
_PATIENCE_SECONDS = 5.0


class LivePart:
    """One picture for each slice view, computed by one worker at a time; only the latest question is answered.

    The pictures are volumes of one slice, hidden from selectors and not saved; they go when the box is unmarked, with Apply,
    and when the module is left.
    """

    def __init__(self, panel) -> None:
        self.panel, self.ui = panel, panel.ui
        self._nodes: dict = {}  # view -> its picture
        self._shown: dict = {}  # view -> what its picture answers
        self._earlier: dict = {}  # view -> (composite, background, foreground, opacity) before
        self._session, self._key = None, None
        self._worker, self._answers, self._stop = None, queue.SimpleQueue(), threading.Event()
        self._stale, self._pending, self._note, self._limit = False, False, "", ""
        self._asked = None
        self._views = VTKObservationMixin()
        self._later, self._poll = qt.QTimer(), qt.QTimer()
        self._later.setSingleShot(True)
        self._later.setInterval(_DELAY_MS)
        self._later.timeout.connect(self._ask)
        self._poll.setInterval(_POLL_MS)
        self._poll.timeout.connect(self._look)
        self.ui.followCheckBox.toggled.connect(self._onFollow)

    @property
    def on(self) -> bool:
        """Whether the views are followed."""
        return bool(self.ui.followCheckBox.checked)

    @property
    def idle(self) -> bool:
        """Whether all that was asked for is shown."""
        return self._worker is None and not self._pending and not self._stale

    def picture(self, view: str):
        """The picture of a view; None without."""
        return self._nodes.get(view)

    def note(self) -> str:
        """What has to be said while it is so."""
        return self._note if self.on else ""

    def changed(self, *_arguments) -> None:
        """Something that is seen may have changed: a slice, a slider, the volume."""
        if self.on and not self._pending:  # not put off again and again while a slider moves
            self._pending = True
            self._later.start()

    def stop(self) -> None:
        """Unmark the box; the views are as before."""
        self.ui.followCheckBox.checked = False

    def forget(self) -> None:
        """The scene removes the pictures itself."""
        self._nodes, self._earlier = {}, {}
        self.stop()

    def onNodeRemoved(self, node) -> None:
        """The user removed a picture; it comes again with the next change."""
        for view in [view for view, own in self._nodes.items() if own is node]:
            del self._nodes[view]
            self._shown.pop(view, None)

    # --- on and off ------------------------------------------------------------------------------------------------------

    def _onFollow(self, checked) -> None:
        if not checked:
            self._end()
            return
        if dependencies.torch_missing() or dependencies.missing():
            self.stop()
            self.panel.say(_("Python packages are missing. Preview slice and Apply ask before they install them."))
            return
        self.panel.preview.remove()
        for view in VIEWS:
            node = slicer.mrmlScene.GetNodeByID(f"vtkMRMLSliceNode{view}")
            if node is not None:
                self._views.addObserver(node, vtk.vtkCommand.ModifiedEvent, self.changed)
        self.changed()

    def _end(self) -> None:
        self._views.removeObservers()
        self._later.stop()
        self._poll.stop()
        self._pending = self._stale = False
        self._stop.set()
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.join(_PATIENCE_SECONDS)
        self._session = self._key = None
        self._answers, self._shown = queue.SimpleQueue(), {}
        self._say("")
        nodes, self._nodes = self._nodes, {}
        earlier, self._earlier = self._earlier, {}
        ours = {node.GetID() for node in nodes.values()}
        for composite, background, foreground, opacity in earlier.values():
            if slicer.mrmlScene.IsNodePresent(composite) and composite.GetForegroundVolumeID() in ours:
                composite.SetBackgroundVolumeID(background)
                composite.SetForegroundVolumeID(foreground)
                composite.SetForegroundOpacity(opacity)
        for node in nodes.values():
            if slicer.mrmlScene.IsNodePresent(node):
                scene.remove(node)

    # --- questions and answers -------------------------------------------------------------------------------------------

    def _ask(self) -> None:
        """Begin to compute what the views show, unless it is there or on its way."""
        self._pending = False
        panel, p = self.panel, self.panel.parameters
        if not self.on or p is None or panel.job:
            return
        missing = panel.whatIsMissing()
        if missing:
            self._say(missing)
            return
        from MedColorLib.run.live import Look, live_settings

        try:
            settings = live_settings(settings_from(p))
        except Exception as error:  # a value that the library does not take; the plan says so, too
            self._say(panel.explain(error))
            return
        key = self._question(p, settings)
        if self._worker is not None:
            self._stale = True
            if key != self._asked:
                self._stop.set()
            return
        planes, tilted = planes_of_views(p.inputVolume)
        self._limit = self._limits(p, tilted)
        look = Look(settings.lightness, settings.exposure)
        wanted = {view: (key, look, *plane) for view, plane in planes.items()}
        wanted = {view: question for view, question in wanted.items() if self._shown.get(view) != question}
        if wanted:
            self._begin(key, settings, wanted)
        else:
            self._say(self._limit)

    def _begin(self, key, settings, wanted: dict) -> None:
        panel, p = self.panel, self.panel.parameters
        session, work = self._session if key == self._key else None, None
        if session is None:
            try:
                work = given.take(p.inputVolume, panel.inputs.references(), settings, **panel.nodes.arguments())
            except Exception as error:
                self._say(panel.explain(error))
                return
            self._say(_("The live preview looks at the volume first..."))
        self._asked, self._stop = key, threading.Event()
        arguments = (session, work, dict(wanted), self._answers, self._stop)
        self._worker = threading.Thread(target=_work, args=arguments, daemon=True, name="MedColor live")
        self._worker.start()
        self._poll.start()

    @staticmethod
    def _question(p, settings) -> tuple:
        """What the kept part of the work depends on: everything but what is seen at once."""
        plain = dataclasses.replace(settings, lightness=1.0, exposure="auto")
        choices = (p.referenceSource, p.referencePath, p.pickedReference, p.referenceMaskPath)
        nodes = [scene.region_state(p.roi), labels.state_of(p.referenceMaskNode)]
        nodes += [labels.state_of(p.labels), p.groupLabels if p.labels else None]
        nodes.append(scene.voxel_state(p.referenceNode) if p.referenceNode else ())
        body = labels.state_of(p.bodyNode if p.body == "node" else None)
        transform = p.inputVolume.GetParentTransformNode()
        place = scene.ijk_to_world(p.inputVolume).tobytes(), transform.GetTransformToWorldMTime() if transform else 0
        voxels = scene.voxel_state(p.inputVolume)
        return (p.inputVolume.GetID(), voxels, place, choices, *nodes, body, json.dumps(plain.to_dict(), default=str))

    @staticmethod
    def _limits(p, tilted: list) -> str:
        """What the live preview does not do of what was chosen."""
        notes = []
        transform = p.inputVolume.GetParentTransformNode()
        if transform is not None and not transform.IsTransformToWorldLinear():
            notes.append(_("Under a non-linear transform slice views cut the bent slices; harden the transform."))
        if tilted:
            notes.append(_("Tilted against the volume, without live preview: {views}.").format(views=", ".join(tilted)))
        return " ".join(notes)

    def _look(self) -> None:
        """Show what has been computed."""
        worker = self._worker
        if worker is not None:
            worker.join(_WAIT_SECONDS)
        ended = worker is None or not worker.is_alive()
        while True:
            try:
                answer = self._answers.get_nowait()
            except queue.Empty:
                break
            self._take(*answer)
        if ended:
            self._poll.stop()
            self._worker = None
            if self._stale:
                self._stale = False
                self.changed()

    def _take(self, kind: str, value) -> None:
        if kind == "session":
            self._session, self._key = value, self._asked
        elif kind == "error":
            self._say(self.panel.explain(value))
        else:
            view, question, rgb = value
            self._shown[view] = question
            self._say(self._limit)
            self._put(view, question[2], question[3], rgb)

    def _say(self, note: str) -> None:
        if note != self._note:
            self._note = note
            self.panel.sayAgain()

    # --- pictures --------------------------------------------------------------------------------------------------------

    def _put(self, view: str, axis: int, index: int, rgb) -> None:
        """Three times the same slice: linear interpolation between it and black outside it would darken its faces."""
        import numpy as np

        p = self.panel.parameters
        if p is None or p.inputVolume is None:
            return
        grey, node = p.inputVolume, self._nodes.get(view)
        if node is None:
            node = slicer.mrmlScene.CreateNodeByClass("vtkMRMLVectorVolumeNode")
            node.UnRegister(None)
            node.SetName(f"{grey.GetName()} live {view}")
            node.SetHideFromEditors(True)  # before it is added: it comes into no list
            node = self._nodes[view] = slicer.mrmlScene.AddNode(node)
        offset = [0, 0, 0]
        offset[2 - axis] = index - 1
        scene.fill_part(node, np.stack([rgb] * 3, axis=axis), grey, offset)
        composites = comparison.composites(slicer.mrmlScene)
        composite = next((one for one in composites if one.GetLayoutName() == view), None)
        if composite is not None and composite.GetForegroundVolumeID() != node.GetID():
            before = (composite.GetBackgroundVolumeID(), composite.GetForegroundVolumeID())
            self._earlier.setdefault(view, (composite, *before, composite.GetForegroundOpacity()))
            composite.SetBackgroundVolumeID(grey.GetID())
            composite.SetForegroundVolumeID(node.GetID())
            composite.SetForegroundOpacity(p.fade)


def _work(session, work, wanted: dict, answers, stop) -> None:
    """In the worker: touches neither widgets nor the scene."""
    from MedColorLib.errors import Cancelled
    from MedColorLib.run.live import LiveSlices

    try:
        with running.a_core_for_the_window():
            if session is None:
                session = LiveSlices(work.volume, work.pictures, work.settings, stop.is_set, work.guard)
                answers.put(("session", session))
            session.cancelled = stop.is_set
            for view, question in wanted.items():
                _key, look, axis, index = question
                answers.put(("picture", (view, question, session.plane(axis, index, look))))
    except Cancelled:
        pass
    except Exception as error:  # handed over and said in the panel
        answers.put(("error", error))


def planes_of_views(node) -> tuple[dict, list]:
    """({view: (array axis, index)} of the slice views that show a slice of the volume, names of those that are tilted)."""
    import numpy as np

    to_ijk, axes = np.linalg.inv(scene.ijk_to_world(node)), scene.ijk_to_world(node)[:3, :3]
    counts = node.GetImageData().GetDimensions()
    found, tilted = {}, []
    for view in VIEWS:
        shown = slicer.mrmlScene.GetNodeByID(f"vtkMRMLSliceNode{view}")
        if shown is None:
            continue
        matrix = slicer.util.arrayFromVTKMatrix(shown.GetSliceToRAS())
        normals = [np.cross(axes[:, (n + 1) % 3], axes[:, (n + 2) % 3]) for n in range(3)]
        fits = [abs(normal @ matrix[:3, 2]) / np.linalg.norm(normal) for normal in normals]
        best = int(np.argmax(fits))
        if fits[best] < PARALLEL_COSINE:
            tilted.append(shown.GetName())
            continue
        index = round(float((to_ijk @ matrix[:, 3])[best]))
        if 0 <= index < counts[best]:
            found[view] = (2 - best, index)
    return found, tilted
