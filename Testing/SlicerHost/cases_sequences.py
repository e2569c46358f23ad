"""Sequences of volumes: every time point coloured, in step with the scan."""

from __future__ import annotations

import numpy as np
import pytest
import slicer
import vtk
from host_fixtures import grey_node, label_node, node_ids
from panel_fixtures import turned

from MedColorLib.errors import Cancelled, InputError

REFERENCE = np.full((4, 5, 3), (180, 90, 40), np.uint8)


@pytest.fixture
def logic(scene):
    module_logic = slicer.vtkSlicerSequencesLogic()  # knows the nodes of Slicer's module Sequences
    module_logic.SetMRMLScene(scene)
    yield medcolor_logic()
    module_logic.SetMRMLScene(None)


def medcolor_logic():
    from MedColorSlicer.logic import MedColorLogic

    return MedColorLogic()


def sequence_of(count=3, make=grey_node):
    """A sequence with an index in ms, and a browser that plays it."""
    sequence = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceNode", "beat")
    sequence.SetIndexName("time")
    sequence.SetIndexUnit("ms")
    for n in range(count):
        node = make(f"phase {n}")
        sequence.SetDataNodeAtValue(node, str(100 * n))
        slicer.mrmlScene.RemoveNode(node)
    browser = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", "player")
    browser.SetAndObserveMasterSequenceNodeID(sequence.GetID())
    return sequence, browser


def test_every_time_point_is_coloured_and_played(logic, library):
    sequence, browser = sequence_of()
    seen = []
    colored = logic.processSequence(
        sequence, [REFERENCE], preset="draft", progress=lambda fraction, text: seen.append((fraction, text))
    )
    assert colored.GetName() == "beat coloured"
    assert colored.GetNumberOfDataNodes() == 3
    assert [colored.GetNthIndexValue(n) for n in range(3)] == ["0", "100", "200"]
    assert (colored.GetIndexName(), colored.GetIndexUnit()) == ("time", "ms")
    for n in range(3):
        node = colored.GetNthDataNode(n)
        assert node.IsA("vtkMRMLVectorVolumeNode")
        assert slicer.util.arrayFromVolume(node).shape == (6, 8, 10, 3)
        assert node.GetVoxelVectorType() == node.VoxelVectorTypeColorRGB
    assert browser.IsSynchronizedSequenceNode(colored)
    fractions = [fraction for fraction, _text in seen]
    assert fractions == sorted(fractions)
    assert seen[-1][1].startswith("time point 3 of 3")
    assert [call[2].preset for call in library.calls] == ["draft"] * 3
    from MedColorSlicer import sequences

    assert sequences.how_matched(colored) == (
        "1 of 3 time points show nearly the same as an earlier one and took its matches"
    )


def roi_node():
    roi = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLMarkupsROINode")
    roi.SetXYZ(4, 4, 3)
    roi.SetRadiusXYZ(2, 2, 2)
    return roi


NODES = {"roi": roi_node, "labels": label_node, "body": label_node}


def own_matrix(node):
    matrix = vtk.vtkMatrix4x4()
    node.GetIJKToRASMatrix(matrix)
    return slicer.util.arrayFromVTKMatrix(matrix)


@pytest.fixture
def played(logic):
    """(sequence, browser, the volume that plays it) under a transform."""
    sequence, browser = sequence_of()
    players = slicer.vtkSlicerSequencesLogic()
    players.SetMRMLScene(slicer.mrmlScene)
    players.UpdateProxyNodesFromSequences(browser)
    player = browser.GetProxyNode(sequence)
    player.SetAndObserveTransformNodeID(turned(slicer.mrmlScene, 90).GetID())
    yield sequence, browser, player
    players.SetMRMLScene(None)


