"""How well the object is rendered from views that were never trained on (docs/metrics.md, images)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from splatart_ns.bundle.articulated_splat import predicted_parts
from splatart_ns.bundle.bundle import JOINT_DOFS, Bundle, Joint
from splatart_ns.bundle.posing import configured_motions, moved_splat, normalized, part_features
from splatart_ns.capture.capture import UNLABELLED, Capture
from splatart_ns.capture.view import View
from splatart_ns.evaluation.ground_truth import GroundTruth, NovelState, TrueJoint
from splatart_ns.evaluation.joints import find_joint
from splatart_ns.rasterize.render import render
from splatart_ns.rasterize.ssim import ssim
from splatart_ns.stages.silhouette import with_silhouette

KEYS = ("psnr", "ssim", "lpips", "accumulation_l1", "part_iou", "silhouette")


def psnr(a: Tensor, b: Tensor) -> float:
    """Peak signal-to-noise ratio of two images in 0..1, dB; infinite for equal ones."""
    mse = float((a - b).square().mean())
    return -10 * math.log10(mse) if mse > 0 else math.inf


def part_overlap(ids: Tensor, labels: Tensor, parts: Sequence[int]) -> Tensor:
    """Intersection and union [P, 2], in pixels, of each part in two id images; unlabelled pixels do not count."""
    labelled = labels != UNLABELLED
    pairs = [((ids == part) & labelled, labels == part) for part in parts]
    return torch.tensor([[int((a & b).sum()), int((a | b).sum())] for a, b in pairs])


def image_scores(
    bundle: Bundle,
    motions: Mapping[str, Tensor],
    views: Sequence[View],
    capture: Capture,
    device: torch.device | str = "cpu",
) -> tuple[dict[str, Any], list[str]]:
    """The scores of the object, its parts moved by `motions`, over views of a capture; and notes on nulls.

    Image scores are means over the views, on white: over those that say where the object ends, by alpha or labels;
    where none does, colours are compared within the silhouette that is rendered. `silhouette`: "given" or "rendered".
    What a view's mask leaves out does not count.
    A part's IoU counts the pixels of all labelled views together, and `part_iou` is the mean over the parts, of the
    capture or the bundle, that any of them shows or predicts.
    """
    scores: dict[str, Any] = dict.fromkeys(KEYS)
    notes = []
    known = [with_silhouette(view) for view in views]
    own = any(view is not None for view in known)
    splat = normalized(moved_splat(bundle, motions), capture.normalization).to(device)
    features, ids = part_features(bundle).to(device), torch.tensor([part.id for part in bundle.parts])
    white = torch.ones(3)
    per_view: dict[str, list[float]] = {"psnr": [], "ssim": [], "accumulation_l1": []}
    parts = sorted({*ids.tolist(), *capture.parts})
    overlap = torch.zeros(len(parts), 2, dtype=torch.long)
    for view, given in zip(views, known, strict=True):
        viewmat, K = view.viewmat[None].to(device), view.K[None].to(device)
        rendering = render(splat, viewmat, K, view.width, view.height, features=features, with_depth=False)
        accumulation = rendering.accumulation[0].cpu()
        if view.labels is not None:
            shown = predicted_parts(accumulation, rendering.features[0].cpu(), ids)
            overlap += part_overlap(shown, view.labels.long(), parts)
        shown = (255 * accumulation[..., 0]).round().to(torch.uint8)
        if given is None and (own or not shown.any()):
            continue
        image = (rendering.rgb[0].cpu() + (1 - accumulation) * white).clamp(0, 1)
        truth = (given or replace(view, alpha=shown)).rgb_on(white)
        counts = torch.ones_like(shown, dtype=torch.bool) if view.mask is None else view.mask
        if given is not None and view.alpha is None:  # labels may leave open whose a pixel is
            counts = counts & (view.labels != UNLABELLED)
        if not counts.any():
            continue
        truth = torch.where(counts[..., None], truth, image)
        per_view["psnr"].append(psnr(image[counts], truth[counts]))
        per_view["ssim"].append(float(ssim(image, truth)))
        if given is not None:
            wrong = (accumulation[..., 0] - given.alpha.float() / 255).abs()
            per_view["accumulation_l1"].append(float(wrong[counts].mean()))
    for key, values in per_view.items():
        scores[key] = sum(values) / len(values) if values else None
    seen = overlap[:, 1] > 0
    if seen.any():
        scores["part_iou"] = float((overlap[seen, 0] / overlap[seen, 1]).mean())
    else:
        notes.append("part_iou: no test view is labelled")
    if per_view["psnr"]:
        scores["silhouette"] = "given" if own else "rendered"
    if not own:
        notes.append(
            "psnr, ssim: no test view has a silhouette (alpha, object mask or labels); colours are compared within the "
            "rendered one, so that what is missing of the object, or too much, does not count"
            if per_view["psnr"]
            else "psnr, ssim: no test view shows the object"
        )
    return scores, notes


def novel_motions(bundle: Bundle, ground_truth: GroundTruth, novel: NovelState) -> dict[str, Tensor]:
    """T[part] [4, 4] of the estimate at the true joint values of an unseen configuration.

    A joint's value is the true change since state 0, with the sign under which estimate and truth moved alike between
    the observed states. Where the types differ the value goes as far along the observed travel as the true joint went.
    The root moves as the true part of its id does, which joint values do not tell.
    """
    ids = {part.name: part.id for part in bundle.parts}
    of_pair = {frozenset((joint.parent, joint.child)): joint for joint in ground_truth.joints}
    of_child = {joint.child: joint for joint in ground_truth.joints}
    q = {}
    for joint in bundle.tree_joints:
        truth = of_pair.get(frozenset((ids[joint.parent], ids[joint.child]))) or of_child.get(ids[joint.child])
        if truth is not None:
            q[joint.name] = mapped_value(joint, truth, novel.values[truth.name])
    root = novel.motions.get(ids[bundle.root], torch.eye(4, dtype=torch.float64))
    return {name: root @ T for name, T in configured_motions(bundle, q).items()}


def mapped_value(joint: Joint, truth: TrueJoint, change: float) -> Tensor:
    """The estimated joint's value(s) for a change of the true joint's value since state 0."""
    largest = int(truth.values.abs().argmax())
    travel = float(truth.values[largest])
    observed = joint.values[largest]
    if travel == 0:
        return torch.zeros_like(observed)
    if joint.type == truth.type:
        same_way = float(observed) * travel >= 0
        return torch.full_like(observed, change if same_way else -change)
    return observed * (change / travel)


def is_mapped(bundle: Bundle, ground_truth: GroundTruth) -> bool:
    """Whether every true joint has an estimated one of the same pair of parts and the same type.

    Of joints that carry nothing with a shape, or the root alone (a base without one), none is asked for.
    """
    names = {part.id: part.name for part in bundle.parts}
    for truth in ground_truth.joints:
        if truth.child in (None, ground_truth.root):
            continue
        pair = names.get(truth.parent), names.get(truth.child)
        joint = find_joint(bundle, *pair) if None not in pair else None
        if joint is None or not joint.in_tree or JOINT_DOFS[joint.type] != 1 or joint.type != truth.type:
            return False
    return True
