"""Parameters of the fast global smoother.

Which lambda: with T iterations, "min2014" (the paper) uses lambda_t = 3/2 4^(T-t) / (4^T - 1) lambda for t = 1..T: 0.381,
0.095, 0.024 times lambda at T = 3; "opencv" is what cv2.ximgproc.fastGlobalSmootherFilter does: lambda, lambda/4,
lambda/16. The same lambda is there 2.6 times stronger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import options

SCHEDULES = ("min2014", "opencv")
LAMBDA_LIMIT = 1e30  # sums of links stay far inside float32
_LARGEST = float(np.finfo(np.float64).max)


@dataclass(frozen=True)
class FgsParameters:
    """Parameters of the fast global smoother; the defaults are those of the colour transfer (8-bit guide units).

    Attributes:
        lam: strength, 0 (nothing) to 1e30; what it means depends on `schedule`.
        sigma: guide difference at which a link falls to 1/e, in the guide's units; 0: only equal pixels are linked.
        iterations: 1 to 100; each smooths along rows, then along columns.
        schedule: "min2014" or "opencv", how lambda is shared among the iterations.
    """

    lam: float = options.number(32.0, 0.0, LAMBDA_LIMIT, "Strength; 0 smooths nothing.")
    sigma: float = options.number(
        200.0, 0.0, _LARGEST, "Difference of luminance across which colours mix less; 0 keeps every edge.", "of 255"
    )
    iterations: int = options.count(3, 1, 100, "Passes, each along rows and then along columns.")
    schedule: str = options.choice("min2014", SCHEDULES, "How the strength is shared among the iterations.")

    def __post_init__(self) -> None:
        options.check(self)


def lambda_schedule(lam: float, iterations: int, schedule: str) -> list[float]:
    """The lambda of each iteration (module docstring)."""
    if schedule == "opencv":
        return [lam * 0.25**t for t in range(iterations)]
    return [1.5 * 0.25**t / (1.0 - 0.25**iterations) * lam for t in range(1, iterations + 1)]
