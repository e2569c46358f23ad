"""Errors of MedColor: each message names what is wrong, where, and what to do about it."""

from __future__ import annotations


class MedColorError(Exception):
    """Base of all errors a user can cause or cure. The command line prints it as one line and exits with status 2."""


class InputError(MedColorError):
    """A file, folder or array that cannot be used as given (missing, unreadable, wrong shape, no finite value...)."""


class SettingsError(MedColorError):
    """A parameter outside its range or a name that is not one of the alternatives."""


class OutputError(MedColorError):
    """A result that cannot be written (folder missing or read-only, disk full, unknown file ending)."""


class WeightsError(MedColorError):
    """Network weights that are missing, truncated, of another network, or whose hash differs from the expected one."""


class DeviceError(MedColorError):
    """A compute device that does not exist here, or whose memory is too small."""


class MemoryTooSmall(DeviceError):
    """The memory of a device, or of this machine, does not suffice."""


class MissingPackageError(MedColorError):
    """An optional package is not installed; the message carries the install command."""


class Cancelled(Exception):
    """Raised inside a computation after `cancelled()` returned True; nothing has been written."""
