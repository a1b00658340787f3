"""One fit at a time in a folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from splatart_ns.errors import InputError

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

_NAME = ".fit.lock"


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """A block in which no other fit, of any process, may write into a folder, which is made where there is none.

    The lock ends with the process, however that ends. File systems without locks let everybody in.

    Raises:
        InputError: another fit is at work there, or the folder cannot be written.
    """
    path = folder / _NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    except OSError as error:
        raise InputError(f"{folder} cannot be written ({error.strerror}); choose another --output-dir.") from None
    with file:
        if not _is_ours(file, path):
            raise InputError(f"{folder}: another fit is at work there; wait for it, or choose another --output-dir.")
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _is_ours(file: IO[str], path: Path) -> bool:
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # there are no locks here
        return True
    # The fit that had it may have removed the file since it was opened.
    return path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())
