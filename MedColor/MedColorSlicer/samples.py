"""Sample Data: a phantom MedColor makes itself, and the colour picture that goes with it.

Only the phantom is registered. The images of the Visible Human Project have no address under which the very bytes, and
so a SHA-256 to check them by, stay the same; how to get them is in the README.
"""

from __future__ import annotations

import importlib.util
import os

import slicer

CATEGORY = "MedColor"
PHANTOM = "MedColorPhantom"


def register(resources_folder: str) -> None:
    """Add MedColor's sample to Slicer's Sample Data module."""
    if importlib.util.find_spec("SampleData") is None:  # the module can be switched off in Slicer's settings
        return
    import SampleData

    logic = SampleData.SampleDataLogic
    if hasattr(logic, "registerCustomSampleDataCategory"):  # a title for the section: Slicer 5.12 and later
        logic.registerCustomSampleDataCategory(category=CATEGORY, displayName=CATEGORY)
    logic.registerCustomSampleDataSource(
        category=CATEGORY,
        sampleName=PHANTOM,
        thumbnailFileName=os.path.join(resources_folder, "Icons", f"{PHANTOM}.png"),
        customDownloader=load_phantom,
    )


def load_phantom(_source=None):
    """Put the phantom and its colour picture into the scene; needs no network.

    Returns:
        [scalar volume node, colour picture node]
    """
    import numpy as np

    from MedColorLib.phantom import sample

    volume, picture = sample()
    grey = slicer.util.addVolumeFromArray(volume.array, np.asarray(volume.ijk_to_ras), PHANTOM)
    color = slicer.util.addVolumeFromArray(
        picture[np.newaxis], np.diag([-1.0, -1.0, 1.0, 1.0]), f"{PHANTOM} picture", "vtkMRMLVectorVolumeNode"
    )
    color.SetVoxelVectorType(color.VoxelVectorTypeColorRGB)
    if slicer.app.layoutManager():
        slicer.util.setSliceViewerLayers(background=grey, fit=True)
    return [grey, color]
