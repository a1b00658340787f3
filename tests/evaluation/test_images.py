import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatart_ns.bundle import configured_motions, joint_motion, normalized, observed_motions
from splatart_ns.capture.capture import UNLABELLED, Capture, Normalization
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.view import View, load_views
from splatart_ns.evaluation.images import image_scores, is_mapped, mapped_value, novel_motions, part_overlap, psnr

D = torch.float64


def test_psnr_of_a_tenth_is_20():
    assert psnr(torch.full((4, 4, 3), 0.6), torch.full((4, 4, 3), 0.5)) == pytest.approx(20, abs=1e-4)
    assert psnr(torch.ones(2, 2, 3), torch.ones(2, 2, 3)) == math.inf


def test_unlabelled_pixels_do_not_count():
    ids = torch.tensor([[1, 1, 2, 2]])
    labels = torch.tensor([[1, 255, 255, 1]])
    assert part_overlap(ids, labels, [1, 2, 3]).tolist() == [[1, 2], [0, 1], [0, 0]]


def test_a_splat_is_brought_to_the_normalised_world(bundle):
    splat = bundle.parts[0].splat
    out = normalized(splat, Normalization(np.array([1.0, 2.0, 3.0]), 0.5))
    torch.testing.assert_close(out.means, 0.5 * (splat.means - torch.tensor([1.0, 2.0, 3.0])))
    torch.testing.assert_close(out.scales, 0.5 * splat.scales)


def test_views_without_silhouettes_and_labels_that_do_not_show_the_object_score_null_and_say_so(bundle, tmp_path):
    away = torch.eye(4)
    away[2, 3] = -100
    view = View("v", away, torch.eye(3), 2, 2, torch.zeros(2, 2, 3, dtype=torch.uint8))
    scores, notes = image_scores(bundle, observed_motions(bundle, 0), [view], Capture(tmp_path, (), {}))
    assert set(scores.values()) == {None}
    assert len(notes) == 2


def test_images_are_compared_on_white(bundle, tmp_path):
    """Where nothing is rendered, what is white in the image is right and what is grey is not."""
    away = torch.eye(4)
    away[2, 3] = -100
    full = torch.full((4, 4), 255, dtype=torch.uint8)

    def score(value):
        rgb = torch.full((4, 4, 3), value, dtype=torch.uint8)
        view = View("v", away, torch.eye(3), 4, 4, rgb, alpha=full)
        return image_scores(bundle, observed_motions(bundle, 0), [view], Capture(tmp_path, (), {}))[0]["psnr"]

    assert score(255) == math.inf
    assert score(204) == pytest.approx(-20 * math.log10(0.2), abs=1e-3)


@pytest.fixture
def opaque_views(capture):
    """The test views of state 0 in front of grey, labelled and without an alpha."""
    views = load_views(load_capture(capture), load_capture(capture).states[0], "test")
    return [replace(view, rgb=(255 * view.rgb_on(torch.full((3,), 0.4))).byte(), alpha=None) for view in views]


def test_opaque_views_are_compared_within_the_rendered_silhouette_and_marked(bundle, capture, opaque_views):
    views = [replace(view, labels=None) for view in opaque_views]
    scores, notes = image_scores(bundle, observed_motions(bundle, 0), views, load_capture(capture))
    assert scores["psnr"] > 35 and scores["ssim"] > 0.98
    assert scores["silhouette"] == "rendered" and scores["accumulation_l1"] is None
    assert any("within the rendered one" in note for note in notes)


def test_labels_are_silhouettes_and_unlabelled_pixels_do_not_count(bundle, capture, opaque_views):
    labels = opaque_views[0].labels
    opaque_views[0] = replace(opaque_views[0], labels=torch.where(labels == 1, UNLABELLED, labels))
    views = [opaque_views[0], *(replace(view, labels=None) for view in opaque_views[1:])]
    scores, notes = image_scores(bundle, observed_motions(bundle, 0), views, load_capture(capture))
    assert scores["silhouette"] == "given" and notes == []
    assert scores["psnr"] > 20 and scores["accumulation_l1"] < 0.05
    nothing = replace(opaque_views[0], labels=torch.full_like(labels, UNLABELLED))
    with_it, _ = image_scores(bundle, observed_motions(bundle, 0), [nothing, *views], load_capture(capture))
    assert with_it["psnr"] == scores["psnr"] and with_it["accumulation_l1"] == scores["accumulation_l1"]
    bundle.parts[1].motion[0, :3, 3] += 0.3
    moved, _ = image_scores(bundle, observed_motions(bundle, 0), views, load_capture(capture))
    assert moved["psnr"] < scores["psnr"] - 3 and moved["accumulation_l1"] > 2 * scores["accumulation_l1"]


