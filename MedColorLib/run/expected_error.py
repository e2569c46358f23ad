"""What colour error to expect of settings: the range that the benchmark measured on pairs whose true colours are known.

`expected_error.json` is made from a stored result: `python -m MedColorLib.bench.expected_error_table RESULT.json`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from ..parameters import Settings

TABLE = Path(__file__).with_name("expected_error.json")
# Smallest share of trusted matches (`confidence.Trust.trusted_fraction`) on 30 pairs: thorax, head, phantom, five remaps, two
# warps. It gives no place in the range: with VGG-19 its correlation with the error over these pairs is 0.08, and real scans lie
# below them all (own features, VGG-19: slices of a CT head after a photograph of the same head 0.45, 0.64; of an MR head after
# another's 0.28, 0.41; of the CT head after a thorax 0.24, 0.17).
LEAST_TRUSTED = {"embedded": 0.80, "vgg19": 0.76}
NOT_MEASURED = "not measured by the benchmark for these settings"


@dataclass(frozen=True)
class ExpectedError:
    """Mean CIEDE2000 of a*, b* inside the body, at the true lightness, from the easiest to the hardest pair.

    Attributes:
        low, high: the smallest and the largest mean. easiest, hardest: the pairs they were measured on.
        pairs: how many were measured.
    """

    low: float
    high: float
    easiest: str
    hardest: str
    pairs: int

    def text(self) -> str:
        """For people."""
        if self.pairs == 1:
            return f"mean CIEDE2000 {self.low:.1f} on the one pair of the benchmark ({self.easiest})"
        return (
            f"mean CIEDE2000 {self.low:.1f} ({self.easiest}) to {self.high:.1f} ({self.hardest}), "
            f"measured on {self.pairs} pairs with known colours; where the reference is another body, it may be more"
        )


def expected_error(settings: Settings, features: str) -> ExpectedError | None:
    """The measured range for settings; None for what the benchmark does not measure.

    Args:
        features: as resolved (not "auto").
    """
    if settings.luminance == "paper" or settings.smoother_options:
        return None
    method = settings.preset if settings.reconstruction == "warp" else f"{settings.preset}, {settings.reconstruction}"
    return _table().get((features, method, settings.resolved_smoother, settings.resolved_gamma))


@lru_cache(maxsize=1)
def _table() -> dict[tuple, ExpectedError]:
    rows = json.loads(TABLE.read_text(encoding="utf-8"))["rows"]
    return {tuple(key): ExpectedError(*values) for *key, values in rows}
