"""One case of the suite *stability*: what is asked, what is expected, and the verdict. It knows none of the cases."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

from ..errors import MedColorError

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
