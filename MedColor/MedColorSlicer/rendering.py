"""Volume rendering of a result, so that a known colour comes out as itself.

Slicer shows an RGB volume with luminance as alpha. Five things have to be right for it to look right:

* the opacity curve lies on VTK's alpha axis, which is stretched to the luminance range of the volume
  (`MedColorLib.rendering.presets.opacity_points`), and is moved when the voxels change;
* at its border a body fades into the black outside it, as the scan does; what is seen first there would be dark. A shader
  replacement takes the colour of each sample from the visible voxels around it alone, and near air from the tissue up to
  two and a half voxels behind it. The line it replaces is the same in VTK 9.1 to 9.6; where another VTK words it
  differently nothing is replaced, and a dark rim is all that comes back;
* the direction of a surface comes from more than the six voxels around a sample (`MedColorLib.rendering.shaders`), so that
  light does not show the steps of 8-bit voxels;
* components are not independent, and the lighting leaves colours bright enough;
* the curve's opacity is reached over a length that fits the body (unit distance).

The volume property carries a fingerprint: its colour function, which the ray caster ignores for RGB, is a fixed grey
ramp. A preset applied by hand replaces it, and `rendering_guard` then puts MedColor's settings back. Changes made by
hand to curves or lighting leave the fingerprint alone and are kept.
"""

from __future__ import annotations

import json
import zlib

import slicer
import vtk
from slicer.i18n import tr as _

from . import scene

OPACITY_ATTRIBUTE = "MedColor.Opacity"  # on the display node: the slider's value, 0..1
AXIS_ATTRIBUTE = "MedColor.OpacityAxis"  # on the display node: luminance range and unit distance behind the curve
_SHADER_ATTRIBUTE = "MedColor.Shader"  # on the shader property node: which code it holds
DISPLAY_CLASS = "vtkMRMLGPURayCastVolumeRenderingDisplayNode"
_FINGERPRINT = [(0.0, 0.0, 0.0, 0.0), (127.0, 0.5, 0.5, 0.5), (255.0, 1.0, 1.0, 1.0)]

_SHADER_LINE = "g_srcColor = computeColor(scalar, g_srcColor.a);"
_SHADER_CODE = """if (g_srcColor.a > 0.0)
          {
          ivec3 mcSize = textureSize(in_volume[0], 0);
          vec3 mcPosition = g_dataPos * vec3(mcSize) - 0.5;
          ivec3 mcBase = ivec3(floor(mcPosition));
          vec3 mcFraction = mcPosition - vec3(mcBase);
          vec4 mcSum = vec4(0.0);
          vec3 mcSlope = vec3(0.0);
          for (int mcN = 0; mcN < 8; ++mcN)
            {
            ivec3 mcCorner = ivec3(mcN & 1, (mcN >> 1) & 1, mcN >> 2);
            vec3 mcWeight = mix(1.0 - mcFraction, mcFraction, vec3(mcCorner));
            vec4 mcVoxel = texelFetch(in_volume[0], clamp(mcBase + mcCorner, ivec3(0), mcSize - 1), 0)
              * in_volume_scale[0] + in_volume_bias[0];
            mcSum += vec4(mcVoxel.rgb, 1.0) * mcWeight.x * mcWeight.y * mcWeight.z * step(AIR, mcVoxel.a);
            mcSlope += (vec3(mcCorner) * 2.0 - 1.0) * mcVoxel.a;
            }
          if (mcSum.a > 0.0) { scalar.rgb = mcSum.rgb / mcSum.a; }
          if (length(mcSlope) > 0.02)
            {
            vec3 mcStep = normalize(mcSlope) / vec3(mcSize);
            float mcOut = (texture(in_volume[0], g_dataPos - 3.0 * mcStep) * in_volume_scale[0] + in_volume_bias[0]).a;
            vec4 mcBest = scalar;
            for (float mcDepth = 1.0; mcDepth < 2.6; mcDepth += 0.75)
              {
              vec4 mcIn = texture(in_volume[0], g_dataPos + mcDepth * mcStep) * in_volume_scale[0] + in_volume_bias[0];
              if (mcIn.a > mcBest.a) { mcBest = mcIn; }
              }
            scalar.rgb = mix(mcBest.rgb, scalar.rgb, smoothstep(AIR, 3.0 * AIR, mcOut));
            }
          }
        """


