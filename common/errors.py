"""The base class of errors that a user can fix."""


class ReportedError(Exception):
    """Ends a program with one line, without a traceback: what was given, and what is allowed."""
