"""Fixtures of the tests of `matching/`."""

from __future__ import annotations

import pytest
from tissue_guard_samples import (
    Scene,
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()
