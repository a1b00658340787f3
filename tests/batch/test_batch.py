"""Objects as chains of stages: what is run, what is kept, what fails."""

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from stub_recipe import StubRecipe

from splatart_ns.batch import batch, storage
from splatart_ns.batch.batch import run_batch
from splatart_ns.batch.entry import Entry
from splatart_ns.batch.pool import ProcessPool
from splatart_ns.batch.storage import Folder
from splatart_ns.errors import InputError

STAGES = ["look", "copy one", "copy two", "join"]


def joined(folder):
    return {file.parent.name: file.read_text() for file in folder.glob("*/joined.txt")}


def test_every_object_goes_through_all_stages_in_order(run, captures, log, tmp_path):
    told = run(captures("a", "b", "c"))
    assert told.status() == {"a": "done", "b": "done", "c": "done"}
    assert joined(tmp_path / "out")["b"] == "ONE OF B TWO OF B"
    for name in "abc":
        ran = [line.removeprefix(f"{name} ") for line in log() if line.startswith(f"{name} ")]
        assert sorted(ran) == sorted(STAGES) and (ran[0], ran[-1]) == ("look", "join")
    assert told.rows["a"]["fresh"] and set(told.rows["a"]["stages"]) == set(STAGES)
    assert told.rows["a"]["seconds"] == pytest.approx(sum(told.rows["a"]["stages"].values()), abs=0.02)


def test_a_second_run_does_nothing_and_tells_the_same(run, captures, log):
    entries = captures("a", "b")
    first = run(entries)
    before = log()
    second = run(entries)
    assert log() == before and second.stages == []
    assert not any(row["fresh"] for row in second.rows.values())
    assert {name: row | {"fresh": True} for name, row in second.rows.items()} == first.rows


def test_what_changed_is_done_again_and_nothing_else(run, captures, log, tmp_path):
    entries = captures("a", "b")
    run(entries)
    done = len(log())
    (tmp_path / "captures/a/two").write_text("other")
    run(entries)
    assert sorted(log()[done:]) == ["a copy two", "a join", "a look"]
    assert joined(tmp_path / "out") == {"a": "ONE OF A OTHER", "b": "ONE OF B TWO OF B"}

    done = len(log())
    os.utime(tmp_path / "captures/a/one", (1, 1))  # touched, but the same
    run(entries)
    assert log()[done:] == ["a look"]

    done = len(log())
    run([entries[0], replace(entries[1], settings={"root": "one"})])
    assert log()[done:] == ["b join"]


def test_a_marker_of_a_version_before_still_counts(run, captures, tmp_path):
    entries = captures("a")
    run(entries)
    for marker in (tmp_path / "out/a/stages").iterdir():
        marker.write_text(json.dumps(json.loads(marker.read_text()) | {"cpu_seconds": 0.25}))
    assert run(entries).stages == []


def test_a_result_that_was_damaged_is_made_again(run, captures, log, tmp_path):
    entries = captures("a")
    run(entries)
    done = len(log())
    (tmp_path / "out/a/joined.txt").write_text("ONE")
    (tmp_path / "out/a/stages/copy one.json").write_text("{")
    run(entries)
    assert log()[done:] == ["a copy one", "a join"]
    assert joined(tmp_path / "out") == {"a": "ONE OF A TWO OF A"}


@pytest.mark.parametrize(
    ("do", "reason"),
    [
        ("mistake", "bad: cannot be fitted; mend it."),
        ("crash", "ZeroDivisionError: by zero"),
        ("die", "the process was ended by SIGKILL (was there too little memory?)"),
        ("leave half", "OSError: no space left"),
    ],
)
@pytest.mark.parametrize("at", ["look", "copy"])
def test_a_failure_stops_nothing_else_and_its_reason_is_told(run, captures, tmp_path, do, reason, at):
    told = run([*captures("bad", do=do, at=at), *captures("a", "b")])
    assert told.status() == {"bad": "failed", "a": "done", "b": "done"}
    assert told.rows["bad"]["reason"] == reason
    assert told.rows["bad"]["stage"].split()[0] == at
    assert not (tmp_path / "out/bad/copies").exists()


def test_a_failure_is_not_tried_again_unless_asked_or_mended(run, captures, log, tmp_path):
    entries = captures("bad", do="crash") + captures("a")
    run(entries)
    done = len(log())
    again = run(entries)
    assert again.stages == [] and again.rows["bad"]["reason"] == "ZeroDivisionError: by zero"
    retried = run(entries, retry_failed=True)
    assert retried.stages == [("bad", "join")] and retried.status()["bad"] == "failed"
    (tmp_path / "captures/bad/one").write_text("mended")
    mended = run([replace(entries[0], settings={}), entries[1]])
    assert mended.status() == {"bad": "done", "a": "done"}
    assert sorted(log()[done:]) == ["bad copy one", "bad join", "bad look"]


