"""The one exception for input that a user can mend."""

from __future__ import annotations


class InputError(Exception):
    """Bad data or a bad setting: says where, what was expected, what was found and what to do.

    The command line prints it as one line and exits with status 2; it is never raised for a defect of our own.
    """

    def __init__(self, where: str, *, expected: str, found: str, do: str = "") -> None:
        self.where, self.expected, self.found, self.do = where, expected, found, do
        message = f"{where}: expected {expected}, found {found}" + (f"; {do}" if do else "")
        # names out of files may hold line breaks or worse: one line stays one line
        super().__init__("".join(c if c.isprintable() else " " for c in message))

    def __reduce__(self):  # keyword-only arguments do not survive the default way between processes
        return _rebuild, (type(self), self.where, self.expected, self.found, self.do)


class NotGiven(InputError):
    """Data that the user has not pointed to; a collection of experiments goes on without it and says so."""


def _rebuild(kind: type[InputError], where: str, expected: str, found: str, do: str) -> InputError:
    return kind(where, expected=expected, found=found, do=do)
