"""Shows a result in 3-D views: its look (`rendering`), watched over from then on (`rendering_guard`)."""

from __future__ import annotations

import slicer

from . import light, rendering
from .rendering_guard import guard_of


def show(volume_node, view_nodes=None, opacity: float | None = None):
    """Show an RGB volume in 3-D; creates the display the first time, and keeps what the user set after that.

    Args:
        volume_node: vtkMRMLVectorVolumeNode with three uint8 components.
        view_nodes: 3-D view nodes to show it in; None: every view, also those created later.
        opacity: 0..1; None keeps the present one.

    Returns:
        The display node.
    """
    display = rendering.gpu_display_node(volume_node)
    with slicer.util.NodeModify(display):
        if view_nodes is not None:
            display.RemoveAllViewNodeIDs()
            for view in view_nodes:
                display.AddViewNodeID(view.GetID())
        if display.GetAttribute(rendering.OPACITY_ATTRIBUTE) is None or not rendering.has_medcolor_look(display):
            rendering.reset(volume_node, opacity)
        else:
            rendering.restore_unsaved(display)
            if opacity is not None:
                rendering.set_opacity(volume_node, opacity)
        display.SetVisibility(True)
    if light.is_on(volume_node.GetScene()):
        light.apply_to(display)
    guard_of(volume_node.GetScene()).watch(display)
    return display
