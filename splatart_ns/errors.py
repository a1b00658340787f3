"""The one exception for what a user can mend, and what full disks raise."""

import errno

DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
"""Of a disk that takes no more; what writes to an open file raises them without its name."""


class InputError(Exception):
    """An input from outside cannot be used.

    The message is one sentence that names the file, the value found and how to mend it. Commands print it
    without a traceback and exit with code 2.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


def first_line(error: Exception) -> str:
    """The first line of what an error says, without its full stop; its type where it says nothing."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")


def printable(text: str) -> str:
    """A text on one line that leaves a terminal as it is, whatever names from outside are in it."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
