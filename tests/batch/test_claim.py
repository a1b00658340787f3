"""Claims of several batches on objects."""

import json
import subprocess
import sys
import uuid
from concurrent.futures import ThreadPoolExecutor

import pytest

from splatart_ns.batch.claim import Session
from splatart_ns.batch.storage import open_storage


@pytest.fixture(params=["folder", "object store"])
def storage(request, tmp_path):
    if request.param == "folder":
        return open_storage(str(tmp_path))
    return open_storage(f"{request.getfixturevalue('object_store')}/{uuid.uuid4().hex}")


@pytest.fixture
def session(storage):
    sessions = []

    def start():
        sessions.append(Session(storage))
        return sessions[-1]

    yield start
    for one in sessions:
        one.end()


def dies(storage, session, **told):
    """Make a session look as if its batch had died."""
    path = f".batch/sessions/{session.name}.json"
    storage.write(path, json.dumps(json.loads(storage.read(path)) | told).encode())


def test_one_at_a_time(session):
    first, second = session(), session()
    assert first.claim("a/b") and first.claim("a/b")
    assert not second.claim("a/b") and second.claim("a")
    first.release("a/b")
    assert second.claim("a/b") and not first.claim("a/b")
    first.release("a/b")  # it is not its own
    assert not first.claim("a/b")


def test_of_many_at_once_one_gets_it(session):
    sessions = [session() for _ in range(8)]
    with ThreadPoolExecutor(8) as threads:
        assert sum(threads.map(lambda one: one.claim("a"), sessions)) == 1


def ended_process():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.mark.parametrize("told", [{"pid": None}, {"host": "elsewhere", "time": 0.0}])
def test_claims_of_the_dead_are_void(session, storage, told):
    dead, heir, other = session(), session(), session()
    assert dead.claim("a")
    dies(storage, dead, **(told if "host" in told else {"pid": ended_process()}))
    with ThreadPoolExecutor(2) as threads:
        assert sum(threads.map(lambda one: one.claim("a"), [heir, other])) == 1
    owner = heir if heir.claim("a") else other
    owner.release("a")
    assert storage.files(".batch/claims") == {}


class Meanwhile:
    """A storage in which something happens before the first file is created."""

    def __init__(self, storage, happens):
        self._storage, self._happens = storage, [happens]

    def __getattr__(self, name):
        return getattr(self._storage, name)

    def create(self, path, data):
        while self._happens:
            self._happens.pop()()
        return self._storage.create(path, data)


def test_a_claim_of_the_dead_that_another_has_taken_and_renewed_meanwhile(session, storage):
    dead, slow, other = session(), session(), session()
    assert dead.claim("a")
    dies(storage, dead, pid=ended_process())

    def renew():
        assert other.claim("a")
        other.release("a")
        assert other.claim("a")

    slow._storage = Meanwhile(storage, renew)
    assert not slow.claim("a") and other.claim("a")
    other.release("a")
    assert storage.files(".batch/claims") == {}


def test_a_claim_that_could_not_be_checked_is_given_back(session, storage, monkeypatch):
    first, answers = session(), ["claims that were found"]
    claims = first._claims

    def ask(name):
        if not answers:
            raise OSError("no answer")
        answers.pop()
        return claims(name)

    monkeypatch.setattr(first, "_claims", ask)
    with pytest.raises(OSError, match="no answer"):
        first.claim("a")
    assert session().claim("a")


def test_a_batch_of_another_machine_is_alive_for_a_while(session, storage):
    far, near = session(), session()
    assert far.claim("a")
    dies(storage, far, host="elsewhere", pid=ended_process())
    assert not near.claim("a")


def test_what_an_ended_batch_had_claimed_is_free(session):
    first, second = session(), session()
    assert first.claim("a")
    first.end()
    assert second.claim("a")
