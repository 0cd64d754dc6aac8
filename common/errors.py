"""The base class of errors that a user can fix."""


class ReportedError(Exception):
    """Ends a program with one line, without a traceback: what was given, and what is allowed."""


class ConfigError(ReportedError, ValueError):
    """A setting that can't be used: one line with the key, the value, and what is allowed."""


class StoppedError(ReportedError):
    """A stop was requested before a command was done."""


class HelpRequest(Exception):  # noqa: N818 - not an error
    """The help text was requested; the exception carries it."""
