"""Which of Slicer's 3-D views is meant: never one that the layout hides, in whatever order the layout manager has them."""

from __future__ import annotations

import pytest
import slicer
from host_fixtures import color_node, grey_node, layout_of, two_colors, view_widget


@pytest.fixture
def put_views(scene, monkeypatch):
    """Give Slicer's window these 3-D views; the scene has their nodes."""
    added = []

    def put(*views):
        for view in views:
            if view.mrmlViewNode() not in added:
                slicer.mrmlScene.AddNode(view.mrmlViewNode())
                added.append(view.mrmlViewNode())
        monkeypatch.setattr(slicer.app, "layoutManager", layout_of(*views))
        return views

    yield put
    for node in added:
        slicer.mrmlScene.RemoveNode(node)


def names_of(views):
    return [view.mrmlViewNode().GetLayoutName() for view in views]


@pytest.fixture
def camera(scene):
    """Makes camera nodes; as singletons they would outlive the scene."""
    added = []

    def make(name, position):
        node = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLCameraNode")
        node.SetLayoutName(name)
        node.SetPosition(*position)
        added.append(node)
        return node

    yield make
    for node in added:
        slicer.mrmlScene.RemoveNode(node)


def test_views_come_in_the_order_of_their_names_and_hidden_ones_are_not_shown(put_views):
    from MedColorSlicer import three_d_views

    assert three_d_views.shown_views() == []
    put_views(*(view_widget(name, visible=name != "2") for name in ("10", "2", "1", "3")))
    assert names_of(three_d_views.shown_views()) == ["1", "3", "10"]
    assert names_of(three_d_views.all_views()) == ["1", "2", "3", "10"]


def test_views_of_a_layout_that_was_just_chosen_count_before_they_are_seen(put_views):
    from MedColorSlicer import three_d_views

    new, old = view_widget("1", visible=False, mapped=True), view_widget("2", visible=False)
    put_views(old, new)
    assert three_d_views.shown_views() == [new]
    old.visible = True
    assert three_d_views.shown_views() == [old], "what is seen counts more"


def test_tabs_are_views_of_the_layout_but_one_is_seen(put_views):
    from MedColorSlicer import three_d_views

    _hidden, seen = put_views(view_widget("1", visible=False, mapped=True), view_widget("2"))
    assert three_d_views.shown_views() == [seen]


def test_speed_is_that_of_a_view_that_is_drawn(put_views):
    """A hidden view is done in no time."""
    from MedColorSlicer import light

    hidden, seen = put_views(view_widget("1", visible=False), view_widget("2"))
    assert light._seconds_per_frame() is not None
    assert (hidden.drawn, len(seen.drawn)) == ([], 2)
    seen.visible = False
    assert light._seconds_per_frame() is None
    light.first_time(slicer.mrmlScene)
    assert not light.is_on(slicer.mrmlScene), "nothing is chosen while nothing was measured"


def test_cut_faces_the_view_that_is_seen(put_views, camera, rendering_show):
    from MedColorSlicer import cut, rendering

    put_views(view_widget("2"), view_widget("1", visible=False))
    camera("1", (0, 0, -500))
    camera("2", (0, 0, 500))
    node = color_node(two_colors(16, 6))
    display = rendering_show.show(node)
    cut.set_cut(node, "slice")
    assert float(display.GetNodeReference(cut.ROLE).GetAttribute("MedColor.Side")) == 1.0
    assert rendering.display_node_of(node).GetCroppingEnabled()


def test_cut_faces_the_first_camera_where_there_is_no_window(camera):
    from MedColorSlicer import three_d_views

    first = camera("1", (0, 0, 1))
    camera("2", (0, 0, 2))
    assert three_d_views.camera_of(slicer.mrmlScene, None) is first


def test_shadows_that_know_no_volumes_are_left_out(put_views, monkeypatch):
    """VTK 9.1 draws the scene without the volume then."""
    from MedColorSlicer import light

    (view,) = put_views(view_widget("1"))
    monkeypatch.setattr(light.vtk, "vtkSSAOPass", type("vtkSSAOPass", (), {}))
    view.mrmlViewNode().SetShadowsVisibility(True)  # as a scene of a newer Slicer has it
    light.switch(slicer.mrmlScene, True)
    assert light.is_on(slicer.mrmlScene)
    assert view.mrmlViewNode().GetVolumeRenderingSurfaceSmoothing()
    assert not view.mrmlViewNode().GetShadowsVisibility()


@pytest.mark.parametrize("realistic", [True, False])
def test_views_that_a_layout_makes_later_take_the_light_of_the_others(put_views, realistic):
    """The grey half of a comparison is lit as the coloured one."""
    from MedColorSlicer import comparison, light

    (first,) = put_views(view_widget("1"))
    light.switch(slicer.mrmlScene, realistic)
    _same, second = put_views(first, view_widget("2"))
    comparison.show(grey_node(shape=(16, 16, 16)), color_node(two_colors(16, 6)))
    nodes = [view.mrmlViewNode() for view in (first, second)]
    for ask in ("GetShadowsVisibility", "GetVolumeRenderingSurfaceSmoothing"):
        assert [getattr(node, ask)() for node in nodes] == [realistic, realistic], ask


def test_box_and_letters_of_the_views_come_along_before_the_camera_is_set(scene, put_views):
    """Slicer draws them anew where its views are centred, which moves the camera."""
    from MedColorSlicer import view_fit

    camera, centred = scene.AddNewNodeByClass("vtkMRMLCameraNode"), []

    def centre(name):
        centred.append(name)
        camera.SetFocalPoint(1, 2, 3)

    put_views(*(view_widget(name, resetFocalPoint=lambda name=name: centre(name)) for name in "12"))
    view_fit.look(scene, [0.0, 20.0, 0.0, 40.0, 0.0, 60.0])
    assert centred == ["1", "2"] and camera.GetFocalPoint() == (10, 20, 30)
