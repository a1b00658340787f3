"""Manifests and the notes that batches leave for each other, whatever is in them. `make fuzz` tries more of it."""

import json
import math
import os
import re
import tempfile
from pathlib import Path

import pytest
from fuzzing import damaged_bytes, damaged_json, fuzzed, one_sentence
from hypothesis import given
from hypothesis import strategies as st
from stub_recipe import StubRecipe

from splatart_ns.batch.batch import run_batch
from splatart_ns.batch.claim import Session
from splatart_ns.batch.entry import Entry, read_entries
from splatart_ns.batch.fitting import Fitting
from splatart_ns.batch.report import Report
from splatart_ns.batch.shards import find_bundles
from splatart_ns.batch.storage import Folder, open_storage
from splatart_ns.errors import InputError
from splatart_ns.shape import has_shape

SETTINGS = {"quality": "standard", "root": None, "seed": 0, "downscale": None, "joints": []}
CSV = "path,name,quality,root,seed,downscale,joints\ncaps/a,,,,,,\n/b,bee,draft,base,7,2,lid:base=revolute; knob:lid\n"
ROW = {"path": "b", "name": "x/y", "quality": "high", "root": "base", "seed": 3, "downscale": 2, "joints": ["lid:base"]}


def sound(entries):
    for entry in entries:
        assert entry.name and not os.path.isabs(entry.name) and ".." not in entry.name.split("/")
        assert set(entry.settings) == set(SETTINGS) and entry.settings["quality"] in ("draft", "standard", "high")
        assert type(entry.settings["seed"]) is int and all(isinstance(j, str) for j in entry.settings["joints"])
    assert len({entry.name.casefold() for entry in entries}) == len(entries) > 0


@given(data=damaged_bytes(CSV.encode()))
@fuzzed
def test_any_csv_manifest(tmp_path, data):
    (tmp_path / "list.csv").write_bytes(data)
    if (entries := one_sentence(read_entries, str(tmp_path / "list.csv"), SETTINGS)) is not None:
        sound(entries)


@given(rows=st.lists(damaged_json(ROW), min_size=1, max_size=3))
@fuzzed
def test_any_json_manifest(tmp_path, rows):
    (tmp_path / "list.jsonl").write_bytes(b"\n".join(rows))
    if (entries := one_sentence(read_entries, str(tmp_path / "list.jsonl"), SETTINGS)) is not None:
        sound(entries)


@pytest.fixture
def done(captures, recorder, tmp_path):
    """A batch of one object that has ended: its entries, and the markers by their files."""
    entries = captures("a")
    run_batch(entries, str(tmp_path / "out"), StubRecipe(), InProcess(), recorder())
    return entries, {file: file.read_bytes() for file in sorted((tmp_path / "out/a/stages").iterdir())}


class InProcess:
    """An engine that does a stage at once."""

    def __init__(self):
        self.ended = []

    def fits(self, needs):
        return not self.ended

    def start(self, ticket, needs, function, *arguments):
        self.ended.append((ticket, function(*arguments)))

    def wait(self, seconds):
        ended, self.ended = self.ended, []
        return ended

    def close(self):
        pass


@given(data=st.data())
@fuzzed
def test_any_marker_of_a_stage(done, recorder, tmp_path, data):
    """A damaged one counts as none: its stage is done again, and the batch ends well."""
    entries, markers = done
    for file, content in markers.items():
        file.write_bytes(content)
    file = data.draw(st.sampled_from(list(markers)))
    file.write_bytes(data.draw(damaged_json(json.loads(markers[file]))))
    told = recorder()
    run_batch(entries, str(tmp_path / "out"), StubRecipe(), InProcess(), told, retry_failed=True)
    assert told.status() == {"a": "done"} and math.isfinite(told.rows["a"]["seconds"])


@given(data=st.data())
@fuzzed
def test_any_summary_makes_a_report(data):
    """What a marker tells of a bundle is shown as text, or not at all."""
    recipe, hostile = Fitting(), "<script>alert(1)</script>"
    joint = {"name": "j", "type": "revolute", "parent": hostile, "child": "b", "residual": 0.1, "ambiguous": False}
    summary = {"parts": [hostile, "b"], "root": "b", "states": 2, "length_unit": hostile, "gaussians": 9, "movable": 1}
    summary |= {"joints": [joint | {"axis_deviation": None}], "unattached": 0, "notes": [hostile]}
    summary |= {"thumbnails": [hostile], "status": hostile}
    told = json.loads(data.draw(damaged_json(summary).filter(is_json)))
    if not has_shape(told, recipe.outcome_shape("summary")):
        return
    entry = Entry("a", "/captures/\udcff", SETTINGS)
    row = {"name": "a", "capture": entry.capture, "status": "done", "stage": "", "reason": "", "seconds": 1.0}
    with tempfile.TemporaryDirectory() as folder:
        report = Report([entry])
        report.add(0, row | {"stages": {}} | recipe.row(entry, {"summary": told}))
        report.write(open_storage(folder))
        assert "<script>alert" not in Path(folder, "report.html").read_text()


def is_json(data):
    try:
        return json.loads(data) is not None
    except ValueError:
        return False


SESSION = "0123456789abcdef" * 2
HOLDERS = [b"../../../secret", b"", b"\xff\xfe", b"\0", b"a" * 5000, b"/etc/passwd", b"../sessions/" + SESSION.encode()]


@given(data=st.data())
@fuzzed
def test_any_claim_and_sign_of_life(tmp_path, monkeypatch, data):
    """What is damaged holds nobody up, and nothing but a session's file is opened."""
    opened = []
    read = Folder.read
    monkeypatch.setattr(Folder, "read", lambda self, path: [opened.append(path), read(self, path)][1])
    out = open_storage(str(tmp_path / "out"))
    session = Session(out)
    try:
        told = {"host": "elsewhere", "pid": 1, "time": 9e9}
        out.write(f".batch/sessions/{SESSION}.json", data.draw(damaged_json(told)))
        out.write(".batch/claims/a.1", data.draw(damaged_bytes(SESSION.encode()) | st.sampled_from(HOLDERS)))
        if session.claim("a"):
            session.release("a")
    finally:
        session.end()
        out.remove(".batch/claims/a.1")
        monkeypatch.undo()
    assert all(re.fullmatch(r"\.batch/(claims/a\.\d|sessions/[0-9a-f]{32}\.json)", path) for path in opened)


@pytest.mark.parametrize("kind", ["pipe", "folder", "link in a circle", "link to nowhere"])
def test_what_is_no_file_is_neither_read_nor_found(tmp_path, kind):
    make = {"pipe": os.mkfifo, "folder": os.mkdir, "link in a circle": lambda f: os.symlink(f, f)}
    make.get(kind, lambda f: os.symlink(tmp_path / "gone", f))(tmp_path / "odd")
    storage = open_storage(str(tmp_path))
    assert storage.read("odd") is None and storage.files("") == {} and storage.children("")[1] == []


def test_folders_deep_in_one_another_are_one_sentence(tmp_path):
    tmp_path.joinpath(*"a" * 200).mkdir(parents=True)
    with pytest.raises(InputError, match="lies too deep"):
        read_entries(str(tmp_path), SETTINGS)
    with pytest.raises(InputError, match="there is no bundle"):
        find_bundles(str(tmp_path))


def test_a_text_of_json_may_hold_other_ends_of_lines(tmp_path):
    (tmp_path / "list.jsonl").write_text('{"path": "a\u2028b", "name": "a"}\n', encoding="utf-8")
    assert read_entries(str(tmp_path / "list.jsonl"), SETTINGS)[0].capture.endswith("a\u2028b")
