"""How the tests are shared out to several processes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip("xdist")

import distribution
from distribution import LONG, ONE_BY_ONE, LongestFirst

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def scheduler():
    """Without processes: only its questions are asked."""
    made = object.__new__(LongestFirst)
    made.workqueue = {}
    return made


def test_every_long_file_is_there():
    assert [name for name in LONG if not (ROOT / name).is_file()] == []


def test_a_file_stays_together_and_cases_of_the_host_do_not(scheduler):
    name = "Testing/Library/run/test_plan.py"
    assert {scheduler._split_scope(f"{name}::{test}") for test in ("test_a", "TestB::test_c[x::y]")} == {name}
    cases = [f"{ONE_BY_ONE}::test_cases[{case}]" for case in ("a.py", "b.py")]
    assert [scheduler._split_scope(case) for case in cases] == cases


def test_the_longest_go_first_and_then_the_fullest(scheduler):
    expected = [LONG[0], f"{ONE_BY_ONE}::test_cases[b.py]", LONG[-1], "many.py", "one.py"]
    scheduler.workqueue = {name: dict.fromkeys("ab" if name == "many.py" else "a") for name in reversed(expected)}
    assert sorted(scheduler.workqueue, key=scheduler._rank) == expected


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this platform does not tell which cores may be used")
@pytest.mark.parametrize(("cores", "processes"), [(1, 1), (3, 3), (64, 4)])
def test_as_many_processes_as_cores_up_to_four(cores, processes, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert distribution.processes() == processes
