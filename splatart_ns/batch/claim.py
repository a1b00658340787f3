"""Which of several batches on one output folder works on an object."""

from __future__ import annotations

import json
import os
import re
import socket
import threading
import time
import uuid
from contextlib import suppress
from urllib.parse import quote

from splatart_ns.batch.storage import UNANSWERED, Storage
from splatart_ns.errors import InputError
from splatart_ns.machine import process_lives
from splatart_ns.shape import NUMBER, parse

_CLAIMS, _SESSIONS = ".batch/claims", ".batch/sessions"
_BEAT = 20.0
"""Seconds between two signs of life."""
_DEAD = 180.0
"""Seconds after which a batch that gave no sign of life, or one of another machine whose clock differs, is dead."""


class Session:
    """A running batch: it shows that it lives, and claims objects.

    A claim is a file `OBJECT.N` that holds the name of its session; the one with the largest N counts. Who finds that
    the session of claim N is dead creates claim N + 1, which only one can.
    """

    def __init__(self, storage: Storage):
        self._storage = storage
        self.name = uuid.uuid4().hex
        try:
            self._beat()
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(f"{storage.url}: cannot be written ({reason}); give another --output-dir.") from None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._keep_beating, daemon=True)
        self._thread.start()

    def claim(self, name: str) -> bool:
        """Whether this batch may work on an object now."""
        claims = self._claims(name)
        last, holder = max(claims.items(), default=(0, ""))
        if claims and holder == self.name:
            return True
        if claims and self._lives(holder):
            return False
        if not self._storage.create(_path(name, last + 1), self.name.encode()):
            return False
        sure = False
        try:
            # What was found may have been released, and claimed anew from the start, meanwhile.
            sure = {number: session for number, session in self._claims(name).items() if number <= last} == claims
        finally:
            if not sure:
                self._storage.remove(_path(name, last + 1))
        return sure

    def release(self, name: str) -> None:
        """Let other batches work on an object; where the storage does not answer, when this one has ended."""
        with suppress(*UNANSWERED):
            claims = self._claims(name)
            if claims and claims[max(claims)] == self.name:
                for number in sorted(claims):  # its own last: until then nobody else gets in
                    self._storage.remove(_path(name, number))

    def end(self) -> None:
        """Show no more life; all claims that are left are void."""
        self._ended.set()
        self._thread.join()
        with suppress(*UNANSWERED):  # the dead show none either
            self._storage.remove(f"{_SESSIONS}/{self.name}.json")

    def _claims(self, name: str) -> dict[int, str]:
        """Number to session, of all claims of an object."""
        found = {}
        for file in self._storage.children(_CLAIMS)[1]:
            stem, _, number = file.rpartition(".")
            if stem == quote(name, safe="") and number.isdecimal():
                session = self._storage.read(f"{_CLAIMS}/{file}")
                if session is not None:  # it may have been released since
                    found[int(number)] = session.decode(errors="replace")
        return found

    def _lives(self, session: str) -> bool:
        if re.fullmatch("[0-9a-f]{32}", session) is None:  # no name that a session gave itself, but maybe a path
            return False
        told = parse(self._storage.read(f"{_SESSIONS}/{session}.json"), {"host": str, "pid": int, "time": NUMBER})
        if told is None:
            return False
        if told["host"] == socket.gethostname() and not process_lives(told["pid"]):
            return False
        return time.time() - told["time"] < _DEAD

    def _beat(self) -> None:
        told = {"host": socket.gethostname(), "pid": os.getpid(), "time": time.time()}
        self._storage.write(f"{_SESSIONS}/{self.name}.json", json.dumps(told).encode())

    def _keep_beating(self) -> None:
        while not self._ended.wait(_BEAT):
            try:
                self._beat()
            except UNANSWERED:  # a store that does not answer may do so the next time
                continue


def _path(name: str, number: int) -> str:
    return f"{_CLAIMS}/{quote(name, safe='')}.{number}"
