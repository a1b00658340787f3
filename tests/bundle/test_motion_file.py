import json

import pytest
import torch

from splatart_ns.bundle import save_bundle
from splatart_ns.bundle.motion_file import read_motions
from splatart_ns.errors import InputError


def test_the_motions_of_a_bundle_are_read_in_the_order_asked_for(bundle, tmp_path):
    save_bundle(bundle, tmp_path)
    T = read_motions(tmp_path / "articulation.json", ["latch", "base", "door"], 2)
    assert T.shape == (2, 3, 4, 4)
    assert torch.allclose(T[:, 2], bundle.part("door").motion)


@pytest.mark.parametrize(
    ("names", "states", "word"), [(["base", "door", "latch", "wheel"], 2, "wheel"), (["base", "door", "latch"], 3, "")]
)
def test_motions_of_another_capture_are_refused(bundle, tmp_path, names, states, word):
    save_bundle(bundle, tmp_path)
    with pytest.raises(InputError, match=word):
        read_motions(tmp_path / "articulation.json", names, states)


@pytest.mark.parametrize("off, taken", [(1e-9, True), (1e-3, False)])
def test_motions_count_from_state_0(tmp_path, off, taken):
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    T[0, 0, 3] = off
    path = tmp_path / "motions.json"
    path.write_text(json.dumps({"parts": [{"name": "base", "motion": T.tolist()}]}))
    if taken:
        assert torch.equal(read_motions(path, ["base"], 2)[0, 0], torch.eye(4, dtype=torch.float64))
    else:
        with pytest.raises(InputError, match="identity"):
            read_motions(path, ["base"], 2)


def test_a_file_that_holds_something_else_is_refused(tmp_path):
    path = tmp_path / "motions.json"
    path.write_text(json.dumps({"parts": [{"name": "base", "motion": [[1, 2], [3, 4]]}]}))
    with pytest.raises(InputError, match="motions.json"):
        read_motions(path, ["base"], 2)
