"""Libraries kept quiet, whatever part of them speaks, and only as long as they are to be."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile

from MedColorLib.errors import InputError
from MedColorLib.io.files import read_volume
from MedColorLib.io.quiet import cv2_log, quiet_cv2, quiet_itk, quiet_package, quiet_stderr

PARTS = ("PIL.TiffImagePlugin", "nibabel.global", "tifffile", "pydicom")


@pytest.mark.parametrize("part", PARTS)
def test_every_part_of_a_package_is_quiet(part: str, caplog: pytest.LogCaptureFixture) -> None:
    """Pillow's modules have loggers of their own."""
    with warnings.catch_warnings(record=True) as warned, quiet_package(part.split(".", maxsplit=1)[0]):
        logging.getLogger(part).critical("odd header")
        warnings.warn("odd header", stacklevel=1)
    assert not caplog.messages and not warned
    logging.getLogger(part).critical("heard again")
    assert caplog.messages == ["heard again"]


@pytest.mark.parametrize("part", PARTS)
def test_files_that_are_closed_in_the_order_they_were_opened(part: str, caplog: pytest.LogCaptureFixture) -> None:
    """As by two threads, or by two readers that were given up: the first out leaves it quiet, the last one does not."""
    filters = list(warnings.filters)
    first, second = (quiet_package(part.split(".", maxsplit=1)[0]) for _ in range(2))
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    logging.getLogger(part).critical("odd header")
    warnings.warn("odd header", stacklevel=1)
    second.__exit__(None, None, None)
    logging.getLogger(part).critical("heard again")
    assert caplog.messages == ["heard again"] and warnings.filters == filters


@pytest.mark.parametrize("quiet", [quiet_stderr, quiet_cv2, quiet_itk])
def test_other_libraries_are_heard_after_the_last_as_well(quiet: Callable, capfd: pytest.CaptureFixture) -> None:
    level, shown = cv2_log().getLogLevel(), sitk.ProcessObject.GetGlobalWarningDisplay()
    first, second = quiet(), quiet()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    if quiet is quiet_stderr:
        os.write(2, b"odd header")
    second.__exit__(None, None, None)
    os.write(2, b"heard again")
    assert capfd.readouterr().err == "heard again"
    assert (cv2_log().getLogLevel(), sitk.ProcessObject.GetGlobalWarningDisplay()) == (level, shown)


def test_a_reader_that_is_given_up_leaves_nothing_quiet(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name, size in (("a", 20), ("b", 30)):
        tifffile.imwrite(tmp_path / f"{name}.tif", np.zeros((2, size, size), np.uint16))
    with pytest.raises(InputError, match="all slices need one size") as error:
        read_volume(tmp_path)
    logging.getLogger("tifffile").critical("heard again")
    assert caplog.messages == ["heard again"] and error  # which holds the frames of the reader


def test_a_program_without_an_error_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Windows without a console."""
    monkeypatch.setattr(sys, "stderr", None)
    with quiet_stderr():
        pass
