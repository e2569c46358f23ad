"""Known colours come out as themselves in a 3-D view of Slicer, whatever is done to the rendering."""

from __future__ import annotations

import numpy as np
import pytest
import slicer
import vtk
from host_fixtures import LEFT, RIGHT, SIZE, SOLID, color_node, layout_of, look, sides, two_colors, view_widget


def unshaded(rendering, node):
    prop = rendering.display_node_of(node).GetVolumePropertyNode().GetVolumeProperty()
    prop.ShadeOff()
    return prop


def test_known_colors_come_out_as_themselves(view, rendering, rendering_show):
    node = color_node(two_colors())
    rendering_show.show(node, opacity=SOLID)
    unshaded(rendering, node)
    picture = look(view, node)
    left, right = sides(picture)
    assert np.abs(left - LEFT).max() <= 8
    assert np.abs(right - RIGHT).max() <= 8
    assert picture[: SIZE // 10].max() == 0, "nothing where the volume is black"


@pytest.mark.parametrize("with_shader", [True, False])
def test_no_dark_rim(view, rendering, monkeypatch, with_shader, rendering_show):
    """Before white, a half transparent edge is lighter than the tissue; only a dark rim is darker."""
    node = color_node(two_colors())
    display = rendering_show.show(node, opacity=SOLID)
    unshaded(rendering, node)
    if not with_shader:  # what the shader replacement is for
        display.GetShaderPropertyNode().GetShaderProperty().ClearAllFragmentShaderReplacements()
    monkeypatch.setattr(view, "background", (1.0, 1.0, 1.0))
    brightest = np.delete(look(view, node).max(axis=2), np.s_[SIZE // 2 - 4 : SIZE // 2 + 4], axis=1)  # not the seam
    if with_shader:
        assert brightest.min() >= 200 - 8
    else:
        assert (brightest < 170).mean() > 0.02


def test_shading_keeps_hue_and_stays_bright(view, rendering, rendering_show):
    node = color_node(two_colors())
    rendering_show.show(node, opacity=SOLID)
    left, right = sides(look(view, node))
    for color, known in ((left, LEFT), (right, RIGHT)):
        assert color.max() > 0.6 * 200
        np.testing.assert_allclose(color / color.max(), np.array(known) / 200, atol=0.06)


@pytest.mark.parametrize("scale", [0.25, 0.5, 1.0])
def test_curve_follows_the_luminance_range(view, rendering, scale, rendering_show):
    """The same tissue is visible whether or not a single voxel of luminance 255 stretches VTK's alpha axis."""
    rgb = (two_colors() * scale).astype(np.uint8)
    anchored = rgb.copy()
    anchored[0, 0, 0] = 255
    pictures = []
    for voxels in (rgb, anchored):
        node = color_node(voxels)
        rendering_show.show(node, opacity=SOLID)
        prop = unshaded(rendering, node)
        prop.SetScalarOpacityUnitDistance(0.2)  # the anchor also makes the body's box larger
        pictures.append(look(view, node))
        rendering.hide(node)
    assert sides(pictures[0])[0].max() > 0.9 * 200 * scale
    inner = (slice(SIZE // 5, -SIZE // 5),) * 2
    assert np.abs(pictures[0][inner] - pictures[1][inner]).max() <= 8


@pytest.mark.parametrize("preset", ["US-Fetal", "CT-Bones"])
def test_preset_applied_by_hand_is_repaired(host, view, rendering, preset, rendering_show):
    node = color_node(two_colors())
    display = rendering_show.show(node, opacity=0.8)
    before = look(view, node)
    display.GetVolumePropertyNode().CopyContent(host.rendering_logic.GetPresetByName(preset))
    assert np.abs(look(view, node) - before).max() <= 1


def test_independent_components_are_switched_off_again(view, rendering, rendering_show):
    node = color_node(two_colors())
    display = rendering_show.show(node, opacity=SOLID)
    before = look(view, node)
    display.GetVolumePropertyNode().GetVolumeProperty().SetIndependentComponents(True)
    assert np.abs(look(view, node) - before).max() <= 1


def test_reset_undoes_changes_by_hand(view, rendering, rendering_show):
    node = color_node(two_colors())
    display = rendering_show.show(node, opacity=SOLID)
    before = look(view, node)
    curve = vtk.vtkPiecewiseFunction()
    curve.AddPoint(0, 0)
    curve.AddPoint(255, 0.001)
    display.GetVolumePropertyNode().SetScalarOpacity(curve)
    display.GetVolumePropertyNode().GetVolumeProperty().SetAmbient(0)
    assert np.abs(look(view, node) - before).max() > 50, "changes by hand are respected until reset"
    rendering.reset(node)
    assert np.abs(look(view, node) - before).max() <= 1


@pytest.mark.parametrize("guarded", [True, False])
def test_reopened_scene_looks_the_same(host, view, rendering, tmp_path, guarded, rendering_show):
    node = color_node(two_colors())
    rendering_show.show(node, opacity=0.7)
    before = look(view, node)
    bundle = str(tmp_path / "scene.mrb")
    assert host.scene.WriteToMRB(bundle)
    if not guarded:
        from MedColorSlicer import rendering_guard

        rendering_guard.release_guards()
    host.scene.Clear(0)
    view.make_plain()
    assert view.render().max() == 0
    assert host.scene.ReadFromMRB(bundle)
    node = slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")[0]
    assert node.GetVoxelVectorType() == node.VoxelVectorTypeColorRGB
    assert np.abs(look(view, node) - before).max() <= 1
    assert rendering.opacity_of(node) == 0.7


def test_preset_is_repaired_in_a_reopened_scene_too(host, view, rendering, tmp_path, rendering_show):
    node = color_node(two_colors())
    rendering_show.show(node, opacity=SOLID)
    before = look(view, node)
    assert host.scene.WriteToMRB(str(tmp_path / "scene.mrb"))
    host.scene.Clear(0)
    assert host.scene.ReadFromMRB(str(tmp_path / "scene.mrb"))
    node = slicer.util.getNodesByClass("vtkMRMLVectorVolumeNode")[0]
    prop = rendering.display_node_of(node).GetVolumePropertyNode()
    prop.CopyContent(host.rendering_logic.GetPresetByName("CT-Bones"))
    assert np.abs(look(view, node) - before).max() <= 1


def test_new_voxels_keep_the_user_curve_at_the_same_luminance(view, rendering, rendering_show):
    node = color_node(two_colors())
    display = rendering_show.show(node, opacity=SOLID)
    curve = vtk.vtkPiecewiseFunction()  # by hand: only what is brighter than luminance 120 is seen
    top = rendering.measured_axis(node)["range"][1]
    for luminance, opacity in ((0, 0), (119, 0), (121, 1), (255, 1)):
        curve.AddPoint(luminance * top / 255, opacity)
    display.GetVolumePropertyNode().SetScalarOpacity(curve)
    unshaded(rendering, node)
    left, right = sides(look(view, node))
    assert np.abs(left - LEFT).max() <= 8
    assert right.max() == 0
    brighter = two_colors()
    brighter[20:28, 20:28, 20:28] = 255
    slicer.util.updateVolumeFromArray(node, brighter)
    rendering.refresh(node)
    left, right = sides(look(view, node))
    assert np.abs(left - LEFT).max() <= 8
    assert right.max() == 0
    assert not display.GetVolumePropertyNode().GetVolumeProperty().GetShade()


def test_display_is_created_only_when_asked_for_and_can_be_hidden(view, rendering, rendering_show):
    node = color_node(two_colors())
    assert rendering.display_node_of(node) is None
    rendering.hide(node)
    assert rendering.display_node_of(node) is None
    rendering_show.show(node, opacity=SOLID)
    assert look(view, node).max() > 0
    rendering.hide(node)
    assert look(view, node).max() == 0
    rendering_show.show(node, opacity=SOLID)
    assert look(view, node).max() > 0


def test_other_rendering_methods_are_replaced_by_gpu_ray_casting(host, view, rendering, rendering_show):
    node = color_node(two_colors())
    display = host.scene.AddNewNodeByClass("vtkMRMLCPURayCastVolumeRenderingDisplayNode")
    node.AddAndObserveDisplayNodeID(display.GetID())
    assert rendering_show.show(node, opacity=SOLID).IsA("vtkMRMLGPURayCastVolumeRenderingDisplayNode")
    assert not [n for n in slicer.util.getNodesByClass("vtkMRMLCPURayCastVolumeRenderingDisplayNode")]
    assert look(view, node).max() > 100


def test_less_opacity_shows_less(view, rendering, rendering_show):
    node = color_node(two_colors())
    means = []
    for opacity in (0.0, 0.2, 0.5, 1.0):
        rendering_show.show(node, opacity=opacity)
        means.append(look(view, node).mean())
    assert means[0] == 0
    assert means == sorted(means)
    assert means[1] < 0.6 * means[3]


def test_slider_does_not_lose_the_look_of_a_saved_display(rendering, rendering_show):
    node = color_node(two_colors())
    display = rendering_show.show(node, opacity=SOLID)
    for opacity in (0.1, 0.9):
        rendering.set_opacity(node, opacity)
        assert rendering.opacity_of(node) == opacity
        assert rendering.has_medcolor_look(display)


def test_black_volume_can_be_shown(view, rendering, rendering_show):
    node = color_node(np.zeros((8, 8, 8, 3), np.uint8))
    rendering_show.show(node, opacity=SOLID)
    assert look(view, node).max() == 0


def test_one_color_volume_can_be_shown(view, rendering, rendering_show):
    node = color_node(np.full((16, 16, 16, 3), (200, 120, 60), np.uint8))
    rendering_show.show(node, opacity=SOLID)
    unshaded(rendering, node)
    assert np.abs(look(view, node)[SIZE // 2, SIZE // 2] - LEFT).max() <= 8


def test_views_created_later_show_it(view, rendering, second_view, rendering_show):
    node = color_node(two_colors())
    rendering_show.show(node, opacity=SOLID)
    assert look(second_view, node).max() > 100
    rendering_show.show(node, [view.node])
    assert look(second_view, node).max() == 0
    assert look(view, node).max() > 100


def test_guard_lets_go_of_a_closed_scene(host, rendering, rendering_show):
    from MedColorSlicer import rendering_guard

    rendering_show.show(color_node(two_colors(8, 3)))
    guard = rendering_guard.guard_of(host.scene)
    assert len(guard._watched) == 1
    host.scene.Clear(0)
    assert not guard._watched
    assert {type(observed).__name__ for observed, *_ in guard.Observations} == {"vtkMRMLScene"}


def test_hidden_volume_property_is_not_shared(rendering, rendering_show):
    first, second = color_node(two_colors()), color_node(two_colors(), "other")
    assert rendering_show.show(first).GetVolumePropertyNodeID() != rendering_show.show(second).GetVolumePropertyNodeID()


def test_self_test_of_the_3d_view_passes_here_too(host, view, rendering, monkeypatch):
    """The method that looks at Slicer's own view, with this view in its place."""
    from MedColorSlicer.selftest import MedColorTest

    widget = view_widget(
        mrmlViewNode=lambda: view.node, renderWindow=lambda: view.window, forceRender=view.window.Render
    )
    monkeypatch.setattr(slicer.app, "layoutManager", layout_of(widget))
    monkeypatch.setattr(view, "background", (0.0, 0.0, 0.0))
    view.renderer.GetActiveCamera().SetParallelProjection(False)
    view.renderer.GetActiveCamera().SetViewAngle(30)
    MedColorTest("test_known_colors_in_the_3d_view").debug()


@pytest.mark.parametrize("kind", ["any colours", "two colours", "black", "one colour"])
def test_a_worker_measures_the_same_axis_as_slicer(scene, rendering, kind):
    """In NumPy, luminance truncated as VTK's filter does; known afterwards until the voxels change."""
    rgb = {
        "any colours": np.random.default_rng(0).integers(0, 256, (40, 50, 60, 3), dtype=np.uint8),
        "two colours": two_colors(24, 8),
        "black": np.zeros((4, 5, 6, 3), np.uint8),
        "one colour": np.full((4, 5, 6, 3), (1, 0, 2), np.uint8),
    }[kind]
    node = color_node(rgb)
    node.SetSpacing(0.5, 1.5, 3.0)
    measured = rendering._measured(node)
    assert rendering.axis_of(rgb, node.GetSpacing()) == measured
    rendering.know_axis(node, {"range": [0.0, 1.0], "unit_mm": 7.0})
    assert rendering.measured_axis(node)["unit_mm"] == 7.0
    slicer.util.updateVolumeFromArray(node, rgb)
    assert rendering.measured_axis(node) == measured


@pytest.mark.parametrize("known", [True, False], ids=["from a worker", "measured here"])
def test_unit_distance_follows_a_corrected_spacing(scene, rendering, known):
    """The voxels are the same, their size is not."""
    node = color_node(two_colors(16, 6))
    first = rendering.axis_of(slicer.util.arrayFromVolume(node), node.GetSpacing())
    if known:
        rendering.know_axis(node, first)
    assert rendering.measured_axis(node) == first
    node.SetSpacing(3, 3, 3)
    assert rendering.measured_axis(node) == rendering._measured(node) != first
