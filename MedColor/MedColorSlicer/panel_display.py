"""Part of the panel: 3-D display with one opacity slider, and the comparison with grey."""

from __future__ import annotations

import slicer
from slicer.i18n import tr as _

from . import rendering


class DisplayPart:
    """Acts on the volume chosen as output; its controls say what is missing while there is none."""

    def __init__(self, panel) -> None:
        self.panel, self.ui = panel, panel.ui
        self._updating = False
        self._comparing = False
        ui = self.ui
        ui.show3DCheckBox.toggled.connect(self._onShow)
        ui.compareCheckBox.toggled.connect(self._onCompare)
        ui.resetRenderingButton.clicked.connect(self._onReset)
        ui.opacitySlider.valueChanged.connect(self._onOpacity)
        ui.fadeSlider.valueChanged.connect(self._onFade)

    def update(self) -> None:
        """Controls in line with the scene."""
        node = self._node()
        display = rendering.display_node_of(node) if node else None
        shown = bool(display and display.GetVisibility())
        ui = self.ui
        self._updating = True
        try:
            ui.show3DCheckBox.checked = shown
            ui.compareCheckBox.checked = self._comparing and node is not None
        finally:
            self._updating = False
        without = _("Colour a volume first, or select a coloured volume as output.")
        for widget, tip in (
            (ui.show3DCheckBox, _("Volume rendering of the coloured volume.")),
            (ui.compareCheckBox, _("Two linked 3-D views, and slice views with colour over grey.")),
        ):
            widget.enabled = node is not None
            widget.toolTip = tip if node else without
        ui.opacitySlider.enabled = ui.resetRenderingButton.enabled = shown
        ui.fadeSlider.enabled = node is not None

    def _node(self):
        p = self.panel.parameters
        node = p.outputVolume if p else None
        if node is None or node.GetImageData() is None or node.GetImageData().GetNumberOfScalarComponents() != 3:
            return None
        return node

    def _onShow(self, checked) -> None:
        node = self._node()
        if self._updating or node is None:
            return
        if checked:
            self._say_if_no_view()
            display = rendering.display_node_of(node)
            first = display is None or display.GetAttribute(rendering.OPACITY_ATTRIBUTE) is None
            self.panel.logic.showVolumeRendering(node, opacity=self.panel.parameters.opacity if first else None)
            self.panel.parameters.opacity = rendering.opacity_of(node)
            if first and slicer.app.layoutManager():
                slicer.util.resetThreeDViews()
        else:
            self.panel.logic.hideVolumeRendering(node)
        self.update()

    def _say_if_no_view(self) -> None:
        manager = slicer.app.layoutManager()
        if manager is None or manager.threeDViewCount == 0:
            self.panel.say(_("There is no 3-D view; choose a layout that has one."))

    def _onOpacity(self, value) -> None:
        node = self._node()
        if node is not None and self.panel.parameters and rendering.display_node_of(node):
            self.panel.logic.setOpacity(node, value)

    def _onFade(self, value) -> None:
        if self._node() is not None:
            self.panel.logic.setFade(value)

    def _onReset(self, _checked=False) -> None:
        node = self._node()
        if node is not None:
            self.panel.logic.resetVolumeRendering(node)

    def _onCompare(self, checked) -> None:
        node, p = self._node(), self.panel.parameters
        if self._updating or node is None:
            return
        grey = p.inputVolume
        self._comparing = bool(checked) and grey is not None
        if self._comparing:
            if self.panel.logic.showComparison(grey, node, p.fade) is None:
                self.panel.say(_("There are no two 3-D views; only the slice views compare."))
        else:
            self.panel.logic.hideComparison(grey, node)
        self.update()
