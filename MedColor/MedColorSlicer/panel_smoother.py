"""Part of the panel: the values of the chosen smoother, one box each, with the ranges and defaults of the library."""

from __future__ import annotations

import math

import qt

from . import parameters

_LABELS = {
    "lam": "lambda",
    "sigma_s": "sigma space",
    "sigma_r": "sigma range",
    "cell_px": "cell",
    "support_px": "support",
}
_LARGEST = 1e6  # what a box still shows; larger values can be given from the console


class SmootherPart:
    """One page of boxes for each smoother; the page of the present one is shown, greyed while its own values are used.

    What is changed is kept for each smoother by itself, in the parameter node.
    """

    def __init__(self, panel) -> None:
        self.panel, self.ui = panel, panel.ui
        self._updating = False
        self._pages: dict = {}
        self._boxes: dict = {}  # smoother -> list of (option, box)

    def _page(self, smoother: str):
        """The page of a smoother, made the first time."""
        if smoother not in self._pages:
            from MedColorLib.filters import smoother_options

            page = qt.QWidget()
            form = qt.QFormLayout(page)
            form.setContentsMargins(0, 0, 0, 0)
            self._boxes[smoother] = [(option, _box(option)) for option in smoother_options(smoother)]
            for option, box in self._boxes[smoother]:
                box.setObjectName(f"{smoother} {option.name}")
                form.addRow(f"{_LABELS.get(option.name, option.name)}:", box)
                (box.currentIndexChanged if option.choices else box.valueChanged).connect(self._onChanged)
            self.ui.smootherOptionsWidget.layout().addWidget(page)
            self._pages[smoother] = page
        return self._pages[smoother]

    def update(self) -> None:
        """The page in line with the parameter node."""
        p = self.panel.parameters
        smoother = parameters.resolved_smoother(p)
        shown = self._page(smoother)
        for page in self._pages.values():
            page.visible = page is shown
        shown.enabled = not p.smootherAutomatic
        chosen = {} if p.smootherAutomatic else parameters.chosen_options(p)
        self._updating = True
        try:
            for option, box in self._boxes[smoother]:
                _show(option, box, chosen.get(option.name, option.default))
        finally:
            self._updating = False

    def _onChanged(self, _value=None) -> None:
        """The user changed a box."""
        p = self.panel.parameters
        if self._updating or p is None or p.smootherAutomatic:
            return
        before = parameters.chosen_options(p)
        values = {}
        for option, box in self._boxes[parameters.resolved_smoother(p)]:
            value = before.get(option.name, option.default)
            shown = _read(option, box)
            if shown != _in_box(option, value):  # one that the box cannot show stays until the box is touched
                value = shown
            if value != option.default:
                values[option.name] = value
        parameters.store_options(p, values)


def _decimals(option) -> int:
    """Enough for the default and two digits more."""
    return 2 if option.default >= 1 else 2 + math.ceil(-math.log10(option.default))


def _limits(option) -> tuple:
    """(lowest, highest) value that a box offers, within those the smoother takes."""
    if option.whole:
        return option.low, option.high
    smallest = 10.0 ** -_decimals(option)
    low = max(option.low, smallest) if option.low > 0 or option.above_low else option.low
    return float(low), float(min(option.high, _LARGEST))


def _box(option):
    """The control of one option."""
    if option.choices:
        box = qt.QComboBox()
        box.addItems(list(option.choices))
        box.toolTip = f"{option.about} Default: {option.default}."
        return box
    box = qt.QSpinBox() if option.whole else qt.QDoubleSpinBox()
    low, high = _limits(option)
    if not option.whole:
        box.decimals = _decimals(option)
        box.singleStep = 10.0 ** math.floor(math.log10(option.default))
    box.minimum, box.maximum = low, high
    box.value = option.default
    box.keyboardTracking = False  # a number that is being typed is no choice yet
    if option.unit:
        box.suffix = f" {option.unit}"
    box.toolTip = f"{option.about} From {low:g} to {high:g}, default {option.default:g}."
    return box


def _in_box(option, value):
    """What the box shows of a value."""
    if option.choices:
        return value if value in option.choices else option.default
    try:
        number = float(value)
    except (TypeError, ValueError):  # a scene may come from anywhere; the plan says what is wrong
        number = float(option.default)
    low, high = _limits(option)
    number = min(max(number, low), high) if math.isfinite(number) else float(option.default)
    return int(number) if option.whole else round(number, _decimals(option))


def _show(option, box, value) -> None:
    if option.choices:
        box.currentIndex = option.choices.index(_in_box(option, value))
    else:
        box.value = _in_box(option, value)


def _read(option, box):
    if option.choices:
        return option.choices[box.currentIndex]
    return box.value if option.whole else round(box.value, _decimals(option))
