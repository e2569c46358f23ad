"""Grey beside colour in two 3-D views of Slicer, and bodies that are cut open."""

from __future__ import annotations

import numpy as np
import pytest
import slicer
from host_fixtures import SIZE, SOLID, color_node, grey_node, layout_of, look, sides, two_colors, view_widget


def test_comparison_shows_grey_and_color_in_linked_views(host, view, second_view, rendering, rendering_show):
    from MedColorSlicer import comparison

    layout = slicer.vtkMRMLLayoutNode()
    host.scene.AddNode(layout)
    layout.SetViewArrangement(layout.SlicerLayoutFourUpView)
    composite = host.scene.AddNewNodeByClass("vtkMRMLSliceCompositeNode")
    rgb = two_colors()
    color = color_node(rgb)
    grey = slicer.util.addVolumeFromArray(rgb.max(axis=3).astype(np.int16), name="grey")
    rendering_show.show(color, opacity=SOLID)
    views = comparison.show(grey, color, 0.3)
    assert [v.GetLayoutName() for v in views] == ["1", "2"]
    assert all(v.GetLinkedControl() for v in views)
    assert layout.GetViewArrangement() == layout.SlicerLayoutDual3DView
    assert composite.GetBackgroundVolumeID() == grey.GetID()
    assert composite.GetForegroundVolumeID() == color.GetID()
    assert composite.GetForegroundOpacity() == pytest.approx(0.3)
    colored, plain = look(view, color), look(second_view, color)
    assert np.ptp(sides(colored)[0]) > 60
    assert np.ptp(sides(plain)[0]) <= 2
    assert sides(plain)[0].max() > 60
    comparison.hide(grey, color)
    assert layout.GetViewArrangement() == layout.SlicerLayoutFourUpView
    assert np.ptp(sides(look(second_view, color))[0]) > 60


def camera_node(scene, view):
    """The camera of a view, as Slicer has it: in perspective, and far from the body."""
    for n in range(scene.GetNumberOfNodesByClass("vtkMRMLCameraNode")):
        camera = scene.GetNthNodeByClass(n, "vtkMRMLCameraNode")
        if camera.GetLayoutName() == view.node.GetLayoutName():
            return camera
    camera = scene.AddNewNodeByClass("vtkMRMLCameraNode")
    camera.SetLayoutName(view.node.GetLayoutName())
    return camera


def seen_by(view, camera):
    """What a view draws through the camera of its own, clipped as that says."""
    view.make_plain()
    view.renderer.SetActiveCamera(camera.GetCamera())
    return view.render().astype(int)


def test_comparison_is_seen_through_the_linked_camera(host, view, second_view, rendering_show):
    """The camera is copied to where its own clipping range leaves nothing to be seen."""
    from MedColorSlicer import comparison

    rgb = two_colors()
    color = color_node(rgb)
    grey = slicer.util.addVolumeFromArray(rgb.max(axis=3).astype(np.int16), name="grey")
    cameras = [camera_node(host.scene, each) for each in (view, second_view)]
    cameras[0].SetPosition(23.5, 1209.0, 23.5)
    cameras[0].SetFocalPoint(23.5, 23.5, 23.5)
    cameras[0].SetViewUp(0, 0, 1)
    cameras[0].GetCamera().SetViewAngle(4)
    cameras[1].GetCamera().SetViewAngle(4)
    cameras[1].GetCamera().SetClippingRange(0.01, 1000)
    before = [each.renderer.GetActiveCamera() for each in (view, second_view)]
    try:
        rendering_show.show(color, opacity=SOLID)
        comparison.show(grey, color)
        assert cameras[1].GetPosition() == cameras[0].GetPosition()
        plain = seen_by(second_view, cameras[1])
        assert (plain.max(axis=2) > 60).mean() > 0.1
        assert np.ptp(plain[SIZE // 2, SIZE // 2]) <= 2, "grey"
    finally:
        for each, camera in zip((view, second_view), before):
            each.renderer.SetActiveCamera(camera)


def test_grey_half_shows_the_body_alone_and_as_bright_as_the_colours(
    host, view, second_view, rendering, rendering_show
):
    """A headrest beside the body, and a display window that is far too narrow."""
    from MedColorSlicer import comparison

    rgb = two_colors(left=(130, 130, 130), right=(130, 130, 130))
    values = rgb[..., 0].astype(np.int16)
    values[:, 42:46, :] = 130  # the headrest was not coloured
    values[values == 0] = 5
    values[0, 0, 0], values[0, 0, 1] = 0, 255
    color = color_node(rgb)
    color.SetAttribute("MedColor.Settings", '{"window": [0, 255]}')
    grey = slicer.util.addVolumeFromArray(values, name="grey")
    grey.CreateDefaultDisplayNodes()
    grey.GetDisplayNode().SetAutoWindowLevel(False)
    grey.GetDisplayNode().SetWindowLevel(10, 5)
    rendering_show.show(color, opacity=SOLID)
    comparison.show(grey, color)
    coloured, plain = look(view, color), look(second_view, color)
    assert coloured.max() > 60
    assert np.abs(coloured - plain).max() <= 3
    comparison.hide(grey, color)
    assert rendering.display_node_of(grey) is None


def test_second_comparison_draws_the_views_again(host, view, second_view, rendering, monkeypatch):
    """A view that was hidden while the other one was turned does not notice by itself."""
    from MedColorSlicer import comparison

    views = [view_widget(name, visible=False) for name in "21"]  # not yet visible: the layout is new
    monkeypatch.setattr(slicer.app, "layoutManager", layout_of(*views))
    color, grey = color_node(two_colors()), grey_node(shape=(48, 48, 48))
    for _time in range(2):
        for each in views:
            each.asked.clear()
        comparison.show(grey, color)
        assert all(each.asked for each in views)
        comparison.hide(grey, color)


@pytest.mark.parametrize("kind", ["none", "slice", "box"])
def test_cuts_take_away_what_they_say(host, view, rendering, rendering_show, kind):
    """Seen from behind; the upper part of the picture is the upper part of the ball."""
    from MedColorSlicer import cut

    node = color_node(two_colors())
    rendering_show.show(node, opacity=1.0)
    whole = look(view, node).max(axis=2) > 30
    cut.set_cut(node, kind)
    left = look(view, node).max(axis=2) > 30
    upper, lower = left[: SIZE // 2 - 4], left[SIZE // 2 + 4 :]
    assert lower.sum() > 0.95 * whole[SIZE // 2 + 4 :].sum()
    if kind == "none":
        assert (left == whole).all()
    elif kind == "slice":
        assert upper.sum() == 0
    else:
        assert 0 < upper.sum() < 0.9 * whole[: SIZE // 2 - 4].sum()
    cut.set_cut(node, "none")
    assert ((look(view, node).max(axis=2) > 30) == whole).all()


def test_comparison_respects_a_grey_rendering_of_the_user(host, view, second_view, rendering):
    from MedColorSlicer import comparison

    color, grey = color_node(two_colors()), grey_node(shape=(48, 48, 48))
    display = host.rendering_logic.CreateDefaultVolumeRenderingNodes(grey)
    display.GetVolumePropertyNode().GetVolumeProperty().SetAmbient(0.77)
    comparison.show(grey, color)
    assert display.GetVolumePropertyNode().GetVolumeProperty().GetAmbient() == pytest.approx(0.77)
