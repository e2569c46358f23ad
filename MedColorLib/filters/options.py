"""What can be set on a smoother: range, unit and meaning of each field of its parameters, and the check of them all.

The parameter dataclasses declare their fields with `number`, `count` and `choice`; the settings, the command line and the
panel read them back with `options_of`, so ranges and defaults are written down once.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from ..errors import SettingsError
from .checks import count_in_range, number_in_range


@dataclass(frozen=True)
class Option:
    """One field of a smoother's parameters.

    Attributes:
        name, default: of the field.
        about: what it does, a sentence. unit: "px" and the like, or "".
        low, high: range of numbers, both included unless `above_low`. whole: only whole numbers.
        choices: the words it takes; empty for numbers.
    """

    name: str
    default: Any
    about: str
    unit: str = ""
    low: float = 0.0
    high: float = 0.0
    above_low: bool = False
    whole: bool = False
    choices: tuple[str, ...] = ()

    def text(self) -> str:
        """Name, range and default, for messages: lam (0 to 1e+30, default 32)."""
        if self.choices:
            return f"{self.name} ({' or '.join(self.choices)}, default {self.default})"
        start = f"above {self.low:g}, up" if self.above_low else f"{self.low:g}"
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.name} ({start} to {self.high:g}{unit}, default {self.default:g})"


def number(default: float, low: float, high: float, about: str, unit: str = "", above_low: bool = False):
    """A dataclass field that takes numbers from `low` (`above_low`: not itself) to `high`."""
    return _field(default, about=about, unit=unit, low=low, high=high, above_low=above_low)


def count(default: int, low: int, high: int, about: str, unit: str = ""):
    """A dataclass field that takes whole numbers from `low` to `high`."""
    return _field(default, about=about, unit=unit, low=low, high=high, whole=True)


def choice(default: str, choices: tuple[str, ...], about: str):
    """A dataclass field that takes one of some words."""
    return _field(default, about=about, choices=choices)


def _field(default, **option):
    return field(default=default, metadata={"option": option})


def options_of(parameters: type) -> tuple[Option, ...]:
    """The options of a parameter dataclass, in the order of its fields."""
    return tuple(Option(f.name, f.default, **f.metadata["option"]) for f in fields(parameters))


def check(parameters: object) -> None:
    """Check every field of a parameter dataclass and store it as the type it stands for.

    Raises:
        SettingsError: a value outside its range; the message names field and range.
    """
    for option in options_of(type(parameters)):
        object.__setattr__(parameters, option.name, _checked(option, getattr(parameters, option.name)))


def _checked(option: Option, value: object):
    if option.choices:
        if value not in option.choices:
            raise SettingsError(f"{option.name}: expected one of {', '.join(option.choices)}, got {value!r}")
        return value
    if option.whole:
        return count_in_range(option.name, value, option.low, option.high)
    return number_in_range(option.name, value, option.low, option.high, above_low=option.above_low)


def from_options(smoother: str, parameters: type, options: dict | None):
    """An instance of a smoother's parameter dataclass from names and values; None or nothing takes the defaults.

    Raises:
        SettingsError: an unknown name or a wrong value; the message lists what the smoother takes.
    """
    takes = f"{smoother} takes {', '.join(option.text() for option in options_of(parameters))}"
    if options is not None and not isinstance(options, dict):
        raise SettingsError(f"smoother_options: expected names and values, got {options!r}; {takes}")
    unknown = [str(name) for name in options or {} if name not in {option.name for option in options_of(parameters)}]
    if unknown:
        raise SettingsError(f"smoother_options: {smoother} has no {', '.join(unknown)}; {takes}")
    try:
        return parameters(**(options or {}))
    except SettingsError as error:
        raise SettingsError(f"smoother_options: {error}; {takes}") from error


def values_text(parameters: object) -> str:
    """Names and values, for the plan: lam 32, sigma 200, iterations 3, schedule min2014."""
    values = ((option.name, getattr(parameters, option.name)) for option in options_of(type(parameters)))
    return ", ".join(f"{name} {value if isinstance(value, str) else format(value, 'g')}" for name, value in values)
