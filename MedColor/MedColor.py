"""MedColor, a Slicer module: colours grey volumes after a colour photograph. The parts are in MedColorSlicer."""

import importlib.util
import os
import sys

import slicer
from slicer.i18n import tr as _
from slicer.i18n import translate
from slicer.ScriptedLoadableModule import ScriptedLoadableModule


def _find_library():
    """In a source checkout the library lies beside this folder; installed, it lies beside this file."""
    here = os.path.dirname(os.path.abspath(__file__))
    parent = os.path.dirname(here)
    if here not in sys.path:
        sys.path.append(here)
    if importlib.util.find_spec("MedColorLib") is None and os.path.isfile(
        os.path.join(parent, "MedColorLib", "__init__.py")
    ):
        sys.path.append(parent)


_find_library()

from MedColorSlicer.logic import MedColorLogic  # noqa: E402, F401 - Slicer looks for the four classes in this file
from MedColorSlicer.selftest import MedColorTest  # noqa: E402, F401
from MedColorSlicer.widget import MedColorWidget  # noqa: E402, F401


class MedColor(ScriptedLoadableModule):
    """What Slicer shows of the module before it is opened."""

    def __init__(self, parent):
        ScriptedLoadableModule.__init__(self, parent)
        parent.title = _("MedColor")
        parent.categories = [translate("qSlicerAbstractCoreModule", "Rendering")]
        parent.dependencies = ["VolumeRendering", "Markups"]
        parent.contributors = ["MedColor contributors"]
        parent.helpText = _(
            "Colours a grey CT or MR volume after a colour photograph of the same part of a body, and shows it by "
            "volume rendering. The colours are an illustration: they are no measurement and not for diagnosis. "
            'See the <a href="{url}">documentation</a>.'
        ).format(url="https://github.com/MedColor/SlicerMedColor")
        parent.acknowledgementText = _(
            'The method is that of the paper "Reference Based Color Transfer for Medical Volume Rendering". '
            "The cryosection of the sample data is courtesy of the U.S. National Library of Medicine."
        )
        slicer.app.connect("startupCompleted()", self._onStartupCompleted)
        slicer.app.connect("aboutToQuit()", self._onAboutToQuit)

    def _onStartupCompleted(self):
        from MedColorSlicer import rendering_guard, samples

        rendering_guard.guard_of(slicer.mrmlScene)  # results in scenes opened later look right, panel or no panel
        samples.register(self.resourcePath(""))

    def _onAboutToQuit(self):
        """Nothing of Python observes the scene when it is taken down."""
        from MedColorSlicer import rendering_guard

        rendering_guard.release_guards()