def display_node_of(volume_node):
    """The volume rendering display node of a volume, or None."""
    for index in range(volume_node.GetNumberOfDisplayNodes()):
        node = volume_node.GetNthDisplayNode(index)
        if node and node.IsA("vtkMRMLVolumeRenderingDisplayNode"):
            return node
    return None


def hide(volume_node) -> None:
    """Hide the 3-D display of a volume, if it has one; its settings stay."""
    display = display_node_of(volume_node)
    if display:
        display.SetVisibility(False)


def reset(volume_node, opacity: float | None = None) -> None:
    """MedColor's opacity, gradient opacity, lighting and interpolation; opacity None keeps the slider's value."""
    from MedColorLib.rendering import presets

    display = display_node_of(volume_node)
    if display is None:
        return
    if opacity is None:
        opacity = opacity_of(volume_node)
    node = display.GetVolumePropertyNode()
    prop = node.GetVolumeProperty()
    with slicer.util.NodeModify(node):
        prop.SetIndependentComponents(False)
        prop.SetInterpolationTypeToLinear()
        prop.ShadeOn()
        prop.SetAmbient(presets.AMBIENT)
        prop.SetDiffuse(presets.DIFFUSE)
        prop.SetSpecular(presets.SPECULAR)
        prop.SetSpecularPower(presets.SPECULAR_POWER)
        node.SetColor(_color_function(_FINGERPRINT))
        gradient = presets.GRADIENT_OPACITY
        node.SetGradientOpacity(_piecewise([(0.0, gradient), (255.0, gradient)]))
        _set_curve(display, measured_axis(volume_node), opacity)
    _set_shader(display)


def set_opacity(volume_node, opacity: float) -> None:
    """The one opacity slider: 0 (nothing is seen) to 1 (solid)."""
    display = display_node_of(volume_node)
    if display is None:
        return
    with slicer.util.NodeModify(display.GetVolumePropertyNode()):
        _set_curve(display, _stored_axis(display) or measured_axis(volume_node), opacity)


def opacity_of(volume_node) -> float:
    """The slider's value for a volume: what was set, or the default."""
    from MedColorLib.rendering import presets

    display = display_node_of(volume_node)
    text = display.GetAttribute(OPACITY_ATTRIBUTE) if display else None
    return float(text) if text else presets.DEFAULT_OPACITY


def refresh(volume_node) -> None:
    """After the voxels changed: move the opacity curve, the user's own one too, to the new alpha axis."""
    display = display_node_of(volume_node)
    if display is None or display.GetAttribute(OPACITY_ATTRIBUTE) is None:
        return
    if not has_medcolor_look(display):
        reset(volume_node)
        return
    old, new = _stored_axis(display), measured_axis(volume_node)
    node = display.GetVolumePropertyNode()
    if old is None or old["range"][1] == old["range"][0]:  # a single luminance: the curve had no shape to keep
        with slicer.util.NodeModify(node):
            _set_curve(display, new, opacity_of(volume_node))
        return
    points = [(_moved(x, old["range"], new["range"]), y) for x, y in _points_of(node.GetScalarOpacity())]
    with slicer.util.NodeModify(node):
        node.SetScalarOpacity(_piecewise(points))
        _store_axis(display, new)


def has_medcolor_look(display) -> bool:
    """Whether the fingerprint is there and the components are not independent."""
    node = display.GetVolumePropertyNode()
    if node is None:
        return False
    function, values = node.GetColor(), [0.0] * 6
    points = []
    for index in range(function.GetSize()):
        function.GetNodeValue(index, values)
        points.append(tuple(round(value, 3) for value in values[:4]))
    return points == _FINGERPRINT and not node.GetVolumeProperty().GetIndependentComponents()


