"""The one exception for what a user can mend."""


class InputError(Exception):
    """An input from outside cannot be used.

    The message is one sentence that names the file, the value found and how to mend it. Commands print it
    without a traceback and exit with code 2.
    """
