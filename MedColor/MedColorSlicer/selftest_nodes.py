"""Part of the self test: what MedColor shares with nodes of Slicer's other modules, sequences, segmentations, scene files."""

from __future__ import annotations

import os
import tempfile

import slicer

from .selftest_samples import LEFT, half_node, logic, picture_of, settle, two_colors


class NodeCases:
    """Mixed into the self test, whose helpers are used."""

    def test_sequence_is_colored_and_played(self):
        import numpy as np

        from MedColorSlicer import sequences, three_d_views

        self._needs_module("sequences")
        sequence, browser = _sequence_of([half_node(0), half_node(1)])
        player = browser.GetProxyNode(sequence)
        with self._stand_in():
            colored = logic().processSequence(sequence, [np.full((4, 5, 3), (180, 90, 40), np.uint8)])
        result = sequences.shown(colored, player)
        logic().showVolumeRendering(result, opacity=0.88)
        view = next(iter(three_d_views.shown_views()), None)
        for turn in (0, 1, 0):
            browser.SetSelectedItemNumber(turn)
            slicer.app.processEvents()
            grey = slicer.util.arrayFromVolume(player)
            rgb = slicer.util.arrayFromVolume(result)
            np.testing.assert_array_equal(grey > 0, slicer.util.arrayFromVolume(sequence.GetNthDataNode(turn)) > 0)
            np.testing.assert_array_equal(rgb, (grey > 0)[..., None] * np.array(LEFT, np.uint8))
            if view:  # seen from the front, what is left of the body is on the right
                seen = picture_of(view, result).max(axis=2) > 30
                middle = seen.shape[1] // 2
                halves = seen[:, middle:].sum(), seen[:, :middle].sum()
                self.assertGreater(halves[turn], 500, "nothing is seen")
                self.assertLess(halves[1 - turn], 0.1 * halves[turn], "not the time point that is played")

    def test_segmentation_guards_the_tissues(self):
        import numpy as np

        self._needs_module("segmentations")
        grey = half_node(0)
        values = slicer.util.arrayFromVolume(grey)
        segmentation = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "tissues")
        segmentation.CreateDefaultDisplayNodes()
        segmentation.SetReferenceImageGeometryParameterFromVolumeNode(grey)
        wanted = np.zeros(values.shape, np.uint8)
        wanted[4:20, 8:30, 10:20], wanted[20:40, 8:30, 10:20] = 1, 2
        for label, name in enumerate(("Femur", "Muscle"), 1):
            segment = segmentation.GetSegmentation().AddEmptySegment("", name)
            slicer.util.updateSegmentBinaryLabelmapFromArray(
                (wanted == label).astype(np.uint8), segmentation, segment, grey
            )
        count = slicer.mrmlScene.GetNumberOfNodes()
        with self._stand_in() as stand_in:
            picture = [np.full((4, 5, 3), (180, 90, 40), np.uint8)]
            logic().process(grey, picture, labels=segmentation, labelGroups="tissue")
        (guard,) = stand_in.guards
        np.testing.assert_array_equal(guard.labels.array, wanted)
        self.assertEqual(guard.present, (0, 1, 2))
        names = [slicer.mrmlScene.GetNthNode(n).GetName() for n in range(count, slicer.mrmlScene.GetNumberOfNodes())]
        self.assertFalse([name for name in names if name.startswith("tissues")], "the scene keeps no label map")

    def test_scene_file_brings_the_same_picture(self):
        import numpy as np

        view = self._three_d_view()
        settle(view)
        result = two_colors()
        result.SetSpacing(2.0, 2.0, 2.0)
        logic().showVolumeRendering(result, opacity=0.7)
        logic().setLight(True)
        slicer.mrmlScene.GetNodeByID("vtkMRMLSliceNodeRed").SetSliceOffset(48.0)
        logic().setCut(result, "slice")
        before = picture_of(view, result).astype(int)
        self.assertGreater((np.ptp(before, axis=2) > 40).mean(), 0.02, "nothing is seen")
        with tempfile.TemporaryDirectory() as folder:
            bundle = os.path.join(folder, "scene.mrb")
            self.assertTrue(slicer.mrmlScene.WriteToMRB(bundle))
            slicer.mrmlScene.Clear(0)
            self.assertEqual(picture_of(view, result).max(), 0)
            self.assertTrue(slicer.mrmlScene.ReadFromMRB(bundle))
        (result,) = slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")
        after = picture_of(self._three_d_view(), result).astype(int)
        self.assertEqual(after.shape, before.shape)
        difference = np.abs(after - before)
        self.assertLess(difference.mean(), 0.5)
        self.assertLess((difference.max(axis=2) > 16).mean(), 0.01)

    def _needs_module(self, name):
        if getattr(slicer.modules, name, None) is None:
            self.skipTest(f"Slicer's module {name} is switched off")


def _sequence_of(volumes):
    """(sequence of the volumes, which leave the scene; browser that plays it)."""
    sequence = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceNode", "beat")
    for number, node in enumerate(volumes):
        sequence.SetDataNodeAtValue(node, str(number))
        slicer.mrmlScene.RemoveNode(node)
    browser = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", "player")
    browser.SetAndObserveMasterSequenceNodeID(sequence.GetID())
    slicer.modules.sequences.logic().UpdateProxyNodesFromSequences(browser)
    return sequence, browser
