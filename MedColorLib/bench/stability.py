"""Suite *stability*: stiff and extreme cases, one row each: what was expected, what came out, and a verdict.

A verdict is `pass`, `refused` (an error that names the trouble and its remedy, where one was expected) or `FAIL`. A warning
counts as a failure: arithmetic that overflows or divides by zero is not an answer.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from ..errors import MedColorError
from ..progress import Progress
from .tables import Suite, Table

COLUMNS = ("area", "case", "condition", "expected", "got", "verdict", "beside")
REFUSED = "refused, with the remedy"


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        area, case, condition: where, what, under which condition.
        expected: in words; REFUSED where an error is the right answer.
        check: runs it; returns whether the answer is right, and the answer in words.
        beside: what a well-known implementation does with it, in words.
        may_refuse: an error is as good an answer as the one expected.
    """

    area: str
    case: str
    condition: str
    expected: str
    check: Callable[[], tuple[bool, str]]
    beside: str = ""
    may_refuse: bool = False

    def verdict(self) -> tuple[str, str]:
        """(got, verdict)."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                right, got = self.check()
        except MedColorError as error:
            return str(error), "refused" if self.may_refuse or self.expected == REFUSED else "FAIL"
        except Exception as error:  # whatever a case raises is its result, and the next case must run
            return f"{type(error).__name__}: {error}", "FAIL"
        return got, "pass" if right and self.expected != REFUSED else "FAIL"


def at_most(measure: Callable[[], float], bound: float, unit: str = "") -> Callable[[], tuple[bool, str]]:
    """Check that a number is at most `bound`; NaN is not."""

    def check() -> tuple[bool, str]:
        value = float(measure())
        return value <= bound, f"{value:.2g}{unit}"

    return check


def holds(question: Callable[[], bool], yes: str, no: str = "it does not") -> Callable[[], tuple[bool, str]]:
    """Check that something is true."""

    def check() -> tuple[bool, str]:
        answer = bool(question())
        return answer, yes if answer else no

    return check


def refuses(call: Callable[[], object]) -> Callable[[], tuple[bool, str]]:
    """For cases whose expected answer is REFUSED."""

    def check() -> tuple[bool, str]:
        call()
        return False, "taken without a word"

    return check


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
