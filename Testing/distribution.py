"""Which process runs which tests, where pytest-xdist runs them on several (`sh Testing/run.sh test`).

A file stays on one process, so that its fixtures are made once. The longest go first, so that none is left to one process
at the end. The cases of the Slicer host have processes of their own anyway, and go out one by one.
"""

from __future__ import annotations

import os

from xdist.scheduler import LoadFileScheduling

ONE_BY_ONE = "Testing/Module/test_in_host.py"
# by CPU seconds, as `--durations` shows them; what is not named follows by its number of tests
LONG = (
    "Testing/Library/run/test_resume.py",
    "Testing/Library/cohort/test_workers.py",
    "Testing/Library/test_memory.py",
    "Testing/Library/bench/test_bench_profile.py",
    "Testing/Library/bench/test_bench_results.py",
    ONE_BY_ONE,
    "Testing/Library/bench/test_bench_quality.py",
    "Testing/Library/cohort/test_batch.py",
    "Testing/Library/references/test_library.py",
    "Testing/Library/matching/test_assignment.py",
    "Testing/Library/references/test_loading.py",
    "Testing/Library/test_python_package.py",
    "Testing/Library/bench/test_bench.py",
    "Testing/Library/cli/test_stopping.py",
    "Testing/Library/test_pipeline.py",
    "Testing/Library/features/test_contrast_net.py",
    "Testing/Library/run/test_resume_command.py",
    "Testing/Library/matching/test_tissue_guard.py",
    "Testing/Library/run/test_plan.py",
    "Testing/Library/bench/test_bench_outline.py",
    "Testing/Library/bench/test_bench_deconvolution.py",
)
MOST_PROCESSES = 4  # a process with PyTorch and VTK and the children it starts take up to 3 GB


def file_of(unit: str) -> str:
    return unit.partition("::")[0]


def processes() -> int:
    """One for every core that this process may use, up to four."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MOST_PROCESSES)


class LongestFirst(LoadFileScheduling):
    """xdist's distribution by files, in the order of `LONG`."""

    def _split_scope(self, nodeid: str) -> str:
        return nodeid if file_of(nodeid) == ONE_BY_ONE else super()._split_scope(nodeid)

    def _assign_work_unit(self, node) -> None:
        self.workqueue.move_to_end(min(self.workqueue, key=self._rank), last=False)
        super()._assign_work_unit(node)

    def _rank(self, unit: str) -> tuple[int, int]:
        file = file_of(unit)
        return LONG.index(file) if file in LONG else len(LONG), -len(self.workqueue[unit])
