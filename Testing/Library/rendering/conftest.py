"""Fixtures of the tests of `rendering/`."""

from __future__ import annotations

import pytest

from MedColorLib.errors import DeviceError
from MedColorLib.rendering import (
    offscreen,
)


@pytest.fixture(scope="module")
def gl():
    """Skips where nothing can be drawn; the reason names the packages to install."""
    try:
        offscreen.working_window()
    except DeviceError as error:
        pytest.skip(str(error))
