"""Part of the panel: 3-D display with one opacity slider, cuts and views, and the comparison with grey."""

from __future__ import annotations

import slicer
from slicer.i18n import tr as _

from . import comparison, cut, light, rendering, three_d_views, view_fit


class DisplayPart:
    """Acts on the volume chosen as output; its controls say what is missing while there is none."""

    def __init__(self, panel) -> None:
        self.panel, self.ui = panel, panel.ui
        self._updating = False
        self._compared = None  # (grey, colour) nodes while they are compared
        self._follower = cut.SliceFollower(slicer.mrmlScene)
        ui = self.ui
        for name in (_("Nothing"), _("Beyond the red slice"), _("Outside a box")):
            ui.cutComboBox.addItem(name)
        ui.show3DCheckBox.toggled.connect(self._onShow)
        ui.compareCheckBox.toggled.connect(self._onCompare)
        ui.lightCheckBox.toggled.connect(self._onLight)
        ui.resetRenderingButton.clicked.connect(self._onReset)
        ui.opacitySlider.valueChanged.connect(self._onOpacity)
        ui.fadeSlider.valueChanged.connect(self._onFade)
        ui.cutComboBox.currentIndexChanged.connect(self._onCut)
        ui.frontViewButton.clicked.connect(lambda *_: self._onView("front"))
        ui.halfViewButton.clicked.connect(lambda *_: self._onView("half"))
        ui.openViewButton.clicked.connect(lambda *_: self._onView("open"))

    # --- in line with the scene --------------------------------------------------------------------------------------

    def update(self) -> None:
        """Controls in line with the scene."""
        node, p = self._node(), self.panel.parameters
        display = rendering.display_node_of(node) if node else None
        shown = bool(display and display.GetVisibility())
        ui = self.ui
        self._updating = True
        try:
            ui.show3DCheckBox.checked = shown if node else bool(p and p.show3D)
            ui.compareCheckBox.checked = self._compared is not None and node is not None
            ui.cutComboBox.currentIndex = cut.CUTS.index(cut.cut_of(node))
            ui.lightCheckBox.checked = light.is_on(slicer.mrmlScene)
        finally:
            self._updating = False
        without = _("Colour a volume first, or select a coloured volume as output.")
        for widget, tip in (
            (ui.compareCheckBox, _("Two linked 3-D views, grey beside colour.")),
            (ui.fadeSlider, _("How much colour covers grey in the slice views; 1 is colour alone.")),
        ):
            previewed = widget is ui.fadeSlider and (self.panel.preview.shown or self.panel.live.on)
            widget.enabled = node is not None or previewed
            widget.toolTip = tip if widget.enabled else without
        for widget in (
            ui.opacitySlider, ui.resetRenderingButton, ui.cutComboBox, ui.frontViewButton, ui.halfViewButton,
            ui.openViewButton, ui.lightCheckBox,
        ):  # fmt: skip
            widget.enabled = shown
        self._follower.update()

    def onSceneChanged(self) -> None:
        """Nodes came, went or changed; the views may have been arranged anew."""
        light.spread(slicer.mrmlScene)
        if self._compared is None:
            return
        grey, color = (node if _present(node) else None for node in self._compared)
        if grey is None or color is None or not comparison.is_laid_out(slicer.mrmlScene):
            self._compared = None
            if grey or color:
                comparison.hide(grey, color, restore_layout=comparison.is_laid_out(slicer.mrmlScene))

    def forget(self) -> None:
        """The scene is closed or exchanged."""
        self._compared = None

    def note(self) -> str:
        """What has to be said of the 3-D view as long as it is so."""
        node = self._node()
        display = rendering.display_node_of(node) if node else None
        return rendering.view_problem(node) if display and display.GetVisibility() else ""

    def watched(self) -> list:
        """Nodes besides those of the inputs whose changes matter here."""
        node = self._node()
        return [
            slicer.mrmlScene.GetFirstNodeByClass("vtkMRMLLayoutNode"),
            rendering.display_node_of(node) if node else None,
        ]

    def _node(self):
        p = self.panel.parameters
        node = p.outputVolume if p else None
        if node is None or node.GetImageData() is None or node.GetImageData().GetNumberOfScalarComponents() != 3:
            return None
        return node

    # --- a result came -----------------------------------------------------------------------------------------------

    def showResult(self, parameters, grey, node, here: bool) -> None:
        """Colour at full strength over the slices, and in 3-D unless that was switched off; fitted the first time.

        Args:
            here: False when the user went to another module meanwhile: the panel is not touched.
        """
        first = rendering.display_node_of(node) is None
        if here:
            parameters.outputVolume = node
            parameters.fade = 1.0
        comparison.overlay(slicer.mrmlScene, grey, node, 1.0)
        if first and parameters.show3D:
            self._show(node, parameters)
        elif first:
            self._fit(node, slices_only=True)
        if self._compared and self._compared[1] is node:
            comparison.show(grey, node, parameters.fade)

    def _show(self, node, parameters) -> None:
        """For the first time in 3-D."""
        self.panel.logic.showVolumeRendering(node, opacity=parameters.opacity)
        light.first_time(slicer.mrmlScene)
        self._fit(node)

    def _fit(self, node, slices_only: bool = False) -> None:
        bounds = view_fit.body_bounds(node)
        if bounds is not None:
            view_fit.fit_slices(slicer.mrmlScene, bounds)
            if not slices_only:
                view_fit.look(slicer.mrmlScene, bounds)

    # --- controls ----------------------------------------------------------------------------------------------------

    def _onShow(self, checked) -> None:
        node, p = self._node(), self.panel.parameters
        if self._updating or p is None:
            return
        p.show3D = bool(checked)
        if node is None:
            return
        if not checked:
            self.panel.logic.hideVolumeRendering(node)
        elif rendering.display_node_of(node) is None:
            self._show(node, p)
        else:
            self.panel.logic.showVolumeRendering(node)
            p.opacity = rendering.opacity_of(node)
        if checked:
            self.panel.say(self._without_view())
        self.panel.update()

    @staticmethod
    def _without_view() -> str:
        if not three_d_views.shown_views():
            return _("There is no 3-D view; choose a layout that has one.")
        return ""

    def _onOpacity(self, value) -> None:
        node = self._node()
        if node is not None and self.panel.parameters and rendering.display_node_of(node):
            self.panel.logic.setOpacity(node, value)

    def _onFade(self, value) -> None:
        if self._node() is not None or self.panel.preview.shown or self.panel.live.on:
            self.panel.logic.setFade(value)

    def _onLight(self, checked) -> None:
        if not self._updating:
            self.panel.logic.setLight(bool(checked))

    def _onCut(self, index) -> None:
        node = self._node()
        if not self._updating and node is not None and index >= 0:
            cut.set_cut(node, cut.CUTS[index])

    def _onView(self, name: str) -> None:
        node, p = self._node(), self.panel.parameters
        if node is not None and p is not None:
            cut.show_view(node, name)
            p.opacity = rendering.opacity_of(node)
            self.update()

    def _onReset(self, _checked=False) -> None:
        node = self._node()
        if node is not None:
            self.panel.logic.resetVolumeRendering(node)
            self.update()

    def _onCompare(self, checked) -> None:
        node, p = self._node(), self.panel.parameters
        if self._updating or node is None:
            return
        grey = p.inputVolume
        if checked and grey is not None and _same_grid(grey, node):
            self._compared = (grey, node)
            if self.panel.logic.showComparison(grey, node, p.fade) is None:
                self.panel.say(_("There are no two 3-D views; only the slice views compare."))
        elif checked:
            self.panel.say(_("The selected volume is not the one that was coloured; select that to compare."))
        else:
            self._compared = None
            self.panel.logic.hideComparison(grey, node)
        self.update()


def _present(node) -> bool:
    return node is not None and node.GetScene() is not None and bool(node.GetScene().IsNodePresent(node))


def _same_grid(grey, color) -> bool:
    image = grey.GetImageData()
    return image is not None and image.GetDimensions() == color.GetImageData().GetDimensions()
