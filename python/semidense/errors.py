"""What can go wrong, in words that say what to do."""

from __future__ import annotations


class SemidenseError(Exception):
    """Every error of this package."""


class NotRunning(SemidenseError, TimeoutError):
    """No instance of this name runs here; raised once the `timeout` is over."""


class WireVersion(SemidenseError):
    """The instance speaks another version of the messages than this package."""

    def __init__(self, instance: str, found: int, ours: int) -> None:
        """`found` is the version of the instance, `ours` that of this package."""
        self.found = found
        self.ours = ours
        super().__init__(
            f"instance `{instance}` speaks wire version {found}, this package {ours}: "
            "stop the old one, or install the package of the same version as the semidense that runs"
        )


class TooManyHeld(SemidenseError):
    """More messages are held at a time than shared memory has room for."""


class TooManyReaders(SemidenseError):
    """A topic has as many subscribers as it may have."""


class CommandFailed(SemidenseError):
    """The mapper refused a command or did not answer."""


class BadPlace(SemidenseError, ValueError):
    """Instance or root folder cannot be used."""


class BadRun(SemidenseError, ValueError):
    """A file of a finished run is broken, or the folder holds no run."""
