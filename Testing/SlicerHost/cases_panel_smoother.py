"""The panel's boxes for the values of each smoother, over real MRML."""

from __future__ import annotations

import json

import pytest
from panel_fixtures import shown


def boxes_of(panel, smoother):
    """Option name -> box on the page of a smoother."""
    return {option.name: box for option, box in panel.smoother._boxes[smoother]}


def other_value(box):
    """A value that the box does not have now."""
    if type(box).__name__ == "QComboBox":
        return (box.currentIndex + 1) % box.count
    return box.value + box.singleStep


def set_box(box, value):
    setattr(box, "currentIndex" if type(box).__name__ == "QComboBox" else "value", value)


@pytest.mark.parametrize("smoother", ["regression", "fgs", "guided", "domain-transform", "wls"])
def test_values_of_the_smoother_are_bound_both_ways(ready, library, smoother):
    from MedColorSlicer import parameters, scene

    from MedColorLib.filters import smoother_options

    p = ready.parameters
    p.smoother = smoother
    boxes = boxes_of(ready, smoother)
    page = ready.smoother._pages[smoother]
    defaults = {option.name: option.default for option in smoother_options(smoother)}
    assert set(boxes) == set(defaults)
    assert [name for name, other in ready.smoother._pages.items() if shown(other)] == [smoother]
    assert not page.enabled
    assert all(box.toolTip.startswith(tuple("ABCDEFGHIJKLMNOPQRSTUVWXYZ")) for box in boxes.values())
    p.smootherAutomatic = False
    assert page.enabled
    assert parameters.settings_from(p).smoother_options is None
    chosen = {}
    for option in smoother_options(smoother):
        box = boxes[option.name]
        set_box(box, other_value(box))
        chosen = parameters.settings_from(p).smoother_options
        assert option.name in chosen and chosen[option.name] != option.default
    assert set(chosen) == set(defaults)
    p.smootherOptions = ""
    for option in smoother_options(smoother):
        box = boxes[option.name]
        assert (box.currentText if option.choices else box.value) == option.default
    parameters.store_options(p, chosen)
    ready.ui.applyButton.click()
    assert library.calls[-1][2].smoother_options == chosen
    saved = p.outputVolume.GetAttribute(scene.SETTINGS_ATTRIBUTE)
    assert json.loads(saved)["smoother_options"] == chosen


def test_each_smoother_keeps_its_values_and_automatic_leaves_them(ready):
    from MedColorSlicer import parameters

    p = ready.parameters
    p.smootherAutomatic = False
    p.smoother = "fgs"
    boxes_of(ready, "fgs")["lam"].value = 4.0
    p.smoother = "guided"
    boxes_of(ready, "guided")["radius"].value = 5
    assert parameters.settings_from(p).smoother_options == {"radius": 5}
    p.smoother = "auto"
    p.preset = "full"
    assert parameters.settings_from(p).smoother_options == {"lam": 4.0}
    ready.ui.smootherAutomaticCheckBox.click()
    assert parameters.settings_from(p).smoother_options is None
    assert boxes_of(ready, "fgs")["lam"].value == 32.0
    ready.ui.smootherAutomaticCheckBox.click()
    assert boxes_of(ready, "fgs")["lam"].value == 4.0
    ready.exit()
    ready.enter()
    assert parameters.settings_from(ready.parameters).smoother_options == {"lam": 4.0}


def test_values_from_elsewhere(ready):
    """Larger than a box shows they stay until that box is touched; nonsense is said by the plan, or counts as nothing."""
    from MedColorSlicer import parameters

    p = ready.parameters
    p.smoother, p.smootherAutomatic = "fgs", False
    parameters.store_options(p, {"lam": 1e9})
    boxes = boxes_of(ready, "fgs")
    assert boxes["lam"].value == 1e6
    boxes["iterations"].value = 2
    assert parameters.settings_from(p).smoother_options == {"lam": 1e9, "iterations": 2}
    boxes["lam"].value = 7.0
    assert parameters.settings_from(p).smoother_options == {"lam": 7.0, "iterations": 2}
    for text in ("no JSON", "[1]", '{"fgs": 3}'):
        p.smootherOptions = text
        assert parameters.settings_from(p).smoother_options is None
    parameters.store_options(p, {"lam": "much"})
    ready.plan.ask()
    assert "lam: expected a number" in ready.ui.planText.plainText
    ready.ui.applyButton.click()
    assert "lam: expected a number" in ready.ui.statusLabel.text


def test_preview_drops_the_values_of_a_smoother_it_does_not_use(ready, library):
    p = ready.parameters
    p.preset, p.smootherAutomatic = "full", False
    boxes_of(ready, "fgs")["lam"].value = 4.0
    ready.ui.previewButton.click()
    assert "Preview" in ready.ui.statusLabel.text
    assert library.calls[-1][2].smoother_options is None
    p.smoother = "fgs"
    ready.ui.previewButton.click()
    assert library.calls[-1][2].smoother_options == {"lam": 4.0}
