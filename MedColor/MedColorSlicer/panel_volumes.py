"""Part of the panel: which volumes Apply colours: the chosen one, marked others, every time point of a sequence."""

from __future__ import annotations

import qt
import slicer

from . import scene, sequences

_ROLE = (
    "otherVolumes"  # node references of the parameter node: it keeps lists of nodes only so in all versions of Slicer
)


class VolumesPart:
    """The list of other volumes with its marks, kept with the scene, and the box "All time points"."""

    def __init__(self, panel) -> None:
        self.panel, self.ui = panel, panel.ui
        self._listed: list = []
        self._filling = False
        self.ui.otherVolumesList.itemChanged.connect(self._onMarked)

    def update(self) -> None:
        """List and box in line with the scene."""
        p, ui = self.panel.parameters, self.ui
        others, marked = self.others(), self.marked()
        ui.otherVolumesLabel.visible = ui.otherVolumesList.visible = bool(others)
        ui.allTimePointsCheckBox.visible = sequences.sequence_of(p.inputVolume) is not None
        shown = [(node.GetID(), node.GetName(), node in marked) for node in others]
        if shown == self._listed:
            return
        self._listed, self._filling = shown, True
        try:
            ui.otherVolumesList.clear()
            for _node_id, name, mark in shown:
                item = qt.QListWidgetItem(name)
                item.setCheckState(qt.Qt.Checked if mark else qt.Qt.Unchecked)
                ui.otherVolumesList.addItem(item)
        finally:
            self._filling = False

    def marked(self) -> list:
        """The other volumes that are to be coloured, too."""
        node = self.panel.parameters.parameterNode
        found = [node.GetNthNodeReference(_ROLE, n) for n in range(node.GetNumberOfNodeReferences(_ROLE))]
        return [volume for volume in found if volume is not None and volume is not self.panel.parameters.inputVolume]

    def chosen(self) -> list:
        """All that Apply colours, the chosen volume first."""
        return [self.panel.parameters.inputVolume, *self.marked()]

    def count(self) -> int:
        """How many volumes, or time points of them, Apply colours."""
        sequences_of_them = [self.sequence_of(volume) for volume in self.chosen()]
        return sum(sequence.GetNumberOfDataNodes() if sequence else 1 for sequence in sequences_of_them)

    def sequence_of(self, volume):
        """The sequence to be coloured in place of a volume; None for the volume alone."""
        return sequences.sequence_of(volume) if self.panel.parameters.allTimePoints else None

    def others(self) -> list:
        """The other volumes of the scene that can be coloured."""
        volumes = slicer.util.getNodesByClass("vtkMRMLScalarVolumeNode")
        return [
            node
            for node in volumes
            if node is not self.panel.parameters.inputVolume
            and not scene.input_problem(node)
            and not scene.is_confidence(node)
            and not node.GetHideFromEditors()
        ]

    def _onMarked(self, item) -> None:
        """The user changed a mark."""
        p = self.panel.parameters
        if self._filling or p is None:
            return
        row = self.ui.otherVolumesList.row(item)
        node_id, name, _mark = self._listed[row]
        checked = item.checkState() == qt.Qt.Checked
        ids = [node.GetID() for node in self.marked() if node.GetID() != node_id]
        self._listed[row] = (node_id, name, checked)
        node = p.parameterNode
        node.RemoveNodeReferenceIDs(_ROLE)
        for chosen in [*ids, node_id] if checked else ids:
            node.AddNodeReferenceID(_ROLE, chosen)
