"""The root of errors that a person can do something about."""


class ReportedError(Exception):
    """Ends a program with one line that names what was got and what is allowed, and no traceback."""