def test_a_process_that_was_killed_once_does_it_when_asked_again(run, captures, tmp_path):
    entries = captures("bad", do="die once", flag=str(tmp_path / "flag")) + captures("a")
    assert run(entries).status() == {"bad": "failed", "a": "done"}
    assert run(entries, retry_failed=True).status() == {"bad": "done", "a": "done"}


def test_a_capture_that_is_not_there_is_told(run, captures, tmp_path):
    told = run([Entry("none", str(tmp_path / "nowhere")), *captures("a")])
    assert told.status() == {"none": "failed", "a": "done"}
    assert "nowhere" in told.rows["none"]["reason"]


def test_stages_run_with_one_thread_each(run, captures, tmp_path):
    run(captures("a"))
    outcome = json.loads((tmp_path / "out/a/stages/copy one.json").read_text())["outcome"]
    assert outcome == {"threads": "1", "gpu": ""}


def test_stages_for_a_gpu_run_where_there_is_one(run, captures, tmp_path):
    told = run(captures("a", "b"), recipe=StubRecipe(gpu=True), engine=ProcessPool(2, 4000, {"0": 16000}))
    assert told.status() == {"a": "done", "b": "done"}
    for marker in (tmp_path / "out").glob("*/stages/copy*.json"):
        assert json.loads(marker.read_text())["outcome"]["gpu"] == "0"


