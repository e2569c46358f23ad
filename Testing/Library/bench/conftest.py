"""Fixtures of the tests of `bench/`."""

from __future__ import annotations

import pytest

from MedColorLib.bench import (
    pairs,
)
from MedColorLib.phantom import section


@pytest.fixture(scope="module")
def phantom():
    return pairs.make_section("phantom", section())
