import json
import shutil

import cv2
import numpy as np
import pytest
from small_capture import give_another_world

from splatart_ns.bundle import load_bundle
from splatart_ns.bundle.rendered_labels import write_labels
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_labels
from splatart_ns.capture.label_import import import_labels
from splatart_ns.errors import InputError


@pytest.fixture
def sparse_capture(hinge_capture, tmp_path):
    """The hinge with labels in its first two training frames of each state alone."""
    capture = shutil.copytree(hinge_capture, tmp_path / "capture")
    for file in capture.glob("state_*/transforms.json"):
        meta = json.loads(file.read_text())
        for frame in meta["frames"][2:]:
            frame.pop("semantics_path")
        file.write_text(json.dumps(meta))
    return capture


def test_unlabelled_frames_get_the_parts_they_show_and_import_takes_them(
    hinge_fit, hinge_capture, sparse_capture, tmp_path
):
    capture, truth = load_capture(sparse_capture), load_capture(hinge_capture)
    done = write_labels(load_bundle(hinge_fit), capture, tmp_path / "out")
    assert len(done) == 2 * 12
    assert [one.doubtful for one in done] == sorted((one.doubtful for one in done), reverse=True)
    result = import_labels(sparse_capture, tmp_path / "out/labels")
    assert result.labelled == 24 and result.unmatched == () and list(result.parts) == list(truth.parts.values())
    overlap = np.zeros((3, 2))
    for state, true_state in zip(load_capture(sparse_capture).states, truth.states, strict=True):
        for frame, true_frame in zip(state.frames, true_state.frames, strict=True):
            labels, expected = read_labels(frame.labels), read_labels(true_frame.labels)
            for part in (1, 2):
                known = labels != 255
                a, b = (labels == part) & known, (expected == part) & known
                overlap[part] += (a & b).sum(), (a | b).sum()
    assert (overlap[1:, 0] / overlap[1:, 1] > 0.85).all()
    overlays = sorted((tmp_path / "out/overlays").rglob("*.jpg"))
    assert len(overlays) == 24 and cv2.imread(str(overlays[0])).shape == (64, 64, 3)


def test_states_with_worlds_of_their_own_have_the_same_labels(hinge_fit, sparse_capture, tmp_path):
    bundle = load_bundle(hinge_fit)
    write_labels(bundle, load_capture(sparse_capture), tmp_path / "shared")
    world = give_another_world(sparse_capture / "state_01")
    bundle.provenance["worlds"] = [np.eye(4).tolist(), np.linalg.inv(world).tolist()]
    write_labels(bundle, load_capture(sparse_capture), tmp_path / "own")
    for expected in (tmp_path / "shared/labels").rglob("*.png"):
        found = tmp_path / "own/labels" / expected.relative_to(tmp_path / "shared/labels")
        assert (read_labels(found) == read_labels(expected)).mean() > 0.999


def test_a_labelled_capture_and_another_capture_are_refused(hinge_fit, hinge_capture, sparse_capture, tmp_path):
    bundle = load_bundle(hinge_fit)
    with pytest.raises(InputError, match="every frame is labelled"):
        write_labels(bundle, load_capture(hinge_capture), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    bundle.parts[0].name = "another"
    with pytest.raises(InputError, match="other states or parts"):
        write_labels(bundle, load_capture(sparse_capture), tmp_path / "out")
