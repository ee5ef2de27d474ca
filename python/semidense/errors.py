"""Errors, with messages that say what to do."""

from __future__ import annotations


class SemidenseError(Exception):
    """Base class of all errors of this package."""


class NotRunning(SemidenseError, TimeoutError):
    """No instance of this name is running here; raised once the `timeout` is over."""


class WireVersion(SemidenseError):
    """The instance uses another version of the messages than this package."""

    def __init__(self, instance: str, found: int, ours: int) -> None:
        """`found` is the version of the instance, `ours` that of this package."""
        self.found = found
        self.ours = ours
        super().__init__(
            f"instance `{instance}` uses wire version {found}, this package {ours}: "
            "stop the old one, or install the package of the same version as the running semidense"
        )


class TooManyHeld(SemidenseError):
    """More messages are held at once than shared memory has room for."""


class TooManyReaders(SemidenseError):
    """A topic has reached its limit of subscribers."""


class CommandFailed(SemidenseError):
    """The mapper refused a command or did not answer."""


class BadPlace(SemidenseError, ValueError):
    """The instance name or root folder cannot be used."""


class BadRun(SemidenseError, ValueError):
    """A file of a finished run is damaged, or the folder contains no run."""