def test_what_a_mask_leaves_out_of_a_view_does_not_count(bundle, capture):
    views = load_views(load_capture(capture), load_capture(capture).states[0], "test")
    top = torch.arange(views[0].height)[:, None].expand(-1, views[0].width) < views[0].height // 2
    hand = [replace(v, rgb=v.rgb.where(~top[..., None], 9), alpha=v.alpha.where(~top, 255)) for v in views]
    kept, at_first = [replace(view, mask=~top) for view in hand], observed_motions(bundle, 0)
    spoilt, whole, masked = (image_scores(bundle, at_first, of, load_capture(capture))[0] for of in (hand, views, kept))
    assert spoilt["psnr"] < 20 < whole["psnr"] - 3 < masked["psnr"]
    assert masked["accumulation_l1"] < 1.5 * whole["accumulation_l1"] < spoilt["accumulation_l1"]
    nothing = [replace(view, mask=torch.zeros_like(top)) for view in views]
    assert image_scores(bundle, at_first, nothing, load_capture(capture))[0]["psnr"] is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_true_change_takes_the_sign_of_the_estimate(truth, bundle, sign):
    bundle.joints[0].values *= sign
    assert float(mapped_value(bundle.joints[0], truth.joints[0], 0.2)) == pytest.approx(sign * 0.2)


def test_another_type_goes_as_far_along_its_own_travel(truth, bundle):
    bundle.joints[0].type = "free"
    bundle.joints[0].values = torch.tensor([[0.0] * 6, [1.0, 2, 3, 4, 5, 6]], dtype=D)
    value = mapped_value(bundle.joints[0], truth.joints[0], 0.25)
    torch.testing.assert_close(value, torch.tensor([0.5, 1, 1.5, 2, 2.5, 3], dtype=D))


def test_a_joint_that_did_not_move_stays(truth, bundle):
    truth.joints[0].values.zero_()
    assert float(mapped_value(bundle.joints[0], truth.joints[0], 0.25)) == 0


@pytest.mark.parametrize("flip", ["axis", "direction", "nothing"])
def test_a_perfect_estimate_goes_where_the_truth_goes(truth, bundle, flip):
    if flip == "axis":
        for joint in bundle.joints:
            joint.axis, joint.values = -joint.axis, -joint.values
    if flip == "direction":
        # The same object with the door as the root: the world moves with the door.
        hinge = bundle.joints[0]
        hinge.parent, hinge.child, hinge.values = "door", "body", -hinge.values
        bundle.root = "door"
    motions = novel_motions(bundle, truth, truth.novel[0])
    for part in bundle.parts:
        torch.testing.assert_close(motions[part.name], truth.novel[0].motions[part.id])


def test_a_joint_on_another_parent_goes_as_far_as_the_true_one_of_its_child(truth, bundle):
    slide = bundle.joints[1]
    slide.parent = "body"
    motions = novel_motions(bundle, truth, truth.novel[0])
    torch.testing.assert_close(motions["latch"], joint_motion(slide, truth.novel[0].values["slide"]))


def test_the_root_moves_as_the_truth_says(truth, bundle):
    G = torch.eye(4, dtype=D)
    G[:3, 3] = torch.tensor([1.0, 2, 3])
    truth.novel[0].motions[1] = G
    q = {"hinge": 0.2, "slide": 0.1}
    for name, T in novel_motions(bundle, truth, truth.novel[0]).items():
        torch.testing.assert_close(T, G @ configured_motions(bundle, q)[name])


def test_joints_of_another_kind_are_not_mapped_exactly(truth, bundle):
    assert is_mapped(bundle, truth)
    bundle.joints[1].parent = "body"
    assert not is_mapped(bundle, truth)


def test_a_base_without_a_shape_and_what_carries_nothing_are_no_joints_of_another_kind(truth, bundle):
    hinge = truth.joints[0]
    base = replace(hinge, name="base", type="fixed", parent=None, parent_name="world", child=truth.root)
    mark = replace(hinge, name="mark", type="fixed", parent=hinge.child, child=None, child_name="frame")
    truth.joints[:] = [base, *truth.joints, mark]
    assert is_mapped(bundle, truth)
    truth.joints[1] = replace(hinge, parent=None, parent_name="a link without a shape")
    assert not is_mapped(bundle, truth)
