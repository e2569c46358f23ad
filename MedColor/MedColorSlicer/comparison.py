"""Grey and colour side by side: two linked 3-D views, and slice views that fade from grey to colour."""

from __future__ import annotations

import json

import slicer

from . import light, rendering, rendering_show, three_d_views
from . import scene as nodes

_GREY_ATTRIBUTE = "MedColor.Grey"  # on the grey copy: MedColor made it, and removes it again
_LAYOUT_ATTRIBUTE = "MedColor.EarlierLayout"  # on the layout node, while the comparison is shown


def show(grey_node, color_node, fade: float = 1.0):
    """See `MedColorLogic.showComparison`."""
    scene = color_node.GetScene()
    overlay(scene, grey_node, color_node, fade)
    layout = _layout(scene)
    if layout and layout.GetViewArrangement() != layout.SlicerLayoutDual3DView:
        layout.SetAttribute(_LAYOUT_ATTRIBUTE, str(layout.GetViewArrangement()))
        layout.SetViewArrangement(layout.SlicerLayoutDual3DView)
    views = [scene.GetSingletonNode(name, "vtkMRMLViewNode") for name in ("1", "2")]
    if None in views:
        rendering_show.show(color_node)
        return None
    color_view, grey_view = views
    light.spread(scene)  # the layout may have made the second view just now
    rendering_show.show(color_node, [color_view])
    _show_grey(grey_node, grey_view, color_node)
    _link_cameras(scene, color_view, grey_view)
    three_d_views.render_again()
    return color_view, grey_view


def hide(grey_node, color_node, restore_layout: bool = True) -> None:
    """See `MedColorLogic.hideComparison`; without `restore_layout` the views stay as the user arranged them."""
    scene = (color_node or grey_node).GetScene()
    layout = _layout(scene)
    earlier = layout.GetAttribute(_LAYOUT_ATTRIBUTE) if layout else None
    if earlier:
        layout.RemoveAttribute(_LAYOUT_ATTRIBUTE)
        if restore_layout:
            layout.SetViewArrangement(int(earlier))
    for copy in _grey_copies(scene):
        _remove_copy(copy)
    if color_node is not None and rendering.display_node_of(color_node):
        rendering.display_node_of(color_node).RemoveAllViewNodeIDs()
    three_d_views.render_again()


def is_laid_out(scene) -> bool:
    """Whether the views are still arranged for the comparison; True where there are no views."""
    layout = _layout(scene)
    return layout is None or layout.GetViewArrangement() == layout.SlicerLayoutDual3DView


def _layout(scene):
    return scene.GetFirstNodeByClass("vtkMRMLLayoutNode")


def overlay(scene, grey_node, color_node, fade: float) -> None:
    """Colour over grey in every slice view."""
    for composite in composites(scene):
        composite.SetBackgroundVolumeID(grey_node.GetID() if grey_node else None)
        composite.SetForegroundVolumeID(color_node.GetID() if color_node else None)
    set_fade(scene, fade)


def set_fade(scene, fade: float) -> None:
    """Opacity 0..1 of what lies in front in every slice view."""
    for composite in composites(scene):
        composite.SetForegroundOpacity(min(max(float(fade), 0.0), 1.0))


def composites(scene) -> list:
    """What says for each slice view which volumes it shows."""
    name = "vtkMRMLSliceCompositeNode"
    return [scene.GetNthNodeByClass(n, name) for n in range(scene.GetNumberOfNodesByClass(name))]


def _show_grey(grey_node, view, color_node) -> None:
    """A rendering of the grey volume that the user made, as it is; else its body in the look of the colours.

    The copy is grey as R = G = B where there is colour, so that headrest and table stay away, and both halves have one
    curve, one light and one brightness.
    """
    display = rendering.display_node_of(grey_node)
    if display is not None:
        display.RemoveAllViewNodeIDs()
        display.AddViewNodeID(view.GetID())
        display.SetVisibility(True)
        return
    scene = color_node.GetScene()
    for copy in _grey_copies(scene):
        _remove_copy(copy)
    copy = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", f"{grey_node.GetName()} grey")
    copy.SetHideFromEditors(True)
    copy.SetAttribute(_GREY_ATTRIBUTE, "1")
    slicer.util.updateVolumeFromArray(copy, _grey_body(grey_node, color_node))
    copy.CopyOrientation(color_node)
    copy.SetVoxelVectorType(copy.VoxelVectorTypeColorRGB)
    copy.SetAndObserveTransformNodeID(color_node.GetTransformNodeID())
    display = rendering_show.show(copy, [view], rendering.opacity_of(color_node))
    rendering.take_cut_of(display, rendering.display_node_of(color_node))
    for node in (copy, display, display.GetVolumePropertyNode(), display.GetShaderPropertyNode()):
        node.SetSaveWithScene(False)


def set_opacity(color_node, opacity: float) -> None:
    """The grey half follows the slider of the coloured one."""
    for copy in _grey_copies(color_node.GetScene()):
        rendering.set_opacity(copy, opacity)


def _grey_body(grey_node, color_node):
    """(k, j, i, 3) uint8: the grey volume in the window it was coloured with, black where there is no colour."""
    from MedColorLib.errors import InputError
    from MedColorLib.rendering import grey_color_volume
    from MedColorLib.rendering.grid import not_black
    from MedColorLib.volume import Volume

    voxels, body = slicer.util.arrayFromVolume(grey_node), not_black(slicer.util.arrayFromVolume(color_node))
    settings = json.loads(color_node.GetAttribute(nodes.SETTINGS_ATTRIBUTE) or "{}")
    window = settings.get("window")
    try:
        rgb = grey_color_volume(Volume(voxels), tuple(window) if window else None, body).rgb
    except InputError:  # one value in the whole body: any window shows as much
        rgb = grey_color_volume(Volume(voxels), (float(voxels.min()), float(voxels.max()) + 1.0)).rgb
    rgb[~body] = 0
    return rgb


def _grey_copies(scene) -> list:
    found = [scene.GetNthNodeByClass(n, "vtkMRMLVectorVolumeNode")
             for n in range(scene.GetNumberOfNodesByClass("vtkMRMLVectorVolumeNode"))]  # fmt: skip
    return [node for node in found if node.GetAttribute(_GREY_ATTRIBUTE)]


def _remove_copy(copy) -> None:
    scene, display = copy.GetScene(), rendering.display_node_of(copy)
    if display is not None:
        for node in (display.GetVolumePropertyNode(), display.GetShaderPropertyNode()):
            if node is not None:
                scene.RemoveNode(node)
    nodes.remove(copy)


def _link_cameras(scene, color_view, grey_view) -> None:
    cameras = {}
    for n in range(scene.GetNumberOfNodesByClass("vtkMRMLCameraNode")):
        camera = scene.GetNthNodeByClass(n, "vtkMRMLCameraNode")
        cameras[camera.GetLayoutName()] = camera
    source, target = (cameras.get(view.GetLayoutName()) for view in (color_view, grey_view))
    if source and target:
        target.SetPosition(source.GetPosition())
        target.SetFocalPoint(source.GetFocalPoint())
        target.SetViewUp(source.GetViewUp())
        target.SetParallelProjection(source.GetParallelProjection())
        target.SetParallelScale(source.GetParallelScale())
        target.ResetClippingRange()  # it belongs to the place the camera had before: nothing would be seen
    for view in (color_view, grey_view):
        view.SetLinkedControl(True)
