"""The choices of the panel, kept in the scene, and the library settings they stand for.

Every field has one control in the panel, tied to it by the property SlicerParameterName in `MedColor.ui`, or by
`panel_inputs` (the path, the picked picture), `panel_nodes` (region, labels, body, mask of the reference), `panel_smoother`
(the smoother's values) and `panel_volumes` (the other volumes, which are node references beside the fields).
"""

import dataclasses
import json
from typing import Annotated

from slicer import vtkMRMLDisplayableNode, vtkMRMLScalarVolumeNode, vtkMRMLVectorVolumeNode
from slicer.parameterNodeWrapper import Choice, WithinRange, parameterNodeWrapper

from MedColorLib import parameters as library

REFERENCE_SOURCES = ["recommended", "files", "node", "sample"]
PRESETS, FEATURES, SMOOTHERS, LUMINANCES = map(
    list, (library.PRESETS, library.FEATURES, library.SMOOTHERS, library.LUMINANCE)
)
GAMMAS = {"auto": None, "on": True, "off": False}
EXPOSURES = ["auto", "off", "gain"]
BODIES = ["auto", "all", "node"]
DEVICES = ["auto", "cpu", "cuda", "mps"]


@parameterNodeWrapper
class MedColorParameterNode:
    """One field for each control; the names of the choices are those of MedColorLib.Settings."""

    inputVolume: vtkMRMLScalarVolumeNode
    allTimePoints: bool = False  # where it is one of a sequence
    referenceSource: Annotated[str, Choice(REFERENCE_SOURCES)] = "files"
    referencePath: str  # file or folder; for "recommended" the folder to choose from
    pickedReference: str  # picture clicked among the recommended ones
    referenceNode: vtkMRMLVectorVolumeNode
    preset: Annotated[str, Choice(PRESETS)] = "balanced"

    features: Annotated[str, Choice(FEATURES)] = "auto"
    smoother: Annotated[str, Choice(SMOOTHERS)] = "auto"
    smootherAutomatic: bool = True  # the smoother's own values; `smootherOptions` waits
    smootherOptions: str  # JSON: smoother -> name -> value, for those that were changed
    coherenceMm: Annotated[float, WithinRange(0.0, 20.0)] = 8.0
    luminance: Annotated[str, Choice(LUMINANCES)] = library.Settings.luminance
    lightness: Annotated[float, WithinRange(0.0, 1.0)] = library.Settings.lightness
    gamma: Annotated[str, Choice(list(GAMMAS))] = "auto"
    exposure: Annotated[str, Choice(EXPOSURES)] = "auto"
    exposureGain: Annotated[float, WithinRange(0.1, 10.0)] = 1.0
    referenceMaskNode: vtkMRMLDisplayableNode  # a label map, a segmentation or a picture
    referenceMaskPath: str  # picture or folder, for references that are files
    windowAutomatic: bool = True
    windowLow: Annotated[float, WithinRange(-100000.0, 100000.0)] = 0.0
    windowHigh: Annotated[float, WithinRange(-100000.0, 100000.0)] = 255.0
    body: Annotated[str, Choice(BODIES)] = "auto"
    bodyNode: vtkMRMLDisplayableNode  # a label map or a segmentation
    allSlices: bool = True
    # transverse slices, counted from the feet up as MedColorLib does; both ends belong to the range
    firstSlice: Annotated[int, WithinRange(0, 100000)] = 0
    lastSlice: Annotated[int, WithinRange(0, 100000)] = 0
    roi: vtkMRMLDisplayableNode  # a markups ROI; that class may not be loaded yet when this file is
    labels: vtkMRMLDisplayableNode  # a label map or a segmentation
    groupLabels: bool = False  # segments by what they are called
    device: Annotated[str, Choice(DEVICES)] = "auto"
    seed: Annotated[int, WithinRange(0, 1000000)] = 0

    outputVolume: vtkMRMLVectorVolumeNode
    confidence: bool = False
    show3D: bool = True  # whether Apply shows the result in 3-D views, too
    opacity: Annotated[float, WithinRange(0.0, 1.0)] = 0.7
    fade: Annotated[float, WithinRange(0.0, 1.0)] = 1.0


def resolved_smoother(parameters) -> str:
    """The smoother that the choices of the panel stand for."""
    import MedColorLib

    return MedColorLib.Settings(preset=parameters.preset, smoother=parameters.smoother).resolved_smoother


def chosen_options(parameters) -> dict:
    """Name -> value of what was changed for the present smoother; what cannot be read counts as nothing."""
    return _stored(parameters).get(resolved_smoother(parameters), {})


def store_options(parameters, values: dict) -> None:
    """Keep name -> value for the present smoother; those of the other smoothers stay."""
    parameters.smootherOptions = json.dumps({**_stored(parameters), resolved_smoother(parameters): values})


def _stored(parameters) -> dict:
    try:
        found = json.loads(parameters.smootherOptions or "{}")
    except ValueError:  # a scene may come from anywhere
        found = None
    return {k: v for k, v in found.items() if isinstance(v, dict)} if isinstance(found, dict) else {}


def settings_from(parameters):
    """MedColorLib.Settings for the choices of the panel.

    Raises:
        MedColorLib.errors.SettingsError: a value the library does not take; the message says which.
    """
    import MedColorLib

    known = {field.name for field in dataclasses.fields(MedColorLib.Settings)}
    values = {
        "preset": parameters.preset,
        "features": parameters.features,
        "smoother": parameters.smoother,
        "smoother_options": None if parameters.smootherAutomatic else chosen_options(parameters) or None,
        "coherence_mm": parameters.coherenceMm,
        "confidence": parameters.confidence,
        "luminance": parameters.luminance,
        "lightness": parameters.lightness,
        "gamma": GAMMAS[parameters.gamma],
        "exposure": parameters.exposureGain if parameters.exposure == "gain" else parameters.exposure,
        "body": "all" if parameters.body == "all" else "auto",  # a node is an argument of its own
        "window": None if parameters.windowAutomatic else (parameters.windowLow, parameters.windowHigh),
        "slices": None if parameters.allSlices else (parameters.firstSlice, parameters.lastSlice + 1),
        "device": parameters.device,
        "seed": parameters.seed,
    }
    return MedColorLib.Settings(**{name: value for name, value in values.items() if name in known})
