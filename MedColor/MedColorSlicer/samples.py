"""Sample Data: a phantom MedColor makes itself with the colour picture that goes with it, and a CT chest to download.

The CT is one of Slicer's own samples, stored under its SHA-256. The images of the Visible Human Project have no address
under which the very bytes, and so a SHA-256 to check them by, stay the same; how to get them is in the README.
"""

from __future__ import annotations

import importlib.util
import os

import slicer

CATEGORY = "MedColor"
PHANTOM = "MedColorPhantom"
CT_CHEST = "MedColorCTChest"
CT_CHEST_SHA256 = "4507b664690840abb6cb9af2d919377ffc4ef75b167cb6fd0f747befdb12e38e"
CT_CHEST_URL = f"https://github.com/Slicer/SlicerTestingData/releases/download/SHA256/{CT_CHEST_SHA256}"


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
    logic.registerCustomSampleDataSource(
        category=CATEGORY,
        sampleName=CT_CHEST,
        thumbnailFileName=os.path.join(resources_folder, "Icons", f"{CT_CHEST}.png"),
        uris=CT_CHEST_URL,
        fileNames="CT-chest.nrrd",
        nodeNames=CT_CHEST,
        checksums=f"SHA256:{CT_CHEST_SHA256}",
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
