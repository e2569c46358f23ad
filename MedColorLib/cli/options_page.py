"""The page of all options, `Resources/Documentation/options.md`, made from the parser itself:

    python -m MedColorLib.cli.options_page Resources/Documentation/options.md

A test fails where the page and the parser differ.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from ..filters import PARAMETERS, Option, smoother_options
from .options import make_parser

_HEAD = """# Options

Every option of every command, made from the program itself (`python -m MedColorLib.cli.options_page`). `medcolor COMMAND --help`
says the same. From Python the options are fields of `MedColorLib.Settings`.
"""
_SMOOTHERS = """## Parameters of the smoothers

`--smoother-option NAME=VALUE`, for the smoother that is in use; in Slicer under *Advanced > Smoother values*.

| smoother | name | values | default | meaning |
| --- | --- | --- | --- | --- |"""


def options_page() -> str:
    """The page as Markdown; the same text on every machine and in every version of Python."""
    parts = [_HEAD, *(_section(parser) for parser in _parsers(make_parser())), _smoothers()]
    return "\n".join(parts)


def all_options() -> set[str]:
    """Every long option of every command."""
    parsers = _parsers(make_parser())
    return {name for parser in parsers for action in parser._actions for name in action.option_strings if "--" in name}


def _parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """A parser and those of its commands, in the order of `--help`."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for child in action.choices.values():
                yield from _parsers(child)


def _section(parser: argparse.ArgumentParser) -> str:
    commands = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    hidden = (argparse._SubParsersAction, argparse._HelpAction)
    shown = [action for action in parser._actions if not isinstance(action, hidden)]
    lines = [f"## {parser.prog}", ""]
    if commands:
        texts = {choice.dest: choice.help for choice in commands[0]._choices_actions}
        rows = [f"| `{child.prog}` | {_cell(texts.get(name) or '')} |" for name, child in commands[0].choices.items()]
        lines += ["| command | what it does |", "| --- | --- |", *rows, ""]
    if shown:
        lines += ["| option | meaning | default |", "| --- | --- | --- |", *map(_row, shown), ""]
    for group in parser._mutually_exclusive_groups:
        names = [action.option_strings[-1] for action in group._group_actions]
        lines += [f"One of {', '.join(f'`{name}`' for name in names)} at a time.", ""]
    return "\n".join(lines)


def _row(action: argparse.Action) -> str:
    names = ", ".join(f"`{name}`" for name in action.option_strings) or f"`{_value(action)}`"
    value = f" `{_cell(_value(action))}`" if action.option_strings and _value(action) else ""
    help_text = re.sub(r" \(default: %\(default\)s( \w+)?\)", "", action.help or "")  # the last column has it
    meaning = _cell(help_text % {"prog": "medcolor"})
    if action.choices:
        meaning += f"{'; ' if meaning else ''}one of {', '.join(f'`{choice}`' for choice in action.choices)}"
    needed = action.required and (action.option_strings or action.nargs != "?")
    return f"| {names}{value} | {meaning} | {'required' if needed else _default(action)} |"


def _value(action: argparse.Action) -> str:
    """What stands behind an option, such as `LO HI`."""
    if action.nargs == 0:
        return ""
    if isinstance(action.metavar, tuple):
        return " ".join(action.metavar)
    if action.metavar:
        return f"{action.metavar}{' ...' if action.nargs == '+' else ''}"
    return action.dest.upper() if action.option_strings else action.dest


def _default(action: argparse.Action) -> str:
    value = action.default
    if value is None or value is False or value in ("", argparse.SUPPRESS):
        return ""
    text = " ".join(map(str, value)) if isinstance(value, (tuple, list)) else str(value)
    return f"`{text.replace(os.sep, '/')}`"


def _smoothers() -> str:
    rows = [
        f"| `{smoother}` | `{option.name}` | {_values(option)} | `{option.default}` | {_cell(option.about)} |"
        for smoother in PARAMETERS
        for option in smoother_options(smoother)
    ]
    return "\n".join([_SMOOTHERS, *rows, ""])


def _values(option: Option) -> str:
    if option.choices:
        return ", ".join(f"`{choice}`" for choice in option.choices)
    low = f"above {option.low:g} up" if option.above_low else f"{option.low:g}"
    return f"{low} to {option.high:g}{f' {option.unit}' if option.unit else ''}{', whole' if option.whole else ''}"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def main(arguments: list[str]) -> None:
    """Write the page to the file named, or print it."""
    if arguments:
        Path(arguments[0]).write_text(options_page(), encoding="utf-8")
    else:
        sys.stdout.write(options_page())


if __name__ == "__main__":
    main(sys.argv[1:])
