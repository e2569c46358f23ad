"""The test behind Slicer's "Reload and Test", and of `Testing/Slicer/run_in_slicer.py`.

What needs torch or a 3-D view is skipped with a reason where there is none; everything else runs in any Slicer. Where a
test is not about the colours themselves, a quick stand-in takes the place of the library's computation.
"""

import json
import os
import tempfile
import time
import unittest

import slicer
import vtk
from slicer.ScriptedLoadableModule import ScriptedLoadableModuleTest

from .selftest_nodes import NodeCases
from .selftest_samples import (
    LEFT,
    RIGHT,
    StandIn,
    grey_node,
    leave_panel,
    logic,
    opacity_curve_of,
    open_panel,
    picture_node,
    picture_now,
    picture_of,
    raise_value_error,
    two_colors,
)

TOLERANCE = 8  # levels of 255


class MedColorTest(NodeCases, ScriptedLoadableModuleTest):
    """Each method is one test; `runTest` runs them all, as Slicer's button does."""

    def runTest(self):
        suite = unittest.defaultTestLoader.loadTestsFromTestCase(type(self))
        result = unittest.TextTestRunner(verbosity=2).run(suite)
        for test, reason in result.skipped:
            print(f"SKIPPED {test.id()}: {reason}")
        if not result.wasSuccessful():
            raise AssertionError(f"{len(result.failures) + len(result.errors)} tests failed; see the log")

    def setUp(self):
        slicer.mrmlScene.Clear(0)

    # --- scene ---------------------------------------------------------------------------------------------------

    def test_result_takes_type_geometry_and_transform_of_the_input(self):
        import numpy as np

        grey = grey_node()
        matrix = vtk.vtkMatrix4x4()
        matrix.DeepCopy((0, -2, 0, 5, 1, 0, 0, 6, 0, 0, 3, 7, 0, 0, 0, 1))
        grey.SetIJKToRASMatrix(matrix)
        transform = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLinearTransformNode")
        grey.SetAndObserveTransformNodeID(transform.GetID())
        result = self._process(grey)
        self.assertTrue(result.IsA("vtkMRMLVectorVolumeNode"))
        self.assertEqual(result.GetVoxelVectorType(), result.VoxelVectorTypeColorRGB)
        self.assertEqual(result.GetTransformNodeID(), transform.GetID())
        self.assertEqual(result.GetName(), "grey coloured")
        got = vtk.vtkMatrix4x4()
        result.GetIJKToRASMatrix(got)
        np.testing.assert_allclose(slicer.util.arrayFromVTKMatrix(got), slicer.util.arrayFromVTKMatrix(matrix))
        self.assertEqual(json.loads(result.GetAttribute("MedColor.Settings"))["preset"], "balanced")
        hierarchy = slicer.vtkMRMLSubjectHierarchyNode.GetSubjectHierarchyNode(slicer.mrmlScene)
        item, own = hierarchy.GetItemByDataNode(grey), hierarchy.GetItemByDataNode(result)
        if item:
            self.assertEqual(hierarchy.GetItemParent(own), hierarchy.GetItemParent(item))

    def test_rerun_fills_the_same_node(self):
        grey = grey_node()
        result = self._process(grey)
        count = slicer.mrmlScene.GetNumberOfNodes()
        self.assertIs(self._process(grey, result), result)
        self.assertEqual(slicer.mrmlScene.GetNumberOfNodes(), count)

    def test_cancel_leaves_the_scene_as_it_was(self):
        from MedColorLib.errors import Cancelled

        grey = grey_node()
        count = slicer.mrmlScene.GetNumberOfNodes()
        with self.assertRaises(Cancelled):
            self._process(grey, cancelled=lambda: True)
        self.assertEqual(slicer.mrmlScene.GetNumberOfNodes(), count)

    def test_bad_inputs_say_what_to_do(self):
        from MedColorLib.errors import MedColorError

        for make in (
            lambda: None,
            lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLScalarVolumeNode"),
            lambda: slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode"),
            two_colors,
        ):
            with self.assertRaises(MedColorError) as caught:
                self._process(make())
            self.assertTrue(str(caught.exception).endswith("."))

    def test_confidence_is_a_volume_beside_the_result(self):
        result = self._process(grey_node(), confidence=True)
        volume = result.GetNodeReference("MedColorConfidence")
        self.assertEqual(volume.GetClassName(), "vtkMRMLScalarVolumeNode")
        self.assertEqual(int(slicer.util.arrayFromVolume(volume).max()), 75)

    def test_samples_are_offered(self):
        import importlib.util

        if importlib.util.find_spec("SampleData") is None:
            self.skipTest("the module Sample Data is switched off")
        from MedColorSlicer import samples

        folder = os.path.join(os.path.dirname(slicer.util.modulePath("MedColor")), "Resources")
        samples.register(folder)
        samples.register(folder)
        names = [source.sampleName for source in slicer.modules.sampleDataSources[samples.CATEGORY]]
        self.assertEqual(sorted(names), [samples.CT_CHEST, samples.CRYOSECTION, samples.PHANTOM])

    # --- rendering -----------------------------------------------------------------------------------------------

    def test_rendering_survives_preset_and_scene_file(self):
        from MedColorSlicer import rendering

        result = two_colors()
        display = logic().showVolumeRendering(result, opacity=0.8)
        curve = opacity_curve_of(display)
        presets = slicer.modules.volumerendering.logic()
        display.GetVolumePropertyNode().CopyContent(presets.GetPresetByName("CT-Bones"))
        self.assertEqual(opacity_curve_of(display), curve)
        with tempfile.TemporaryDirectory() as folder:
            bundle = os.path.join(folder, "scene.mrb")
            self.assertTrue(slicer.mrmlScene.WriteToMRB(bundle))
            slicer.mrmlScene.Clear(0)
            self.assertTrue(slicer.mrmlScene.ReadFromMRB(bundle))
        (result,) = slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")
        self.assertEqual(result.GetVoxelVectorType(), result.VoxelVectorTypeColorRGB)
        display = rendering.display_node_of(result)
        for before, after in zip(curve, opacity_curve_of(display)):
            self.assertAlmostEqual(before[0], after[0], places=3)
            self.assertAlmostEqual(before[1], after[1], places=3)
        self.assertEqual(rendering.opacity_of(result), 0.8)
        self.assertEqual(display.GetShaderPropertyNode().GetShaderProperty().GetNumberOfShaderReplacements(), 3)

    def test_known_colors_in_the_3d_view(self):
        view = self._three_d_view()
        result = two_colors()
        display = logic().showVolumeRendering(result, opacity=0.88)
        display.GetVolumePropertyNode().GetVolumeProperty().ShadeOff()
        self._assert_both_colors(picture_of(view, result))
        display.GetVolumePropertyNode().CopyContent(slicer.modules.volumerendering.logic().GetPresetByName("CT-Bones"))
        display.GetVolumePropertyNode().GetVolumeProperty().ShadeOff()
        self._assert_both_colors(picture_of(view, result))
        logic().hideVolumeRendering(result)
        self.assertEqual(picture_of(view, result).max(), 0)

    def test_comparison_layout(self):
        from MedColorSlicer import three_d_views

        manager = slicer.app.layoutManager()
        if manager is None:
            self.skipTest("no main window, so there is no layout; run without --no-main-window")
        grey, result = grey_node((48, 48, 48)), two_colors()
        before = manager.layout
        color_view, grey_view = logic().showComparison(grey, result)
        self.assertNotEqual(color_view.GetID(), grey_view.GetID())
        self.assertEqual(manager.layout, slicer.vtkMRMLLayoutNode.SlicerLayoutDual3DView)
        slicer.app.processEvents()
        views = three_d_views.shown_views()
        self.assertEqual([view.mrmlViewNode() for view in views], [color_view, grey_view])
        for view in views:
            self.assertGreater(picture_now(view).std(), 1.0, f"{view.mrmlViewNode().GetName()} shows nothing")
        logic().hideComparison(grey, result)
        self.assertEqual(manager.layout, before)

    # --- panel ---------------------------------------------------------------------------------------------------

    def test_panel_apply_preview_and_display(self):
        from MedColorSlicer import rendering, three_d_views

        panel = self._panel()
        self.assertFalse(panel.ui.applyButton.enabled)
        self.assertTrue(panel.ui.applyButton.toolTip)
        grey, picture = grey_node((12, 24, 24)), picture_node()
        panel.parameters.inputVolume = grey
        panel.parameters.referenceSource = "node"
        panel.parameters.referenceNode = picture
        self.assertTrue(panel.ui.applyButton.enabled, panel.ui.applyButton.toolTip)
        with self._stand_in(seconds=0.2):
            panel.ui.previewButton.click()
            self.assertIn("Preview", panel.ui.statusLabel.text)
            panel.ui.applyButton.click()
        result = panel.parameters.outputVolume
        self.assertIsNotNone(result, panel.ui.statusLabel.text)
        self.assertEqual(panel.ui.applyButton.text, "Apply")
        self.assertFalse(
            [n for n in slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode") if "preview" in n.GetName()]
        )
        self.assertTrue(panel.ui.show3DCheckBox.checked, "the result is shown at once")
        if three_d_views.shown_views():
            self.assertIn("Done", panel.ui.statusLabel.text)  # nothing was found wrong with the view
        panel.ui.opacitySlider.value = 0.5
        self.assertAlmostEqual(rendering.opacity_of(result), 0.5)
        panel.ui.resetRenderingButton.click()
        panel.ui.compareCheckBox.click()
        panel.ui.fadeSlider.value = 0.25
        panel.ui.compareCheckBox.click()
        panel.ui.show3DCheckBox.click()
        self.assertFalse(rendering.display_node_of(result).GetVisibility())

    def test_panel_takes_what_comes_into_the_scene(self):
        panel = self._panel()
        self.assertIsNone(panel.parameters.inputVolume)
        grey = grey_node((12, 24, 24))
        slicer.app.processEvents()
        self.assertIs(panel.parameters.inputVolume, grey)
        with tempfile.TemporaryDirectory() as folder:
            bundle = os.path.join(folder, "scene.mrb")
            self.assertTrue(slicer.mrmlScene.WriteToMRB(bundle))
            slicer.mrmlScene.Clear(0)
            slicer.app.processEvents()
            self.assertIsNone(panel.parameters.inputVolume)
            self.assertTrue(slicer.mrmlScene.ReadFromMRB(bundle))
            slicer.app.processEvents()
        self.assertEqual(panel.parameters.inputVolume.GetName(), "grey")

    def test_cut_follows_the_red_slice(self):
        from MedColorSlicer import cut

        red = slicer.mrmlScene.GetNodeByID("vtkMRMLSliceNodeRed")
        if red is None:
            self.skipTest("no slice views; run without --no-main-window")
        result = two_colors()
        display = logic().showVolumeRendering(result)
        self._panel().parameters.outputVolume = result
        logic().setCut(result, "slice")
        bounds = [0.0] * 6
        for offset in (12.0, 30.0):
            red.SetSliceOffset(offset)
            display.GetROINode().GetRASBounds(bounds)
            self.assertTrue(any(abs(face - offset) < 1e-3 for face in bounds[4:]), (bounds, offset))
        self.assertEqual(cut.cut_of(result), "slice")

    def test_panel_values_of_the_smoother(self):
        from MedColorSlicer import parameters

        panel = self._panel()
        p = panel.parameters
        p.smoother, p.smootherAutomatic = "guided", False
        boxes = {option.name: box for option, box in panel.smoother._boxes["guided"]}
        boxes["radius"].value = 5
        boxes["eps"].value = 3.5
        self.assertEqual(parameters.settings_from(p).smoother_options, {"radius": 5, "eps": 3.5})
        parameters.store_options(p, {"radius": 7})
        self.assertEqual((boxes["radius"].value, boxes["eps"].value), (7, 2.0))
        panel.ui.smootherAutomaticCheckBox.click()
        self.assertIsNone(parameters.settings_from(p).smoother_options)

    def test_panel_live_preview_follows_the_slices(self):
        import numpy as np

        from MedColorSlicer import samples

        self._needs_packages()
        red = slicer.mrmlScene.GetNodeByID("vtkMRMLSliceNodeRed")
        if red is None:
            self.skipTest("no slice views; run without --no-main-window")
        panel = self._panel()
        panel.parameters.inputVolume, panel.parameters.referenceNode = samples.load_phantom()
        panel.parameters.referenceSource = "node"
        bounds = [0.0] * 6
        panel.parameters.inputVolume.GetRASBounds(bounds)
        middle = [(bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)]
        red.SetSliceToRASByNTP(0, 0, 1, -1, 0, 0, *middle, 0)
        panel.ui.followCheckBox.click()
        pictures = []
        for shift in (0.0, 20.0):
            red.SetSliceOffset(middle[2] + shift)
            self._wait_for(lambda: panel.live.idle and panel.live.picture("Red") is not None)
            pictures.append(slicer.util.arrayFromVolume(panel.live.picture("Red")).copy())
            self.assertGreater(int(np.ptp(pictures[-1].astype(int), axis=3).max()), 20, panel.ui.statusLabel.text)
        self.assertTrue((pictures[0] != pictures[1]).any())
        panel.ui.lightnessSlider.value = 0.1
        self._wait_for(lambda: panel.live.idle)
        self.assertTrue((slicer.util.arrayFromVolume(panel.live.picture("Red")) != pictures[1]).any())
        panel.ui.followCheckBox.click()
        self.assertIsNone(panel.live.picture("Red"))

    def test_panel_exposure_body_and_region(self):
        from MedColorSlicer import parameters

        panel = self._panel()
        panel.parameters.inputVolume = grey_node((12, 24, 24))
        panel.ui.exposureComboBox.currentIndex = 2
        panel.ui.exposureGainSlider.value = 2.5
        panel.ui.bodyComboBox.currentIndex = 1
        settings = parameters.settings_from(panel.parameters)
        self.assertEqual((settings.exposure, settings.body), (2.5, "all"))
        panel.ui.roiSelector.addNode()
        self.assertIsNotNone(panel.parameters.roi)
        bounds, box = [0.0] * 6, [0.0] * 6
        panel.parameters.inputVolume.GetRASBounds(bounds)
        panel.parameters.roi.GetRASBounds(box)
        for edge, wanted in zip(box, bounds):
            self.assertAlmostEqual(edge, wanted, 3)

    def test_panel_cancel_and_error(self):
        panel = self._panel()
        panel.parameters.inputVolume = grey_node((12, 24, 24))
        panel.parameters.referenceSource = "node"
        panel.parameters.referenceNode = picture_node()
        count = slicer.mrmlScene.GetNumberOfNodes()
        with self._stand_in(seconds=2.0) as stand_in:
            stand_in.in_the_middle = lambda: panel.job.cancel()  # noqa: PLW0108 - there is no job yet
            panel.ui.applyButton.click()
        self.assertIn("Cancelled", panel.ui.statusLabel.text)
        with self._stand_in() as stand_in:
            stand_in.in_the_middle = raise_value_error
            panel.ui.applyButton.click()
        self.assertIn("ValueError", panel.ui.statusLabel.text)
        self.assertEqual(slicer.mrmlScene.GetNumberOfNodes(), count)
        self.assertTrue(panel.ui.applyButton.enabled)

    def test_panel_survives_scene_close_leave_and_return(self):
        panel = self._panel()
        slicer.mrmlScene.Clear(0)
        leave_panel()
        self.assertIsNone(panel.parameters)
        self._panel()
        self.assertFalse(panel.ui.applyButton.enabled)

    # --- the whole way -------------------------------------------------------------------------------------------

    def test_phantom_is_colored(self):
        from MedColorSlicer import samples

        self._needs_packages()
        grey, picture = samples.load_phantom()
        result = logic().process(grey, picture, preset="draft", features="embedded", slices=(20, 22))
        voxels = slicer.util.arrayFromVolume(result)
        self.assertEqual(voxels.shape[:3], slicer.util.arrayFromVolume(grey).shape)
        self.assertGreater(int((voxels.max(axis=3).astype(int) - voxels.min(axis=3)).max()), 20)

    # --- helpers -------------------------------------------------------------------------------------------------

    def _process(self, grey, output=None, **options):
        import numpy as np

        with self._stand_in():
            return logic().process(grey, [np.full((4, 5, 3), (180, 90, 40), np.uint8)], output, **options)

    def _needs_packages(self):
        from MedColorSlicer import dependencies

        if dependencies.torch_missing() or dependencies.missing():
            missing = (["torch"] if dependencies.torch_missing() else []) + dependencies.missing()
            self.skipTest(f"packages are not installed: {', '.join(missing)}")

    def _wait_for(self, condition, seconds=60.0):
        end = time.monotonic() + seconds
        slicer.app.processEvents()
        while not condition():
            self.assertLess(time.monotonic(), end, "waited in vain")
            slicer.app.processEvents()
            time.sleep(0.01)

    def _stand_in(self, seconds=0.0):
        return StandIn(seconds)

    def _panel(self):
        self.addCleanup(leave_panel)
        return open_panel()

    def _three_d_view(self):
        from MedColorSlicer import three_d_views

        views = three_d_views.shown_views()
        if not views:
            self.skipTest("no 3-D view; run without --no-main-window, in a layout that has one")
        return views[0]

    def _assert_both_colors(self, picture):
        import numpy as np

        for color in (LEFT, RIGHT):
            near = (np.abs(picture.astype(int) - color).max(axis=2) <= TOLERANCE).mean()
            self.assertGreater(near, 0.02, f"{color} is not seen in the 3-D view")
