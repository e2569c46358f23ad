"""The panel: reload, samples at start-up, the self test, and what outlives a panel."""

from __future__ import annotations

import os
import re
import sys
import types
import unittest

import slicer
import slicer_like
from panel_fixtures import close_panel, open_panel

# --- reload, samples, self test --------------------------------------------------------------------------------------


def test_parameter_node_outlives_panels(ready):
    """Scene close keeps the parameter node; panels that are gone must not be called by it."""
    import gc

    node = ready.parameters.parameterNode
    for _turn in range(3):
        ready.exit()
        gc.collect()
        node.Modified()
        node.SetAttribute("any", "change")
        ready.enter()
    assert ready.parameters.parameterNode is node
    ready.exit()
    gc.collect()
    assert not node.HasObserver("ModifiedEvent") or os.environ.get("MEDCOLOR_SLICER_PYTHON")


def test_reload_reads_the_parts_anew(ready, monkeypatch):
    import qt
    from MedColorSlicer import rendering_guard

    import MedColor

    rendering_guard.guard_of(slicer.mrmlScene)
    reloaded = []
    monkeypatch.setattr(slicer.util, "reloadScriptedModule", reloaded.append)
    kept = {
        name: module for name, module in sys.modules.items() if name.split(".")[0] in ("MedColorLib", "MedColorSlicer")
    }
    try:
        ready.onReload()
        assert reloaded == ["MedColor"]
        assert not [name for name in sys.modules if name.startswith(("MedColorLib", "MedColorSlicer"))]
        assert not rendering_guard._GUARDS
    finally:
        sys.modules.update(kept)
    close_panel(ready)
    again = open_panel(MedColor, qt)
    assert again.parameters.inputVolume is not None


def test_module_registers_sample_data_and_guard_at_startup(qt_host, monkeypatch):
    from MedColorSlicer import rendering_guard

    import MedColor

    logic = slicer_like.SampleDataLogic()
    sample_data = types.ModuleType("SampleData")
    sample_data.__spec__ = types.SimpleNamespace(name="SampleData")
    sample_data.SampleDataLogic = logic
    monkeypatch.setitem(sys.modules, "SampleData", sample_data)
    module = MedColor.MedColor(types.SimpleNamespace())
    assert module.parent.title == "MedColor"
    for slot in slicer.app.connected["startupCompleted()"]:
        slot()
    assert set(logic.sources) == {"MedColorPhantom", "MedColorCTChest", "MedColorCryosection"}
    for name, sample in logic.sources.items():
        assert sample["category"] == "MedColor"
        assert os.path.isfile(sample["thumbnailFileName"])
        if name != "MedColorPhantom":
            assert sample["uris"].startswith("https://")
            assert re.fullmatch("SHA256:[0-9a-f]{64}", sample["checksums"])
    source, chest = logic.sources["MedColorPhantom"], logic.sources["MedColorCTChest"]
    assert chest["uris"].endswith(chest["checksums"].partition(":")[2])
    assert slicer.mrmlScene in rendering_guard._GUARDS
    slicer.mrmlScene.Clear(0)
    slicer.app.emit("aboutToQuit()")
    assert not rendering_guard._GUARDS
    grey, picture = source["customDownloader"](None)
    assert slicer.util.arrayFromVolume(grey).ndim == 3
    assert slicer.util.arrayFromVolume(picture).shape[-1] == 3


def test_self_test_passes_here_too(panel):
    import MedColor

    suite = unittest.defaultTestLoader.loadTestsFromTestCase(MedColor.MedColorTest)
    with open(os.devnull, "w", encoding="utf-8") as silence:
        result = unittest.TextTestRunner(stream=silence).run(suite)
    assert not result.errors + result.failures, (result.errors + result.failures)[0][1]
    assert {test.id().rpartition(".")[2] for test, _reason in result.skipped} <= {
        "test_known_colors_in_the_3d_view", "test_comparison_layout", "test_samples_are_offered",
        "test_cut_follows_the_red_slice", "test_panel_live_preview_follows_the_slices",
        "test_scene_file_brings_the_same_picture", "test_sequence_is_colored_and_played",
        "test_segmentation_guards_the_tissues",
    }  # fmt: skip
