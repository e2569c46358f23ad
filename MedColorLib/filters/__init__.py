"""Stage *filters*: edge-preserving smoothing of colour, guided by the scan's luminance.

    fgs                fgs.py, fgs_torch.py   weighted least squares along rows and columns in turn; also on GPU
    guided             guided.py              local linear model of the source in the guide
    domain-transform   domain_transform.py    recursive filter along rows and columns
    wls                wls.py                 weighted least squares in two dimensions, sparse direct solution

Each entry of FILTERS is called as `smooth(source (H, W, C), guide (H, W) in 0..255, parameters or None)` and returns
the source's shape, in its float dtype. All are linear in the source: smooth(a) - smooth(b) = smooth(a - b), which saves
one of two solves. No import here loads torch or SciPy; the filters do when they run.
"""

from __future__ import annotations

from typing import Any, Callable

import numpy as np

from ..errors import SettingsError
from . import domain_transform as _domain_transform
from . import fgs as _fgs
from . import guided as _guided
from . import wls as _wls
from .domain_transform import DomainTransformParameters
from .fgs import FgsParameters, fast_global_smoother
from .guided import GuidedParameters
from .options import Option, from_options, options_of
from .regression import RegressionParameters
from .wls import WlsParameters

Smoother = Callable[..., np.ndarray]

FILTERS: dict[str, Smoother] = {
    "fgs": _fgs.smooth,
    "guided": _guided.smooth,
    "domain-transform": _domain_transform.smooth,
    "wls": _wls.smooth,
}

PARAMETERS: dict[str, type] = {
    "fgs": FgsParameters,
    "guided": GuidedParameters,
    "domain-transform": DomainTransformParameters,
    "wls": WlsParameters,
    "regression": RegressionParameters,  # not a filter of the difference (`transfer`), but set in the same way
}


def smoother_options(smoother: str) -> tuple[Option, ...]:
    """What can be set on a smoother, a key of PARAMETERS."""
    return options_of(PARAMETERS[smoother])


def smoother_parameters(smoother: str, options: dict | None = None):
    """An instance of PARAMETERS[smoother] from names and values; what is not named takes its default.

    Raises:
        SettingsError: an unknown name or a wrong value; the message lists what the smoother takes.
    """
    return from_options(smoother, PARAMETERS[smoother], options)


def smooth(name: str, source: np.ndarray, guide: np.ndarray, parameters: Any = None) -> np.ndarray:
    """Run the filter of that name.

    Args:
        name: a key of FILTERS.
        source: (H, W, C) floats.
        guide: (H, W) in 0..255.
        parameters: an instance of PARAMETERS[name], or None for the paper's values.

    Raises:
        SettingsError: unknown name, or parameters of another filter.
        InputError: shapes that do not fit, NaN or infinite values.
    """
    if name not in FILTERS:
        raise SettingsError(f"smoother: expected one of {', '.join(FILTERS)}, got {name!r}")
    return FILTERS[name](source, guide, parameters)


__all__ = [
    "FILTERS",
    "PARAMETERS",
    "DomainTransformParameters",
    "FgsParameters",
    "GuidedParameters",
    "Option",
    "RegressionParameters",
    "WlsParameters",
    "fast_global_smoother",
    "smooth",
    "smoother_options",
    "smoother_parameters",
]
