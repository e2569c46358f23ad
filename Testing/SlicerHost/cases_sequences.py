"""Sequences of volumes: every time point coloured, in step with the scan."""

from __future__ import annotations

import numpy as np
import pytest
import slicer
from host_fixtures import grey_node, node_ids

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
