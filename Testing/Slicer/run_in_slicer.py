"""Runs MedColorTest inside Slicer and ends Slicer with status 0 or 1:

    Slicer --no-splash --testing --no-main-window --additional-module-paths "$PWD/MedColor" \
        --python-script "$PWD/Testing/Slicer/run_in_slicer.py"

The paths are absolute, as Slicer wants them. Without --no-main-window (under a virtual display if need be) the 3-D view is
looked at too. With MEDCOLOR_SCREENSHOTS naming a folder, pictures of the window and of the panel are written there. Every
test that was skipped is listed at the end with its reason; with MEDCOLOR_SKIP_NOTHING=1 a skipped test counts as a failure.
So does an error in a slot or an observer, which Slicer would only print. What hangs for MEDCOLOR_TIMEOUT seconds (900) is
ended with status 1, after the place where it hangs was printed.
"""

import faulthandler
import os
import sys
import traceback
import unittest

import slicer


def take_screenshots(folder):
    """The panel and the window with the phantom in the scene."""
    from MedColorSlicer import samples

    os.makedirs(folder, exist_ok=True)
    slicer.mrmlScene.Clear(0)
    slicer.util.selectModule("MedColor")
    samples.load_phantom()
    slicer.app.processEvents()
    for widget, name in (
        (slicer.modules.medcolor.widgetRepresentation(), "panel-in-slicer.png"),
        (slicer.util.mainWindow(), "window-in-slicer.png"),
    ):
        if not widget.grab().save(os.path.join(folder, name)):
            raise OSError(f"{name} could not be written to {folder}")


def run():
    import MedColor

    suite = unittest.defaultTestLoader.loadTestsFromTestCase(MedColor.MedColorTest)
    result = unittest.TextTestRunner(verbosity=2).run(suite)
    for test, reason in result.skipped:
        print(f"SKIPPED {test.id()}: {reason}", flush=True)
    failed = len(result.failures) + len(result.errors) + len(result.unexpectedSuccesses)
    print(f"{result.testsRun} tests, {failed} failed, {len(result.skipped)} skipped", flush=True)
    folder = os.environ.get("MEDCOLOR_SCREENSHOTS")
    if folder and slicer.util.mainWindow():
        take_screenshots(folder)
    slicer.app.processEvents()  # what was put off may fail, too
    return result.testsRun > 0 and not failed and not (result.skipped and os.environ.get("MEDCOLOR_SKIP_NOTHING"))


uncaught = []


def keep(kind, error, trace):
    """Errors that nobody caught, as text."""
    uncaught.append("".join(traceback.format_exception(kind, error, trace)))


faulthandler.dump_traceback_later(float(os.environ.get("MEDCOLOR_TIMEOUT", "900")), exit=True, file=2)
sys.excepthook = keep
try:
    successful = run()
except Exception:  # Slicer would print it and stay open
    traceback.print_exc()
    successful = False
finally:
    sys.excepthook = sys.__excepthook__
    faulthandler.cancel_dump_traceback_later()
for text in uncaught:
    print(f"UNCAUGHT {text}", flush=True)
slicer.util.exit(slicer.util.EXIT_SUCCESS if successful and not uncaught else slicer.util.EXIT_FAILURE)