def view_problem(volume_node) -> str:
    """Why 3-D views cannot show a volume, as a sentence that says what to do; empty if they can."""
    transform = volume_node.GetParentTransformNode() if volume_node else None
    if transform is None or transform.IsTransformToWorldLinear():
        return ""
    return _(
        "3-D views cannot show {name} under the non-linear transform {transform}: harden the transform (module Data, right "
        "click on the volume, Harden transform)."
    ).format(name=volume_node.GetName(), transform=transform.GetName())


def take_cut_of(display, other) -> None:
    """Crop a display as another one is cropped."""
    display.SetAndObserveROINodeID(other.GetROINodeID() if other else None)
    display.SetCroppingEnabled(bool(other and other.GetCroppingEnabled()))


_known_axis: list = [None, None]  # state of the volume that was measured last, and what was found


def measured_axis(volume_node) -> dict:
    """Luminance range (as Slicer computes alpha) and opacity unit distance in millimetres of an RGB volume."""
    state = _state(volume_node)
    if _known_axis[0] != state:
        _known_axis[:] = state, _measured(volume_node)
    return dict(_known_axis[1])


def know_axis(volume_node, axis: dict) -> None:
    """What `axis_of` found in a worker for the voxels of a volume, so that it need not be measured while the window waits."""
    _known_axis[:] = _state(volume_node), axis


def _state(volume_node) -> tuple:
    """What changes whenever the axis of a volume may: its voxels, and their size."""
    return (scene.voxel_state(volume_node), volume_node.GetSpacing())


def axis_of(rgb, spacing_mm) -> dict:
    """`measured_axis` of an array (k, j, i, 3), its spacing along i, j, k: for a worker, which leaves VTK alone."""
    import numpy as np

    low, high, visible = 255, 0, np.zeros((3, max(rgb.shape[:3])), bool)
    for k, plane in enumerate(rgb):
        red, green, blue = (plane[..., n].astype(np.float64) for n in range(3))
        alpha = (0.30 * red + 0.59 * green + 0.11 * blue).astype(np.uint8)  # as vtkImageLuminance, truncation included
        low, high = min(low, int(alpha.min())), max(high, int(alpha.max()))
        seen = alpha > 0
        visible[0, k] = seen.any()
        visible[1, : seen.shape[0]] |= seen.any(axis=1)
        visible[2, : seen.shape[1]] |= seen.any(axis=0)
    return _axis(float(low), float(high), visible, spacing_mm)


def _axis(low: float, high: float, visible, spacing_mm) -> dict:
    """visible: along k, j, i, which planes hold something that is seen."""
    import numpy as np

    from MedColorLib.rendering import presets

    sides = [np.ptp(np.flatnonzero(line)) + 1 if high > 0 else 1 for line in visible]
    diagonal_mm = float(np.linalg.norm(np.array(sides[::-1]) * spacing_mm))
    return {"range": [low, high], "unit_mm": presets.unit_distance_mm(diagonal_mm)}


def _measured(volume_node) -> dict:
    from vtk.util.numpy_support import vtk_to_numpy

    luminance = vtk.vtkImageLuminance()  # the filter Slicer itself uses: the same truncation
    luminance.SetInputData(volume_node.GetImageData())
    luminance.Update()
    low, high = luminance.GetOutput().GetScalarRange()
    i, j, k = volume_node.GetImageData().GetDimensions()
    alpha = vtk_to_numpy(luminance.GetOutput().GetPointData().GetScalars()).reshape(k, j, i)
    visible = alpha > 0
    return _axis(low, high, [visible.any(axis=axes) for axes in ((1, 2), (0, 2), (0, 1))], volume_node.GetSpacing())


