"""A sequence of volumes (4-D: a cardiac CT, phases of contrast): every time point coloured, played in step with the scan."""

from __future__ import annotations

import slicer
from slicer.i18n import tr as _

from . import scene


def volumes_of(sequence) -> list:
    """The scalar volumes of a sequence, in its order.

    Raises:
        MedColorLib.errors.InputError: no sequence, an empty one, or one that holds something else.
    """
    from MedColorLib.errors import InputError

    if sequence is None or not sequence.IsA("vtkMRMLSequenceNode"):
        raise InputError(_("Select a sequence of volumes, as the module Sequences makes and loads them."))
    found = [sequence.GetNthDataNode(n) for n in range(sequence.GetNumberOfDataNodes())]
    if not found:
        raise InputError(_("{name} holds no volumes; load it again.").format(name=sequence.GetName()))
    for number, node in enumerate(found):
        problem = scene.input_problem(node)
        if problem:
            raise InputError(_("Time point {number}: {problem}").format(number=number, problem=problem))
    return found


def publish(sequence, results):
    """A sequence of coloured volumes beside a sequence, and in step with it in each browser that plays that one.

    Args:
        results: one MedColorLib.ColorVolume for each time point.

    Returns:
        The new vtkMRMLSequenceNode.
    """
    nodes = sequence.GetScene()
    name = nodes.GenerateUniqueName(f"{sequence.GetName()} coloured")
    colored = nodes.AddNewNodeByClass("vtkMRMLSequenceNode", name)
    colored.SetIndexName(sequence.GetIndexName())
    colored.SetIndexUnit(sequence.GetIndexUnit())
    carrier = slicer.vtkMRMLVectorVolumeNode()
    carrier.SetName(name)
    try:
        for number, result in enumerate(results):
            slicer.util.updateVolumeFromArray(carrier, result.rgb)
            carrier.SetIJKToRASMatrix(slicer.util.vtkMatrixFromArray(result.ijk_to_ras))
            carrier.SetVoxelVectorType(carrier.VoxelVectorTypeColorRGB)
            colored.SetDataNodeAtValue(carrier, sequence.GetNthIndexValue(number))
        for browser in browsers_of(sequence):
            browser.AddSynchronizedSequenceNodeID(colored.GetID())
    except BaseException:
        nodes.RemoveNode(colored)
        raise
    return colored


def browsers_of(sequence) -> list:
    """The sequence browsers of the scene that play a sequence."""
    nodes, kind = sequence.GetScene(), "vtkMRMLSequenceBrowserNode"
    found = [nodes.GetNthNodeByClass(n, kind) for n in range(nodes.GetNumberOfNodesByClass(kind))]
    return [browser for browser in found if browser.IsSynchronizedSequenceNode(sequence, True)]


def share_of(progress, number: int, count: int):
    """What one time point of several reports as part of all; None without `progress`."""
    if progress is None:
        return None
    text = _("time point {number} of {count}: ").format(number=number + 1, count=count)
    return lambda fraction, what: progress((number + fraction) / count, text + what)
