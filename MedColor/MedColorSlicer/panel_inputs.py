"""Part of the panel: volume, reference, recommended pictures, preset, weights."""

from __future__ import annotations

import os

import qt
import slicer
from slicer.i18n import tr as _

from . import dependencies, references, scene


class InputsPart:
    """Shows the rows that the chosen kind of reference needs, and turns them into references."""

    def __init__(self, panel) -> None:
        self.panel, self.ui = panel, panel.ui
        self._recommended: list[str] = []
        self._filling = False
        ui = self.ui
        # two of them, because the browse button of one chooses either files or folders
        ui.referencePathLineEdit.currentPathChanged.connect(self._onPath)
        ui.referenceFolderLineEdit.currentPathChanged.connect(self._onPath)
        ui.recommendButton.clicked.connect(self._onRecommend)
        ui.recommendedList.currentRowChanged.connect(self._onPicked)
        ui.downloadButton.clicked.connect(self._onDownload)

    # --- choices -----------------------------------------------------------------------------------------------------

    def nameChoices(self) -> None:
        """Readable, translatable names in place of the library's words; the order is that of `parameters`."""
        ui = self.ui
        _name(
            ui.referenceSourceComboBox,
            [_("Recommended from a folder"), _("File or folder"), _("Volume in the scene"), _("Built-in sample")],
        )
        _name(ui.presetComboBox, [_("Draft"), _("Balanced"), _("Full")])
        _name(
            ui.featuresComboBox, [_("Automatic"), _("Built in (no download)"), _("VGG-19"), _("VGG-19 for grey images")]
        )
        _name(
            ui.smootherComboBox,
            [
                _("Automatic"),
                _("Regression on luminance"),
                _("Fast global smoother"),
                _("Guided filter"),
                _("Domain transform"),
                _("Weighted least squares"),
            ],
        )
        _name(ui.gammaComboBox, [_("Automatic"), _("On (square root, as in the paper)"), _("Off")])
        _name(ui.luminanceComboBox, [_("Natural"), _("Keep that of the volume"), _("As in the paper")])
        _name(ui.exposureComboBox, [_("Automatic"), _("Off"), _("Gain")])
        _name(ui.bodyComboBox, [_("Find it"), _("All of the picture"), _("Labels in the scene")])
        _name(
            ui.deviceComboBox, [_("Automatic"), _("Processor"), _("NVIDIA graphics (CUDA)"), _("Apple graphics (MPS)")]
        )

    def update(self) -> None:
        """Rows, path and weights in line with the parameter node."""
        p, ui = self.panel.parameters, self.ui
        source = p.referenceSource
        _show(source == "files", ui.referencePathLabel, ui.referencePathLineEdit)
        _show(source == "recommended", ui.referenceFolderLabel, ui.referenceFolderLineEdit)
        _show(source == "node", ui.referenceNodeLabel, ui.referenceSelector)
        _show(source == "recommended", ui.recommendButton, ui.recommendedList)
        for line in (ui.referencePathLineEdit, ui.referenceFolderLineEdit):
            if line.currentPath != p.referencePath:
                line.currentPath = p.referencePath
        ready = not scene.input_problem(p.inputVolume) and os.path.isdir(p.referencePath)
        ui.recommendButton.enabled = ready
        ui.recommendButton.toolTip = (
            _("Find the pictures of the folder that suit this volume best.")
            if ready
            else _("Select a volume and a folder of colour pictures first.")
        )
        self._showWeights(p.features)

    def problem(self) -> str:
        """Why there is no reference, as a sentence; empty if there is one."""
        p = self.panel.parameters
        if p.referenceSource == "node":
            return references.reference_problem(p.referenceNode, p.inputVolume)
        if p.referenceSource == "recommended" and not os.path.isfile(p.pickedReference):
            return _("Choose a folder, press Recommend, and click one of the pictures.")
        if p.referenceSource == "files" and not p.referencePath:
            return _("Choose a colour picture, or a folder of them, as reference.")
        if p.referenceSource == "files" and not os.path.exists(p.referencePath):
            return _("There is no file or folder {path}; choose again.").format(path=p.referencePath)
        return ""

    def references(self) -> list:
        """What `MedColorLogic.process` takes as references."""
        p = self.panel.parameters
        if p.referenceSource == "node":
            return [p.referenceNode]
        if p.referenceSource == "recommended":
            return [p.pickedReference]
        if p.referenceSource == "sample":
            from MedColorLib.phantom import SERIES_LEVELS, section

            return [section(level) for level in SERIES_LEVELS]
        return [p.referencePath]

    def _onPath(self, path) -> None:
        if self.panel.parameters and self.panel.parameters.referencePath != path:
            self.panel.parameters.referencePath = path

    # --- recommended pictures ----------------------------------------------------------------------------------------

    def _onRecommend(self, _checked=False) -> None:
        self.panel.runJob(self._recommend, volume=self.panel.parameters.inputVolume)

    def _recommend(self, job) -> str:
        p = self.panel.parameters
        found = self.panel.logic.recommend(
            p.inputVolume,
            p.referencePath,
            features=p.features,
            device=p.device,
            job=job,
            run=self.panel.runResponsive,
        )
        self.showRecommended(found)
        return _("Click the picture to use.")

    def showRecommended(self, found) -> None:
        """Thumbnails with scores; `found` is a list of (path, score), best first."""
        self._filling = True
        try:
            self.ui.recommendedList.clear()
            self._recommended = [path for path, _score in found]
            for path, score in found:
                text = f"{score:.2f}  {os.path.basename(path)}"
                item = qt.QListWidgetItem(qt.QIcon(path), text)
                item.setToolTip(path)
                self.ui.recommendedList.addItem(item)
            self.ui.recommendedList.currentRow = -1
        finally:
            self._filling = False
        if self.panel.parameters:
            self.panel.parameters.pickedReference = ""

    def _onPicked(self, row) -> None:
        if not self._filling and self.panel.parameters and 0 <= row < len(self._recommended):
            self.panel.parameters.pickedReference = self._recommended[row]

    # --- weights -----------------------------------------------------------------------------------------------------

    def _showWeights(self, features: str) -> None:
        state = _weights_row(features)
        self.ui.downloadButton.enabled = bool(state and not state["present"] and state["url"])
        if features == "embedded":
            text, tip = _("Not needed"), ""
        elif state is None:
            text, tip = _("Known after the packages are installed"), ""
        elif state["present"]:
            text, tip = _("On this computer"), state["path"]
        else:
            text, tip = _("Not on this computer"), state["problem"] or state["note"]
        self.ui.weightsStateLabel.text, self.ui.weightsStateLabel.toolTip = text, tip

    def _onDownload(self, _checked=False) -> None:
        row = _weights_row(self.panel.parameters.features)
        question = _(
            "Download {title}? {megabytes} MB, from {url}, kept in {folder}. Licence: {licence}. Nothing is sent."
        ).format(
            title=row["title"],
            megabytes=round(row["bytes"] / 1e6),
            url=row["url"],
            folder=row["cache_folder"],
            licence=row["licence"],
        )
        if slicer.util.confirmOkCancelDisplay(question):
            self._network = row["network"]
            self.panel.runJob(self._download)

    def _download(self, job) -> str:
        from MedColorLib.features.weights import fetch_weights

        text = _("Downloading")  # looked up here: the worker leaves Slicer alone

        def progress(present: int, expected: int) -> None:
            job.progress(present / expected if expected else 0.0, text)

        network = self._network
        self.panel.runResponsive(lambda: fetch_weights(network, progress, job.cancelled))
        return _("The weights are on this computer now.")


def _weights_row(features: str) -> dict | None:
    """What is known of the weights that `features` would use; None while the packages to tell are missing."""
    if features == "embedded" or dependencies.torch_missing() or dependencies.missing():
        return None
    from MedColorLib.features.weights import weights_status

    network = "vgg19" if features == "auto" else features
    return next(row for row in weights_status() if row["network"] == network)


def _show(visible: bool, *widgets) -> None:
    for widget in widgets:
        widget.visible = visible


def _name(combo_box, names) -> None:
    for index, name in enumerate(names):
        combo_box.setItemText(index, name)