@pytest.mark.parametrize("kind", NODES)
def test_nodes_of_the_scene_lie_where_the_player_is_shown(logic, library, played, kind):
    from MedColorSlicer import scene

    sequence, _browser, player = played
    node = NODES[kind]()
    node.SetAndObserveTransformNodeID(player.GetTransformNodeID())  # placed on what is seen
    colored = logic.processSequence(sequence, [REFERENCE], nodes={kind: node})
    assert [call[0].name for call in library.calls] == ["phase 0", "phase 1", "phase 2"]
    for volume, _references, settings in library.calls:
        np.testing.assert_allclose(volume.ijk_to_ras, scene.ijk_to_world(player))
        assert settings.region == (((1, 6), (2, 7), (2, 7)) if kind == "roi" else None)
        if kind == "body":
            np.testing.assert_allclose(settings.body.labels.ijk_to_ras, volume.ijk_to_ras)
    if kind == "labels":
        np.testing.assert_allclose(library.guards[0].labels.ijk_to_ras, scene.ijk_to_world(player))
    for n in range(3):  # the transform is the player's, not a part of its time points
        np.testing.assert_array_equal(own_matrix(colored.GetNthDataNode(n)), own_matrix(sequence.GetNthDataNode(n)))


def test_nodes_of_the_scene_are_refused_where_players_lie_at_two_places(logic, library, played):
    sequence, _browser, _player = played
    other = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", "second")
    other.SetAndObserveMasterSequenceNodeID(sequence.GetID())
    players = slicer.vtkSlicerSequencesLogic()
    players.SetMRMLScene(slicer.mrmlScene)
    players.UpdateProxyNodesFromSequences(other)
    try:
        with pytest.raises(InputError, match=r"under the transform turn, but not everywhere.* out of the transform"):
            logic.processSequence(sequence, [REFERENCE], nodes={"roi": roi_node()})
        assert not library.calls
        logic.processSequence(sequence, [REFERENCE], nodes={"roi": None, "labels": None, "body": "all"})
        assert len(library.calls) == 3
    finally:
        players.SetMRMLScene(None)


def test_references_and_labels_are_taken_once_for_each_grid(logic, library, monkeypatch):
    from MedColorSlicer import labels, references

    taken, real, real_guard = [], references.references_from, labels.guard_from
    monkeypatch.setattr(references, "references_from", lambda *a: taken.append("references") or real(*a))
    monkeypatch.setattr(labels, "guard_from", lambda *a: taken.append("guard") or real_guard(*a))
    sequence, _browser = sequence_of(make=lambda name: grey_node(name, matrix=np.diag([1, 1, 1 + ("2" in name), 1.0])))
    for n in range(3):
        slicer.util.arrayFromVolume(sequence.GetNthDataNode(n))[:] += 100 * n
    logic.processSequence(sequence, [REFERENCE], nodes={"labels": label_node(), "roi": roi_node()})
    assert taken == ["references", "guard"] * 2, "the last time point has thicker slices"
    assert [int(call[0].array.min()) for call in library.calls] == [1, 101, 201]
    assert [call[0].name for call in library.calls] == ["phase 0", "phase 1", "phase 2"]
    assert [call[2].region for call in library.calls] == [((1, 6), (2, 7), (2, 7))] * 2 + [((1, 3), (2, 7), (2, 7))]
    assert all(guard is not None for guard in library.guards)


def test_all_or_nothing(logic, library):
    sequence, _browser = sequence_of()
    before = node_ids(slicer.mrmlScene)
    with pytest.raises(Cancelled):
        logic.processSequence(sequence, [REFERENCE], cancelled=lambda: len(library.calls) > 1)
    assert node_ids(slicer.mrmlScene) == before
    library.error = InputError("no")
    with pytest.raises(InputError):
        logic.processSequence(sequence, [REFERENCE])
    assert node_ids(slicer.mrmlScene) == before


def test_sequences_that_cannot_be_coloured(logic, library):
    empty = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceNode", "bare")
    models, _browser = sequence_of(2, lambda name: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLModelNode", name))
    for sequence, words in ((None, "Select a sequence"), (empty, "bare holds no volumes"), (models, "Time point 0")):
        with pytest.raises(InputError, match=words):
            logic.processSequence(sequence, [REFERENCE])
    with pytest.raises(InputError, match="processSequence"):
        logic.process(models, [REFERENCE])
    assert not library.calls
