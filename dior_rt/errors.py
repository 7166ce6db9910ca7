"""Every error that this package raises on purpose.

    DiorError
    ├── InputError        a photo, strokes or option that cannot be used
    ├── BundleError       a model folder that is missing, altered, or of an unknown kind
    ├── DeviceError       a device that is not there, or that computes wrong results
    ├── MissingExtraError a command whose optional packages are not installed
    └── Cancelled         the caller's progress callback asked to stop

Errors of libraries are translated once, at the boundary, into one of these: one sentence, with the way out.
"""

from __future__ import annotations


class DiorError(Exception):
    """The base of all errors of this package. Its text is one sentence for the user."""


class InputError(DiorError):
    """A photo, strokes or option that cannot be used."""


class BundleError(DiorError):
    """A model folder that is missing, altered, cut short, or of an unknown kind."""


class DeviceError(DiorError):
    """A device that does not exist, or that computes wrong results."""


class MissingExtraError(DiorError):
    """A command whose optional packages are not installed."""

    def __init__(self, command: str, extra: str) -> None:
        super().__init__(f"`dior-rt {command}` needs more packages: pip install 'dior-rt[{extra}]'.")


class Cancelled(DiorError):  # noqa: N818 - it is an outcome that the caller asked for, not a fault
    """The caller's progress callback asked to stop."""
