"""How far the estimated part poses are from the true ones (docs/metrics.md, parts)."""

from __future__ import annotations

from typing import Any

import torch

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.evaluation.ground_truth import GroundTruth
from splatart_ns.evaluation.joints import rotation_error
from splatart_ns.geometry.se3 import transform_points


def part_pose_errors(ground_truth: GroundTruth, bundle: Bundle) -> list[dict[str, Any]]:
    """A record per part but the root and per state but the first; nulls where the estimate lacks the part or the root.

    Errors of the motion relative to the true root part. The translation error is taken at the centroid of the part's
    true points, so that it does not depend on where the world's origin lies.
    """
    motions = {part.id: part.motion for part in bundle.parts}
    records = []
    for part, name in ground_truth.parts.items():
        if part == ground_truth.root:
            continue
        known = part in motions and ground_truth.root in motions
        truth = torch.linalg.solve(ground_truth.motions[ground_truth.root], ground_truth.motions[part])
        centroid = ground_truth.points[part].mean(0)[None]
        for state, state_name in enumerate(bundle.states[1:], start=1):
            record: dict[str, Any] = {
                "name": name,
                "state": state_name,
                "part_rotation": None,
                "part_translation": None,
            }
            if known:
                T = torch.linalg.solve(motions[ground_truth.root][state], motions[part][state])
                shift = transform_points(T, centroid) - transform_points(truth[state], centroid)
                record["part_rotation"] = float(rotation_error(T[:3, :3], truth[state, :3, :3]))
                record["part_translation"] = float(shift.norm())
            records.append(record)
    return records
