"""Libraries kept quiet, whatever part of them speaks, and only as long as they are to be."""

from __future__ import annotations

import logging
import sys
import warnings

import pytest

from MedColorLib.io.quiet import quiet_package, quiet_stderr

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


def test_a_program_without_an_error_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Windows without a console."""
    monkeypatch.setattr(sys, "stderr", None)
    with quiet_stderr():
        pass
