"""Words for a terminal: nothing in a name or credit acts as a control sequence, nothing fails to be encoded."""

from __future__ import annotations

import logging
import re
import sys

# C0 without newline and tab, DEL, C1, and the marks that turn the direction of text round.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def plain(text: object) -> str:
    """The text with control characters made visible, such as \\x1b."""
    return _CONTROL.sub(lambda found: ascii(found[0])[1:-1], str(text))


def say(text: object) -> None:
    """Print a result."""
    print(plain(text))


def tell(text: object) -> None:
    """Print a message, under the program's name, on the error stream."""
    print(f"medcolor: {plain(text)}", file=sys.stderr)


def prepare_streams(level: int) -> None:
    """Let any character pass, where need be as \\xNN or \\uNNNN, and send the log to the error stream."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # not where a test or a host put something else there
            stream.reconfigure(errors="backslashreplace")
    log_to_stderr(level)


def log_to_stderr(level: int) -> None:
    """Send the log to the error stream, unless a host has already decided where it goes."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Plain("medcolor: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])


class _Plain(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return plain(super().format(record))