def gpu_display_node(volume_node):
    scene = volume_node.GetScene()
    display = display_node_of(volume_node)
    if display is not None and not display.IsA(DISPLAY_CLASS):  # CPU and multi-volume rendering do not show RGB
        scene.RemoveNode(display)
        display = None
    if display is None:
        display = scene.AddNewNodeByClass(DISPLAY_CLASS, f"{volume_node.GetName()} rendering")
        display.SetVisibility(False)
        volume_node.AddAndObserveDisplayNodeID(display.GetID())
    if display.GetVolumePropertyNode() is None:
        node = scene.AddNewNodeByClass("vtkMRMLVolumePropertyNode", f"{volume_node.GetName()} rendering property")
        display.SetAndObserveVolumePropertyNodeID(node.GetID())
    return display


def _set_curve(display, axis: dict, opacity: float) -> None:
    from MedColorLib.rendering import presets

    points = presets.opacity_points(axis["range"][0], axis["range"][1], opacity)
    display.GetVolumePropertyNode().SetScalarOpacity(_piecewise(points))
    display.SetAttribute(OPACITY_ATTRIBUTE, repr(float(opacity)))
    _store_axis(display, axis)


def _store_axis(display, axis: dict) -> None:
    display.SetAttribute(AXIS_ATTRIBUTE, json.dumps(axis))
    display.GetVolumePropertyNode().GetVolumeProperty().SetScalarOpacityUnitDistance(axis["unit_mm"])


def _stored_axis(display) -> dict | None:
    text = display.GetAttribute(AXIS_ATTRIBUTE)
    return json.loads(text) if text else None


def _moved(x: float, old: list, new: list) -> float:
    luminance = (x - old[0]) / (old[1] - old[0]) * 255.0
    return new[0] + luminance / 255.0 * (new[1] - new[0])


def restore_unsaved(display) -> None:
    """What Slicer before 5.10 does not write into scene files."""
    axis, prop = _stored_axis(display), display.GetVolumePropertyNode().GetVolumeProperty()
    if axis and prop.GetScalarOpacityUnitDistance() != axis["unit_mm"]:
        prop.SetScalarOpacityUnitDistance(axis["unit_mm"])
    _set_shader(display)


def _set_shader(display) -> None:
    from MedColorLib.rendering import presets, shaders

    code = _SHADER_CODE.replace("AIR", f"{(presets.ALPHA_AIR + 0.5) / 255.0:.6f}") + _SHADER_LINE
    replacements = [  # (text, before VTK's own, instead)
        (_SHADER_LINE, False, code),
        (shaders.SMOOTH_NORMALS_NEED[0], True, shaders.SMOOTH_NORMALS_NEED[1]),
        (shaders.SMOOTH_NORMALS[0], False, shaders.SMOOTH_NORMALS[1]),
    ]
    mark = str(zlib.crc32(repr(replacements).encode()))
    node = display.GetOrCreateShaderPropertyNode(display.GetScene())
    shader = node.GetShaderProperty()
    if node.GetAttribute(_SHADER_ATTRIBUTE) == mark and shader.GetNumberOfShaderReplacements() == len(replacements):
        return  # a change, even to the same text, would compile the shader anew
    shader.ClearAllFragmentShaderReplacements()
    for text, first, instead in replacements:
        shader.AddFragmentShaderReplacement(text, first, instead, True)
    node.SetAttribute(_SHADER_ATTRIBUTE, mark)
    node.SetName(f"{display.GetName()} shader")


def _piecewise(points):
    function = vtk.vtkPiecewiseFunction()
    for x, y in points:
        function.AddPoint(x, y)
    return function


def _color_function(points):
    function = vtk.vtkColorTransferFunction()
    for point in points:
        function.AddRGBPoint(*point)
    return function


def _points_of(function):
    values = [0.0] * 4
    points = []
    for index in range(function.GetSize()):
        function.GetNodeValue(index, values)
        points.append((values[0], values[1]))
    return points
