"""Suite *stability*: stiff and extreme cases, one row each: what was expected, what came out, and a verdict.

A verdict is `pass`, `refused` (an error that names the trouble and its remedy, where one was expected) or `FAIL`. A warning
counts as a failure: arithmetic that overflows or divides by zero is not an answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from ..progress import Progress
from .case import Case
from .tables import Suite, Table

COLUMNS = ("area", "case", "condition", "expected", "got", "verdict", "beside")


def all_cases() -> Iterator[Case]:
    """Every case, in the pipeline's order."""
    from . import stability_color, stability_filters, stability_matching, stability_volumes

    for module in (stability_volumes, stability_color, stability_matching, stability_filters):
        yield from module.cases()


def run(progress: Progress, cases: Callable[[], Iterator[Case]] | None = None) -> Suite:
    """Run the cases; None: all of them."""
    import torch

    table = Table(COLUMNS)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # small pictures: threads would wait for each other
    try:
        listed = list((cases or all_cases)())
        for number, case in enumerate(listed):
            progress(number / len(listed), f"stability, {case.area}: {case.case}")
            got, verdict = case.verdict()
            names = {name: getattr(case, name) for name in ("area", "case", "condition", "expected", "beside")}
            table.add(**names, got=got, verdict=verdict)
    finally:
        torch.set_num_threads(threads)
    return Suite({"stability": table}, notes=[__doc__.split("\n\n")[1].replace("\n", " ").replace("`", "")])
