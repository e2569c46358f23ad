"""Grey and colour side by side: two linked 3-D views, and slice views that fade from grey to colour."""

from __future__ import annotations

import slicer
import vtk

from . import rendering, rendering_show

_GREY_ATTRIBUTE = "MedColor.Grey"  # on the grey display node: MedColor made it and may set its curves
_LAYOUT_ATTRIBUTE = "MedColor.EarlierLayout"  # on the layout node, while the comparison is shown


def show(grey_node, color_node, fade: float = 0.5):
    """See `MedColorLogic.showComparison`."""
    scene = color_node.GetScene()
    overlay(scene, grey_node, color_node, fade)
    layout = scene.GetFirstNodeByClass("vtkMRMLLayoutNode")
    if layout and layout.GetViewArrangement() != layout.SlicerLayoutDual3DView:
        layout.SetAttribute(_LAYOUT_ATTRIBUTE, str(layout.GetViewArrangement()))
        layout.SetViewArrangement(layout.SlicerLayoutDual3DView)
    views = [scene.GetSingletonNode(name, "vtkMRMLViewNode") for name in ("1", "2")]
    if None in views:
        rendering_show.show(color_node)
        return None
    color_view, grey_view = views
    rendering_show.show(color_node, [color_view])
    _show_grey(grey_node, grey_view, color_node)
    _link_cameras(scene, color_view, grey_view)
    return color_view, grey_view


def hide(grey_node, color_node) -> None:
    """See `MedColorLogic.hideComparison`."""
    scene = color_node.GetScene()
    layout = scene.GetFirstNodeByClass("vtkMRMLLayoutNode")
    earlier = layout.GetAttribute(_LAYOUT_ATTRIBUTE) if layout else None
    if earlier:
        layout.RemoveAttribute(_LAYOUT_ATTRIBUTE)
        layout.SetViewArrangement(int(earlier))
    display = rendering.display_node_of(grey_node) if grey_node else None
    if display and display.GetAttribute(_GREY_ATTRIBUTE):
        display.SetVisibility(False)
    display = rendering.display_node_of(color_node)
    if display:
        display.RemoveAllViewNodeIDs()


def overlay(scene, grey_node, color_node, fade: float) -> None:
    """Colour over grey in every slice view."""
    for composite in _composites(scene):
        composite.SetBackgroundVolumeID(grey_node.GetID() if grey_node else None)
        composite.SetForegroundVolumeID(color_node.GetID() if color_node else None)
    set_fade(scene, fade)


def set_fade(scene, fade: float) -> None:
    """Opacity 0..1 of what lies in front in every slice view."""
    for composite in _composites(scene):
        composite.SetForegroundOpacity(min(max(float(fade), 0.0), 1.0))


def _composites(scene) -> list:
    name = "vtkMRMLSliceCompositeNode"
    return [scene.GetNthNodeByClass(n, name) for n in range(scene.GetNumberOfNodesByClass(name))]


def _show_grey(grey_node, view, color_node) -> None:
    """The grey volume by the same curve of luminance; a rendering the user made is shown as it is."""
    scene = grey_node.GetScene()
    display = rendering.display_node_of(grey_node)
    if display is None:
        display = scene.AddNewNodeByClass("vtkMRMLGPURayCastVolumeRenderingDisplayNode", f"{grey_node.GetName()} grey")
        node = scene.AddNewNodeByClass("vtkMRMLVolumePropertyNode", f"{grey_node.GetName()} grey property")
        display.SetAndObserveVolumePropertyNodeID(node.GetID())
        display.SetAttribute(_GREY_ATTRIBUTE, "1")
        display.SetVisibility(False)
        grey_node.AddAndObserveDisplayNodeID(display.GetID())
    if display.GetAttribute(_GREY_ATTRIBUTE):
        _set_grey_property(display.GetVolumePropertyNode(), grey_node, color_node)
    display.RemoveAllViewNodeIDs()
    display.AddViewNodeID(view.GetID())
    display.SetVisibility(True)


def _set_grey_property(node, grey_node, color_node) -> None:
    from MedColorLib.rendering import presets

    low, high = _window(grey_node)
    opacity_function, colors = vtk.vtkPiecewiseFunction(), vtk.vtkColorTransferFunction()
    for alpha, value in presets.opacity_curve(rendering.opacity_of(color_node)):
        opacity_function.AddPoint(low + alpha / 255.0 * (high - low), value)
    colors.AddRGBPoint(low, 0.0, 0.0, 0.0)
    colors.AddRGBPoint(high, 1.0, 1.0, 1.0)
    prop = node.GetVolumeProperty()
    color_property = rendering.display_node_of(color_node).GetVolumePropertyNode().GetVolumeProperty()
    with slicer.util.NodeModify(node):
        prop.SetInterpolationTypeToLinear()
        prop.ShadeOn()
        prop.SetAmbient(presets.AMBIENT)
        prop.SetDiffuse(presets.DIFFUSE)
        prop.SetSpecular(presets.SPECULAR)
        prop.SetSpecularPower(presets.SPECULAR_POWER)
        prop.SetScalarOpacityUnitDistance(color_property.GetScalarOpacityUnitDistance())
        node.SetScalarOpacity(opacity_function)
        node.SetColor(colors)
        gradient = vtk.vtkPiecewiseFunction()
        gradient.AddPoint(0.0, presets.GRADIENT_OPACITY)
        gradient.AddPoint(255.0, presets.GRADIENT_OPACITY)
        node.SetGradientOpacity(gradient)


def _window(grey_node) -> tuple[float, float]:
    """(black, white) of the slice views; the whole range where there is no such thing."""
    display = grey_node.GetVolumeDisplayNode()
    if display is not None and display.IsA("vtkMRMLScalarVolumeDisplayNode") and display.GetWindow() > 0:
        return display.GetLevel() - display.GetWindow() / 2, display.GetLevel() + display.GetWindow() / 2
    low, high = grey_node.GetImageData().GetScalarRange()
    return low, max(high, low + 1.0)


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
    for view in (color_view, grey_view):
        view.SetLinkedControl(True)
