"""What the panel shows and previews: the first picture, cuts and views, a preview under transforms."""

from __future__ import annotations

import numpy as np
import pytest
import slicer
from host_fixtures import grey_node
from panel_fixtures import turned, warp

# --- preview under transforms ----------------------------------------------------------------------------------------------


def test_preview_of_a_tilted_volume_turns_the_red_view_and_says_so(ready, library, red_view):
    view = red_view
    before = slicer.util.arrayFromVTKMatrix(view.GetSliceToRAS()).copy()
    ready.parameters.inputVolume.SetAndObserveTransformNodeID(turned(slicer.mrmlScene, 30).GetID())
    ready.ui.previewButton.click()
    assert "tilted" in ready.ui.statusLabel.text
    normal = slicer.util.arrayFromVTKMatrix(view.GetSliceToRAS())[:3, 2]
    np.testing.assert_allclose(np.abs(normal), [0, np.sin(np.pi / 6), np.cos(np.pi / 6)], atol=1e-6)
    ready.exit()
    np.testing.assert_allclose(slicer.util.arrayFromVTKMatrix(view.GetSliceToRAS()), before, atol=1e-6)


def test_preview_of_a_straight_volume_leaves_the_red_view(ready, red_view):
    view = red_view
    before = slicer.util.arrayFromVTKMatrix(view.GetSliceToRAS()).copy()
    ready.ui.previewButton.click()
    assert "tilted" not in ready.ui.statusLabel.text
    assert (slicer.util.arrayFromVTKMatrix(view.GetSliceToRAS()) == before).all()


def test_preview_under_a_warp_is_thick_enough_to_be_seen_and_explained(ready):
    ready.parameters.inputVolume.SetAndObserveTransformNodeID(warp(slicer.mrmlScene).GetID())
    ready.ui.previewButton.click()
    (node,) = [n for n in slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode") if "preview" in n.GetName()]
    voxels = slicer.util.arrayFromVolume(node)
    assert voxels.shape[0] == 3, "a slice and its two faces: nothing is mixed with the black outside"
    assert (voxels[0] == voxels[1]).all() and (voxels[2] == voxels[1]).all()
    assert "non-linear" in ready.ui.statusLabel.text


def test_first_result_is_fitted_and_shown(ready, red_view):
    """Slice views and camera see the body, not the box of air around it."""
    view = red_view
    view.SetDimensions(400, 300, 1)
    camera = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLCameraNode")
    composite = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSliceCompositeNode")
    ready.ui.applyButton.click()
    assert composite.GetForegroundOpacity() == 1.0
    bounds = [0.0] * 6
    ready.parameters.outputVolume.GetRASBounds(bounds)
    width, height = view.GetFieldOfView()[:2]
    assert height >= bounds[3] - bounds[2]
    assert width / height == pytest.approx(4 / 3)
    assert height < 1.3 * max(bounds[3] - bounds[2], (bounds[1] - bounds[0]) * 3 / 4)
    centre = [(bounds[2 * axis] + bounds[2 * axis + 1]) / 2 for axis in range(3)]
    assert camera.GetFocalPoint() == pytest.approx(centre)
    distance = np.linalg.norm(np.subtract(camera.GetPosition(), centre))
    diagonal = np.linalg.norm(np.subtract(bounds[1::2], bounds[::2]))
    assert diagonal < distance < 3 * diagonal
    moved = (1.0, 2.0, 300.0)
    camera.SetPosition(*moved)
    ready.ui.applyButton.click()
    assert camera.GetPosition() == moved, "only the first time"


def test_three_d_can_be_switched_off_before_apply(ready):
    from MedColorSlicer import rendering

    ready.ui.show3DCheckBox.click()
    ready.ui.applyButton.click()
    assert rendering.display_node_of(ready.parameters.outputVolume) is None
    assert not ready.ui.show3DCheckBox.checked


def test_cut_and_views_from_the_panel(ready, red_view):
    from MedColorSlicer import cut, rendering

    view = red_view
    ready.parameters.inputVolume = grey_node(shape=(20, 20, 20))
    ready.ui.applyButton.click()
    result = ready.parameters.outputVolume
    display = rendering.display_node_of(result)
    ready.ui.cutComboBox.currentIndex = 1
    assert cut.cut_of(result) == "slice"
    faces = []
    for offset in (4.0, 11.0):
        view.SetSliceOffset(offset)
        bounds = [0.0] * 6
        display.GetROINode().GetRASBounds(bounds)
        faces.append(bounds[5])
    assert faces == pytest.approx([4.0, 11.0])
    assert ready.ui.opacitySlider.value == 0.7
    ready.ui.openViewButton.click()
    assert ready.ui.cutComboBox.currentIndex == 2
    assert ready.ui.opacitySlider.value == rendering.opacity_of(result) == 0.9, "no haze before the cut face"
    ready.ui.opacitySlider.value = 0.95
    ready.ui.halfViewButton.click()
    assert ready.ui.opacitySlider.value == 0.95
    ready.ui.frontViewButton.click()
    assert ready.ui.cutComboBox.currentIndex == 0
    assert not display.GetCroppingEnabled()
