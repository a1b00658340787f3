import shutil

import cv2
import numpy as np

from splatart_ns.capture.contact_sheet import MOST_TILES, write_contact_sheet
from splatart_ns.capture.examination import examine

RED, ORANGE, BLUE = (60, 60, 235), (40, 165, 255), (235, 170, 60)


def pixels(sheet, colour):
    return int((cv2.imread(str(sheet)) == np.array(colour)).all(axis=2).sum())


def test_problems_and_suggestions_are_framed(hinge_capture, tmp_path):
    capture = shutil.copytree(hinge_capture, tmp_path / "capture")
    examination = examine(capture)
    write_contact_sheet(tmp_path / "sound.png", examination.capture, examination.problems)
    assert [pixels(tmp_path / "sound.png", colour) for colour in (RED, ORANGE, BLUE)] == [0, 0, 0]

    (capture / "state_00/images/0001.png").write_bytes(b"no picture")
    labels = capture / "state_01/semantics/0005.png"
    assert cv2.imwrite(str(labels), np.roll(cv2.imread(str(labels), cv2.IMREAD_UNCHANGED), 6, axis=1))
    examination = examine(capture)
    suggested = examination.capture.states[0].frames[3:4]
    write_contact_sheet(tmp_path / "sheet.png", examination.capture, examination.problems, suggested)
    frame = 4 * 160 * 3  # pixels of a border, about
    assert all(pixels(tmp_path / "sheet.png", colour) > 0.9 * frame for colour in (RED, ORANGE, BLUE))


def test_of_many_frames_some_are_shown(capture_folder, tmp_path, monkeypatch):
    monkeypatch.setattr("splatart_ns.capture.contact_sheet.MOST_TILES", 4)
    examination = examine(capture_folder)
    write_contact_sheet(tmp_path / "few.png", examination.capture, ())
    monkeypatch.setattr("splatart_ns.capture.contact_sheet.MOST_TILES", MOST_TILES)
    write_contact_sheet(tmp_path / "all.png", examination.capture, ())
    few, every = (cv2.imread(str(tmp_path / name)).shape for name in ("few.png", "all.png"))
    assert few[1] == every[1] and few[0] < every[0]


def test_check_writes_the_sheet_and_json(run_main, hinge_capture, tmp_path):
    code, output, _ = run_main("check", hinge_capture, "--json", "--sheet", tmp_path / "sheet.png")
    assert code == 0 and output.startswith('{\n "errors": 0')
    assert cv2.imread(str(tmp_path / "sheet.png")) is not None
    code, _, errors = run_main("check", hinge_capture, "--sheet", tmp_path / "sheet.txt")
    assert code == 2 and "give 0 or more frames, and a .png file" in errors
