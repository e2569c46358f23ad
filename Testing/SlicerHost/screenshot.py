"""Pictures to look at, without Slicer:

    python Testing/SlicerHost/screenshot.py panel panel.png
    python Testing/SlicerHost/screenshot.py scene scene.png [volume.nrrd picture.png [preset]]

`panel` draws the module's panel on PySide6 dressed as Slicer's Qt; `scene` draws Slicer's own 3-D views of the grey and
the coloured volume. Without files both use the phantom that MedColor makes itself.
"""

from __future__ import annotations

import os
import sys

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

import mrml
import numpy as np
import slicer
import slicer_like

BACKGROUND = (0.0, 0.0, 0.0)
OPACITY = 0.8  # of "Bone to skin": where a face has skin


def load(files):
    """(grey node, reference) of the files given, or of the phantom."""
    if files:
        from MedColorLib.io.files import read_volume

        volume, reference = read_volume(files[0]), files[1]
        name = os.path.basename(files[0]).split(".")[0]
    else:
        from MedColorLib.phantom import sample

        (volume, reference), name = sample(), "MedColorPhantom"
    return slicer.util.addVolumeFromArray(volume.array, np.asarray(volume.ijk_to_ras), name), reference


def tissue_bounds(node):
    """RAS bounds of the voxels that are not black, for a picture without empty borders."""
    from MedColorSlicer.scene import ijk_to_world

    from MedColorLib.rendering.grid import tissue_box

    box = tissue_box(slicer.util.arrayFromVolume(node))
    ends = [(part.start, part.stop - 1) for part in box[::-1]]
    corners = np.array([[i, j, k, 1] for i in ends[0] for j in ends[1] for k in ends[2]])
    ras = (ijk_to_world(node) @ corners.T)[:3]
    return [edge for axis in ras for edge in (axis.min(), axis.max())]


def scene(path, *arguments):
    """Grey and colour side by side, as `showComparison` lays them out."""
    import cv2

    host = mrml.HostScene()
    slicer_like.install(host)
    views = [mrml.OffscreenView(host, name, 420, BACKGROUND) for name in ("1", "2")]
    from MedColorSlicer.logic import MedColorLogic

    grey, reference = load(arguments[:2])
    logic = MedColorLogic()
    preset = arguments[2] if len(arguments) > 2 else "draft"
    colored = logic.process(
        grey, reference, preset=preset, progress=lambda f, text: print(f"{f:.2f} {text}", flush=True)
    )
    logic.showComparison(grey, colored)
    logic.setOpacity(colored, OPACITY)
    bounds = tissue_bounds(colored)
    pictures = []
    for view in views:
        view.make_plain()
        view.look_at(bounds, (0.75, 1.0, 0.35))
        pictures.append(view.render())
    grey_picture, color_picture = pictures[1], pictures[0]
    cv2.imwrite(path, np.hstack([grey_picture, color_picture])[..., ::-1])


def panel(path, *arguments):
    """The panel with a volume and a reference chosen and its plan worked out."""
    import time

    from PySide6 import QtWidgets

    application = QtWidgets.QApplication([])
    host = mrml.HostScene()
    slicer_like.install(host, application)
    import qt

    import MedColor

    grey, reference = load(arguments[:2])
    parent = slicer.qMRMLWidget()
    parent.setLayout(qt.QVBoxLayout())
    parent.setMRMLScene(slicer.mrmlScene)
    widget = MedColor.MedColorWidget(parent)
    widget.setup()
    widget.parameters.inputVolume = grey
    widget.parameters.referenceSource = "files" if arguments else "sample"
    widget.parameters.referencePath = reference if arguments else ""
    widget.ui.advancedCollapsibleButton.collapsed = False
    parent.resize(440, 1200)
    parent.show()
    end = time.monotonic() + 120
    while not widget.ui.planText.plainText.startswith("Plan") and time.monotonic() < end:
        application.processEvents()
        time.sleep(0.02)
    application.processEvents()
    parent.grab().save(path)
    widget.cleanup()


if __name__ == "__main__":
    {"panel": panel, "scene": scene}[sys.argv[1]](*sys.argv[2:])
