"""report.csv and report.html."""

import csv
import io
from html.parser import HTMLParser

import pytest
from rich.console import Console

from splatart_ns.batch import progress, storage
from splatart_ns.batch.entry import Entry
from splatart_ns.batch.progress import LiveProgress
from splatart_ns.batch.report import COLUMNS, Report
from splatart_ns.batch.storage import open_storage

EVIL = '<script>alert("x")</script>'
JOINT = {"name": "j", "type": "revolute", "residual": 0.002, "axis_deviation": 0.25, "ambiguous": True}


@pytest.fixture
def written(tmp_path):
    entries = [Entry(name, f"/captures/{name}") for name in ("a", EVIL, "never")]
    report = Report(entries)
    report.add(1, row(EVIL, status="failed", stage="pose", reason=f"of {EVIL} & more"))
    joints = [
        JOINT | {"parent": "base", "child": EVIL},
        JOINT | {"parent": "base", "child": "knob", "axis_deviation": None, "ambiguous": False},
    ]
    done = {"parts": ["base", EVIL, "knob"], "root": "base", "states": 2, "length_unit": "metre", "gaussians": 4321}
    done |= {"movable": 2, "unattached": 0, "failed_checks": ["urdf: mujoco"], "notes": [], "joints": joints}
    report.add(0, row("a", **done, thumbnails=["AAAA", "BBBB"]))
    report.write(open_storage(str(tmp_path)))
    return report, tmp_path


def row(name, status="done", stage="", reason="", **more):
    stages = {"check": 0.5, "pose": 12.25}
    row = {"name": name, "capture": f"/captures/{name}", "status": status, "stage": stage, "reason": reason}
    return row | {"seconds": 12.75, "stages": stages, "fresh": True} | more


class Page(HTMLParser):
    """Cells of the table, tags and where pictures come from."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.tags, self.sources = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.sources += [value for name, value in attributes if name in ("src", "href")]
        if tag == "tr":
            self.rows.append([])
        if tag == "td":
            self.rows[-1].append("")

    def handle_data(self, data):
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data


def test_the_csv_has_a_line_an_object_in_their_order(written):
    _, folder = written
    done, failed, never = csv.DictReader(io.StringIO((folder / "report.csv").read_text()))
    assert tuple(done) == COLUMNS
    assert (done["name"], done["status"], done["residual_worst"], done["axis_deviation_worst_deg"]) == (
        "a", "done", "0.002", "0.25",
    )  # fmt: skip
    assert done["joints"] == f"{EVIL}:base=revolute; knob:base=revolute" and done["ambiguous"] == "1"
    assert done["stage_seconds"] == "check: 0.5; pose: 12.25" and done["failed_checks"] == "urdf: mujoco"
    assert (failed["status"], failed["stage"], failed["reason"]) == ("failed", "pose", f"of {EVIL} & more")
    assert (never["name"], never["status"]) == ("never", "unfinished")


def test_the_page_has_a_row_an_object_and_needs_no_other_file(written):
    _, folder = written
    page = Page((folder / "report.html").read_text())
    done, failed, never = page.rows[1:]
    assert done[0] == "a" and "knob on base: revolute" in done[3] and "± 0.25°" in done[3]
    assert failed[0] == EVIL and f"of {EVIL} & more" in failed[-1]
    assert never[2] == "unfinished"
    assert len(page.sources) == 2 and all(source.startswith("data:image/jpeg;base64,") for source in page.sources)


def test_what_comes_from_outside_is_text(written):
    _, folder = written
    page = Page((folder / "report.html").read_text())
    assert page.tags.count("script") == 1  # its own
    assert "<script>alert" not in (folder / "report.html").read_text()


def test_counts_are_told(written):
    report, folder = written
    assert report.counts == {"done": 1, "failed": 1}
    assert "1 of 3 objects done, 1 failed, 1 unfinished." in (folder / "report.html").read_text()


def test_a_report_that_cannot_be_written_meanwhile_is_written_at_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "_REPORT_EVERY", 0.0)
    monkeypatch.setattr(storage, "_PAUSES", (0.0,))
    out = open_storage(str(tmp_path / "file/out"))
    (tmp_path / "file").touch()
    with LiveProgress([Entry("a", "/captures/a")], out, Console(file=io.StringIO())) as told:
        told.finished(0, row("a", status="failed", reason="why"))
        (tmp_path / "file").unlink()
    assert "why" in (tmp_path / "file/out/report.csv").read_text()
