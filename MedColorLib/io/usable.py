"""Names that the system cannot even look for: too long, with a NUL, or links in a circle."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import InputError


def usable(name: str | os.PathLike, what: str) -> Path:
    """The path, which need not be there.

    Args:
        what: whose name it is, for the message.

    Raises:
        InputError: it can be the name of nothing.
    """
    try:
        os.stat(name)
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        pass
    except (OSError, ValueError) as error:
        shown = os.fspath(name) if len(os.fspath(name)) < 80 else f"{os.fspath(name)[:60]}..."
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{what}: {shown!r} cannot be the name of a file or folder ({reason}); check it") from error
    return Path(name)
