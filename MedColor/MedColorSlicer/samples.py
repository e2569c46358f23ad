"""Sample Data: a phantom with the colour picture that goes with it, made on the spot; to download a cryosection and a CT.

The cryosection is a section through the head of the Visible Human Female, courtesy of the U.S. National Library of
Medicine, from the sources of ITK 5.4.0 at a commit, whose bytes do not change. Slicer's own sample MRHead suits it. The CT
chest is one of Slicer's samples, too, stored under its SHA-256.
"""

from __future__ import annotations

import importlib.util
import os

import slicer

CATEGORY = "MedColor"
PHANTOM = "MedColorPhantom"
CRYOSECTION = "MedColorCryosection"
CRYOSECTION_SHA256 = "a580fa87ed9928a497f444dd25d79a48784f7070788af82694882fce7d89c8e7"
CRYOSECTION_URL = (
    "https://raw.githubusercontent.com/InsightSoftwareConsortium/ITK/311b7060ef39e371f3cd209ec135284ff5fde735/"
    "Examples/Data/VisibleWomanHeadSlice.png"
)
CT_CHEST = "MedColorCTChest"
CT_CHEST_SHA256 = "4507b664690840abb6cb9af2d919377ffc4ef75b167cb6fd0f747befdb12e38e"
CT_CHEST_URL = f"https://github.com/Slicer/SlicerTestingData/releases/download/SHA256/{CT_CHEST_SHA256}"


def register(resources_folder: str) -> None:
    """Add MedColor's samples to Slicer's Sample Data module."""
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
        uris=[],  # nothing to download; Slicer counts addresses and names, and None cannot be counted
        fileNames=[],
    )
    logic.registerCustomSampleDataSource(
        category=CATEGORY,
        sampleName=CRYOSECTION,
        thumbnailFileName=os.path.join(resources_folder, "Icons", f"{CRYOSECTION}.png"),
        uris=CRYOSECTION_URL,
        fileNames=f"{CRYOSECTION}.png",
        nodeNames=CRYOSECTION,
        loadFileTypes="VolumeFile",
        loadFileProperties={"singleFile": True},
        checksums=f"SHA256:{CRYOSECTION_SHA256}",
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
    """Put the phantom's MR and a colour picture at the level of its eyes into the scene; needs no network.

    Returns:
        [scalar volume node, colour picture node]
    """
    import numpy as np

    from MedColorLib.phantom import SERIES_SHAPE, scan, section

    volume, picture = scan("mr", shape=SERIES_SHAPE), section()
    grey = slicer.util.addVolumeFromArray(volume.array, np.asarray(volume.ijk_to_ras), PHANTOM)
    color = slicer.util.addVolumeFromArray(
        picture[np.newaxis], np.diag([-1.0, -1.0, 1.0, 1.0]), f"{PHANTOM} picture", "vtkMRMLVectorVolumeNode"
    )
    color.SetVoxelVectorType(color.VoxelVectorTypeColorRGB)
    if slicer.app.layoutManager():
        slicer.util.setSliceViewerLayers(background=grey, fit=True)
    return [grey, color]
