"""A sequence of volumes (4-D: a cardiac CT, phases of contrast): every time point coloured, played in step with the scan."""

from __future__ import annotations

import json

import slicer
import vtk
from slicer.i18n import tr as _

from . import scene

TIME_POINTS_ATTRIBUTE = "MedColor.TimePoints"  # on a coloured sequence: which time point took the matches of which


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


def moved_player(sequence, nodes: dict):
    """The volume that plays a sequence under a transform, where that matters; None where it does not.

    The transform moves the player, but not the time points, which lie in a scene of their own. Region, labels and body were
    placed on the player.

    Args:
        nodes: {name: value} as for `MedColorLogic.processSequence`.

    Raises:
        MedColorLib.errors.InputError: where they lie is not one place: several players, or time points of several grids.
    """
    from MedColorLib.errors import InputError

    if not any(hasattr(nodes.get(name), "IsA") for name in ("roi", "labels", "body")) or not sequence.GetScene():
        return None
    players = [browser.GetProxyNode(sequence) for browser in browsers_of(sequence)]
    places = {player.GetParentTransformNode(): player for player in players if player is not None}
    moved = [player for transform, player in places.items() if transform is not None]
    if not moved:
        return None
    grids = {_own_grid(sequence.GetNthDataNode(n)) for n in range(sequence.GetNumberOfDataNodes())}
    if len(places) > 1 or grids != {_own_grid(moved[0])}:
        raise InputError(
            _(
                "{name} is played under the transform {transform}, but not everywhere, or its time points lie on several grids: "
                "where region, tissue labels and body belong cannot be told. Take {name} and them out of the transform (module "
                "Transforms), or select no region, labels and body."
            ).format(name=moved[0].GetName(), transform=moved[0].GetParentTransformNode().GetName())
        )
    return moved[0]


def _own_grid(node) -> tuple:
    """Size and place of a volume, without the transforms it lies under."""
    matrix = vtk.vtkMatrix4x4()
    node.GetIJKToRASMatrix(matrix)
    image = node.GetImageData()
    return (image.GetDimensions() if image else (), slicer.util.arrayFromVTKMatrix(matrix).tobytes())


def sequence_of(volume):
    """The sequence of which a volume shows a time point (it is the "proxy" of a browser); None where it is none."""
    if volume is None or volume.GetScene() is None:
        return None
    browser = _browser_of_proxy(volume)
    return browser.GetSequenceNode(volume) if browser is not None else None


def _browser_of_proxy(volume):
    nodes, kind = volume.GetScene(), "vtkMRMLSequenceBrowserNode"
    for n in range(nodes.GetNumberOfNodesByClass(kind)):
        browser = nodes.GetNthNodeByClass(n, kind)
        if browser.GetSequenceNode(volume) is not None:
            return browser
    return None


def shown(colored, volume):
    """The volume that plays coloured time points beside the one that plays the scan's; None without Slicer's Sequences."""
    browser, module = _browser_of_proxy(volume), getattr(slicer.modules, "sequences", None)
    if browser is None or module is None:
        return None
    module.logic().UpdateProxyNodesFromSequences(browser)
    proxy = browser.GetProxyNode(colored)
    if proxy is not None:
        proxy.SetAndObserveTransformNodeID(volume.GetTransformNodeID())
        proxy.SetNodeReferenceID(scene.INPUT_ROLE, volume.GetID())
        if proxy.GetVolumeDisplayNode() is None:
            proxy.CreateDefaultDisplayNodes()
    return proxy


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
    colored.SetNodeReferenceID(scene.INPUT_ROLE, sequence.GetID())
    colored.SetIndexName(sequence.GetIndexName())
    colored.SetIndexUnit(sequence.GetIndexUnit())
    carrier = slicer.vtkMRMLVectorVolumeNode()
    carrier.SetName(name)
    matrix = vtk.vtkMatrix4x4()
    try:
        for number, result in enumerate(results):
            slicer.util.updateVolumeFromArray(carrier, result.rgb)
            sequence.GetNthDataNode(number).GetIJKToRASMatrix(matrix)
            carrier.SetIJKToRASMatrix(matrix)
            carrier.SetVoxelVectorType(carrier.VoxelVectorTypeColorRGB)
            colored.SetDataNodeAtValue(carrier, sequence.GetNthIndexValue(number))
        for browser in browsers_of(sequence):
            browser.AddSynchronizedSequenceNodeID(colored.GetID())
        said = [result.report["time_point"] for result in results if "time_point" in result.report]
        colored.SetAttribute(TIME_POINTS_ATTRIBUTE, json.dumps(said))
    except BaseException:
        nodes.RemoveNode(colored)
        raise
    return colored


def browsers_of(sequence) -> list:
    """The sequence browsers of the scene that play a sequence."""
    nodes, kind = sequence.GetScene(), "vtkMRMLSequenceBrowserNode"
    found = [nodes.GetNthNodeByClass(n, kind) for n in range(nodes.GetNumberOfNodesByClass(kind))]
    return [browser for browser in found if browser.IsSynchronizedSequenceNode(sequence, True)]


def how_matched(colored) -> str:
    """How many time points of a coloured sequence took the matches of another one, for people; empty where none did."""
    said = json.loads(colored.GetAttribute(TIME_POINTS_ATTRIBUTE) or "[]")
    taken = sum(one["matches_of"] != one["number"] for one in said)
    if not taken:
        return ""
    return _("{taken} of {count} time points show nearly the same as an earlier one and took its matches").format(
        taken=taken, count=len(said)
    )


def share_of(progress, number: int, count: int, name: str):
    """What one volume of several reports as part of all; None without `progress`."""
    if progress is None or count == 1:
        return progress
    text = _("{name}, {number} of {count}: ").format(name=name, number=number + 1, count=count)
    return lambda fraction, what="": progress((number + fraction) / count, text + what)