def test_an_output_folder_that_cannot_be_written_is_a_mistake(run, captures, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file/out: cannot be written"):
        run(captures("a"), tmp_path / "file/out")


class Unanswered:
    """A storage that does not answer the first `times` requests that `asked` picks by their names and paths."""

    def __init__(self, storage, asked, times):
        self._storage, self._asked, self.left = storage, asked, times
        self.url = storage.url

    def __getattr__(self, name):
        def answer(path, *more):
            if self.left and self._asked(name, path):
                self.left -= 1
                raise OSError("no answer")
            return getattr(self._storage, name)(path, *more)

        return answer


REQUESTS = {
    "claim": lambda name, path: (name, path) == ("create", ".batch/claims/bad.1"),
    "listing": lambda name, path: (name, path) == ("files", "bad"),
    "marker of a death": lambda name, path: (name, path) == ("write", "bad/stages/join.json"),
    "release": lambda name, path: (name, path) == ("remove", ".batch/claims/bad.1"),
    "end": lambda name, path: name == "remove" and path.startswith(".batch/sessions/"),
}


@pytest.mark.parametrize("what", REQUESTS)
@pytest.mark.parametrize("times", [1, 10**6])
def test_requests_without_an_answer_end_their_own_object_at_most(run, captures, monkeypatch, tmp_path, what, times):
    looked = tmp_path / "out/bad/stages/look.json"  # until then listings are those of an object that is opened
    out = Unanswered(
        Folder(str(tmp_path / "out")),
        lambda *request: REQUESTS[what](*request) and (what != "listing" or looked.exists()),
        times,
    )
    monkeypatch.setattr(batch, "open_storage", lambda url: out)
    monkeypatch.setattr(storage, "_PAUSES", (0.0, 0.0))
    dies = what == "marker of a death"
    told = run([*captures("bad", **({"do": "die"} if dies else {})), *captures("a", "b")])
    assert out.left < times
    lost = times > 1 and what in ("claim", "listing")
    assert told.status() == {"bad": "failed" if lost or dies else "done", "a": "done", "b": "done"}
    if lost:
        assert told.rows["bad"]["reason"] == "no answer"
    if dies:
        assert "SIGKILL" in told.rows["bad"]["reason"]
        assert (tmp_path / "out/bad/stages/join.json").exists() == (times == 1)


DRIVER = """
import sys
from unittest.mock import Mock
from stub_recipe import StubRecipe
from splatart_ns.batch.batch import run_batch
from splatart_ns.batch.entry import Entry
from splatart_ns.batch.pool import ProcessPool
captures, out, log, *names = sys.argv[1:]
entries = [Entry(name, f"{captures}/{name}") for name in names]
if __name__ == "__main__":
    run_batch(entries, out, StubRecipe(log, seconds=0.03), ProcessPool(2, 4000, {}), Mock())
"""


@pytest.fixture
def start_driver(tmp_path):
    """Starts a batch as a process of its own."""
    script = tmp_path / "driver.py"
    script.write_text(DRIVER)
    started = []

    def start(entries):
        names = [entry.name for entry in entries]
        arguments = [tmp_path / "captures", tmp_path / "out", tmp_path / "log", *names]
        path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
        process = subprocess.Popen([sys.executable, script, *arguments], env={**os.environ, "PYTHONPATH": path})
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()


def test_killed_at_random_it_goes_on_where_it_was(start_driver, captures, run, log, tmp_path):
    """Three times kill -9, then the same command: no stage that was finished runs twice."""
    entries = captures(*(f"object {number}" for number in range(12)))
    chance, most = random.Random(0), 0
    for _ in range(3):
        process = start_driver(entries)
        seen = len(log())
        while process.poll() is None and len(log()) < seen + 4:
            time.sleep(0.005)
        time.sleep(chance.uniform(0, 0.1))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        most += 2  # stages whose marker may not have been written: one a process
        time.sleep(0.3)  # until the processes of the dead driver have ended, too
    killed = log()
    assert 12 <= len(killed) < 48
    marked = [
        f"{marker.parents[1].name} {marker.stem}"
        for marker in (tmp_path / "out").glob("*/stages/*.json")
        if not json.loads(marker.read_text()).get("failed")
    ]
    told = run(entries)
    assert set(told.status().values()) == {"done"}
    again = log()[len(killed) :]
    assert not set(again) & set(marked)
    assert sorted(again + marked) == sorted(f"object {n} {stage}" for n in range(12) for stage in STAGES)
    assert len(killed) - len(set(killed)) <= most
    assert joined(tmp_path / "out") == {f"object {n}": f"ONE OF OBJECT {n} TWO OF OBJECT {n}" for n in range(12)}


def test_its_processes_end_with_it(start_driver, captures, log, tmp_path):
    process = start_driver(captures(*(f"object {number}" for number in range(50))))
    while len(log()) < 5:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    time.sleep(1)
    ran = log()
    time.sleep(0.5)
    assert log() == ran


def test_two_batches_at_once_share_the_work(captures, recorder, tmp_path, log):
    entries = captures(*(f"object {number}" for number in range(20)))
    told = [recorder(), recorder()]
    recipe = StubRecipe(str(tmp_path / "log"), seconds=0.05)  # longer in all than a process takes to start
    threads = [
        threading.Thread(
            target=run_batch, args=(entries, str(tmp_path / "out"), recipe, ProcessPool(1, 4000, {}), recorded)
        )
        for recorded in told
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(set(recorded.status().values()) == {"done"} and len(recorded.rows) == 20 for recorded in told)
    assert sorted(log()) == sorted(f"object {n} {stage}" for n in range(20) for stage in STAGES)
    assert all(recorded.stages for recorded in told)


def test_two_batches_with_other_settings_leave_whole_objects(captures, recorder, tmp_path):
    entries = captures(*(f"object {number}" for number in range(6)))
    recipe = StubRecipe(seconds=0.01)
    threads = []
    for seed in (0, 1):
        mine = [replace(entry, settings={"seed": seed, "root": str(seed)}) for entry in entries]
        arguments = (mine, str(tmp_path / "out"), recipe, ProcessPool(1, 4000, {}), recorder())
        threads.append(threading.Thread(target=run_batch, args=arguments))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(joined(tmp_path / "out")) == 6
    for entry in entries:
        stages = {
            name: json.loads((tmp_path / "out" / entry.name / f"stages/{name}.json").read_text()) for name in STAGES
        }
        seed = int(stages["join"]["outcome"]["root"])
        keys = {
            stage.name: stage.key
            for stage in recipe.stages(
                replace(entry, settings={"seed": seed, "root": str(seed)}), "", stages["look"]["outcome"]
            )
        }
        assert all(stages[name]["key"] == keys[name] for name in STAGES[1:])  # all of one batch


def test_captures_and_bundles_in_an_object_store(object_store, captures, run, log, tmp_path):
    import fsspec

    entries = captures("a", "b")
    store = fsspec.filesystem("s3")
    store.put(str(tmp_path / "captures"), "bucket/captures", recursive=True)
    remote = [Entry(entry.name, f"{object_store}/captures/{entry.name}") for entry in entries]
    out = f"{object_store}/out"
    assert set(run(remote, out).status().values()) == {"done"}
    assert store.cat_file("bucket/out/b/joined.txt") == b"ONE OF B TWO OF B"
    done = len(log())
    store.pipe_file("bucket/captures/a/two", b"other")
    assert set(run(remote, out).status().values()) == {"done"}
    assert sorted(log()[done:]) == ["a copy two", "a join", "a look"]
    assert store.cat_file("bucket/out/a/joined.txt") == b"ONE OF A OTHER"
    assert store.find("bucket/out/.batch/claims") == []
