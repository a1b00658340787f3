import importlib.util
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_capture import SIZE, write_state

from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_labels
from splatart_ns.capture.label_import import import_labels
from splatart_ns.capture.segmenter import Prompt, Sam, segment
from splatart_ns.errors import InputError

FRAME = "state_00/images/0001.png"


@pytest.fixture
def capture(tmp_path):
    for k in range(2):
        write_state(tmp_path / f"capture/state_{k:02d}")
    return load_capture(tmp_path / "capture")


def write_prompts(tmp_path, content):
    file = tmp_path / "prompts.json"
    file.write_text(json.dumps(content))
    return file


def boxes(image, prompts):
    """Logits of the boxes' own size: the smaller box is surer."""
    logits = np.full((len(prompts), *image.shape[:2]), -1.0)
    for k, prompt in enumerate(prompts):
        left, top, right, bottom = map(int, prompt.box)
        logits[k, top:bottom, left:right] = 1 / ((right - left) * (bottom - top))
    return logits


def test_labels_of_prompts_are_taken_back_by_the_import(capture, tmp_path):
    asked = {FRAME: {"base": {"box": [2, 2, 12, 12]}, "knob": {"box": [4, 4, 6, 8]}}}
    done = segment(capture, write_prompts(tmp_path, asked), tmp_path / "out", boxes)
    assert done == 1
    result = import_labels(capture.path, tmp_path / "out")
    assert result.labelled == 1 and result.parts == ("base", "door", "knob")
    frame = next(f for f in load_capture(capture.path).states[0].frames if f.name == "images/0001.png")
    expected = np.zeros((SIZE, SIZE), np.uint8)
    expected[2:12, 2:12] = 1
    expected[4:8, 4:6] = 3
    assert (read_labels(frame.labels) == expected).all()


def test_images_that_differ_in_their_suffix_alone_have_masks_of_their_own(capture, tmp_path):
    file = capture.path / "state_00/transforms.json"
    meta = json.loads(file.read_text())
    first, second = meta["frames"][:2]
    twin = Path(first["file_path"]).with_suffix(".jpg")
    image = cv2.imread(str(file.parent / second["file_path"]))
    cv2.imwrite(str(file.parent / twin), image)
    meta = json.loads(file.read_text().replace(second["file_path"], str(twin)))
    file.write_text(json.dumps(meta))
    capture = load_capture(capture.path)
    names = {f"state_00/{path}": side for path, side in ((first["file_path"], 4), (str(twin), 8))}
    asked = {name: {"door": {"box": [2, 2, 2 + side, 2 + side]}} for name, side in names.items()}
    assert segment(capture, write_prompts(tmp_path, asked), tmp_path / "out", boxes) == 2
    assert import_labels(capture.path, tmp_path / "out").labelled == 2
    for frame in load_capture(capture.path).states[0].frames:
        if side := names.get(f"state_00/{frame.name}"):
            assert (read_labels(frame.labels) == 2).sum() == side**2


@pytest.mark.parametrize(
    "content, words",
    [
        ({}, "no prompts"),
        ({"images/0001.png": {"a": {"points": [[1, 1]]}}}, "is no frame"),
        ({FRAME: {}}, "write"),
        ({FRAME: {"a": {"points": [[1, 99]]}}}, "16x16"),
        ({FRAME: {"a": {"points": [[1]]}}}, "2 numbers"),
        ({FRAME: {"a": {"points": [["x", 1]]}}}, "number"),
        ({FRAME: {"a": {"not": [[1, 1]]}}}, "no click"),
        ({FRAME: {"a": {"box": [5, 5, 4, 8]}}}, "left, top"),
        ({FRAME: {"a": {"clicks": [[1, 1]]}}}, "points"),
        ({FRAME: {"a,b": {"points": [[1, 1]]}}}, "commas"),
    ],
)
def test_prompts_that_make_no_sense_are_named(capture, tmp_path, content, words):
    with pytest.raises(InputError, match=words):
        segment(capture, write_prompts(tmp_path, content), tmp_path / "out", boxes)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(importlib.util.find_spec("transformers") is not None, reason="transformers is installed")
def test_without_transformers_one_sentence_says_what_to_install():
    with pytest.raises(InputError, match=r"pip install 'splatart-ns\[sam\]'"):
        Sam()


@pytest.fixture(scope="module")
def tiny_sam(tmp_path_factory):
    """A SAM of a few random weights."""
    transformers = pytest.importorskip("transformers")
    import torch

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("sam")
    vision = {"hidden_size": 16, "output_channels": 8, "num_hidden_layers": 1, "num_attention_heads": 2}
    vision |= {"image_size": 64, "patch_size": 8, "mlp_dim": 16, "window_size": 4, "global_attn_indexes": [0]}
    decoder = {"hidden_size": 8, "mlp_dim": 16, "num_attention_heads": 2, "num_hidden_layers": 1}
    decoder |= {"attention_downsample_rate": 1, "iou_head_hidden_dim": 8}
    config = transformers.SamConfig(
        vision_config=vision | {"num_pos_feats": 4},
        prompt_encoder_config={"hidden_size": 8, "image_size": 64, "patch_size": 8, "mask_input_channels": 4},
        mask_decoder_config=decoder,
    )
    transformers.SamModel(config).save_pretrained(folder)
    sizes = {"size": {"longest_edge": 64}, "pad_size": {"height": 64, "width": 64}}
    sizes |= {"mask_size": {"longest_edge": 16}, "mask_pad_size": {"height": 16, "width": 16}}
    transformers.SamProcessor(transformers.SamImageProcessor(**sizes)).save_pretrained(folder)
    return folder


def test_a_segmenter_of_transformers_answers_clicks_and_boxes_at_the_image_s_size(tiny_sam):
    image = np.random.default_rng(0).integers(0, 255, (48, 80, 3), dtype=np.uint8)
    click, box = Prompt(((10.0, 10.0),)), Prompt((), (), (5.0, 5.0, 40.0, 40.0))
    both = Prompt(((10.0, 10.0), (20.0, 30.0)), ((3.0, 3.0),), (5.0, 5.0, 40.0, 40.0))
    sam = Sam(str(tiny_sam))
    logits = sam(image, [click, box, both])
    assert logits.shape == (3, 48, 80) and np.isfinite(logits).all()
    assert not np.array_equal(logits[0], logits[1]) and not np.array_equal(logits[1], logits[2])
    assert np.array_equal(sam(image, [box])[0], logits[1])


def test_a_segmenter_that_is_not_there_is_said_how_to_get(tmp_path):
    pytest.importorskip("transformers")
    with pytest.raises(InputError, match="hf download"):
        Sam(str(tmp_path / "none"))
