"""Runs MedColorTest inside Slicer and ends Slicer with status 0 or 1:

    Slicer --no-splash --testing --no-main-window --additional-module-paths MedColor \
        --python-script Testing/Slicer/run_in_slicer.py

Without --no-main-window (under a virtual display if need be) the 3-D view is looked at too. With MEDCOLOR_SCREENSHOTS
naming a folder, pictures of the window and of the panel are written there. Every test that was skipped is listed at the
end with its reason; with MEDCOLOR_SKIP_NOTHING=1 a skipped test counts as a failure.
"""

import os
import traceback
import unittest

import slicer


def take_screenshots(folder):
    """The panel and the window with the phantom in the scene."""
    from MedColorSlicer import samples

    slicer.mrmlScene.Clear(0)
    slicer.util.selectModule("MedColor")
    samples.load_phantom()
    slicer.modules.medcolor.widgetRepresentation().self().enter()
    slicer.app.processEvents()
    slicer.modules.medcolor.widgetRepresentation().grab().save(os.path.join(folder, "panel-in-slicer.png"))
    slicer.util.mainWindow().grab().save(os.path.join(folder, "window-in-slicer.png"))


def run():
    import MedColor

    suite = unittest.defaultTestLoader.loadTestsFromTestCase(MedColor.MedColorTest)
    result = unittest.TextTestRunner(verbosity=2).run(suite)
    for test, reason in result.skipped:
        print(f"SKIPPED {test.id()}: {reason}", flush=True)
    print(f"{result.testsRun} tests, {len(result.failures) + len(result.errors)} failed, {len(result.skipped)} skipped")
    folder = os.environ.get("MEDCOLOR_SCREENSHOTS")
    if folder and slicer.util.mainWindow():
        take_screenshots(folder)
    return result.wasSuccessful() and not (result.skipped and os.environ.get("MEDCOLOR_SKIP_NOTHING"))


try:
    successful = run()
except Exception:  # Slicer would print it and stay open
    traceback.print_exc()
    successful = False
slicer.util.exit(slicer.util.EXIT_SUCCESS if successful else slicer.util.EXIT_FAILURE)
