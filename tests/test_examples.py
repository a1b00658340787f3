"""The examples and the pages of docs/ that hold Python run as they stand."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]


def test_a_bundle_is_opened_and_looked_at(hinge_fit, tmp_path):
    script = ROOT / "examples/open_and_look.py"
    done = subprocess.run([sys.executable, script, hinge_fit, tmp_path], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("base_to_lid moves lid from")
    for name in ("colours", "labels", "depth"):
        steps = np.split(np.asarray(Image.open(tmp_path / f"{name}.png")).astype(int), 5, axis=1)
        assert np.abs(steps[0] - steps[-1]).mean() > 1
        assert all(np.ptp(step) > 100 for step in steps)


@pytest.mark.parametrize("arguments", [[], ["bundle"], ["bundle", "pictures", "more"], ["nowhere", "pictures"]])
def test_the_script_says_what_it_needs(arguments, tmp_path):
    script = ROOT / "examples/open_and_look.py"
    done = subprocess.run([sys.executable, script, *arguments], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode != 0 and not list(tmp_path.iterdir())
    assert done.stderr.count("\n") == 1 and ("usage: " in done.stderr or "nowhere" in done.stderr)


def test_the_page_on_python_runs(hinge_fit, hinge_capture, tmp_path, monkeypatch):
    (tmp_path / "OUT").symlink_to(hinge_fit)
    (tmp_path / "CAPTURE").symlink_to(hinge_capture)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/python.md").read_text(encoding="utf-8"), re.DOTALL)
    namespace = {}
    for block in blocks:
        exec(block, namespace)
    assert namespace["film"].rgb.shape == (5, 96, 128, 3)
    assert namespace["around"].rgb.shape == (3, 64, 64, 3)
    assert set(namespace["lid"].part_ids.unique().tolist()) == {0, 2}
    assert namespace["value"].grad < 0
    opened = namespace["obj"].joints["base_to_lid"].values[1]
    assert abs(namespace["fit"].q["base_to_lid"] - opened) < 0.03 and not namespace["fit"].unseen
    assert namespace["sample"].rgba.shape == (64, 64, 4)
