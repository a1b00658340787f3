"""All metrics of a bundle against a capture, as `metrics.json` holds them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.folder import ARTICULATION, METRICS, load_bundle
from splatart_ns.bundle.posing import observed_motions
from splatart_ns.bundle.vantage import in_canonical_world
from splatart_ns.capture.capture import Capture, State
from splatart_ns.capture.digest import capture_identity, is_another
from splatart_ns.capture.formats import load_capture, load_novel
from splatart_ns.capture.view import load_views
from splatart_ns.errors import InputError
from splatart_ns.evaluation.geometry import SAMPLES, chamfer_centres, chamfer_mesh
from splatart_ns.evaluation.ground_truth import GroundTruth, load_ground_truth
from splatart_ns.evaluation.held_out import fitted_residuals, held_out_scores
from splatart_ns.evaluation.images import image_scores, is_mapped, novel_motions
from splatart_ns.evaluation.joints import joint_errors, mean_errors
from splatart_ns.evaluation.parts import part_pose_errors
from splatart_ns.evaluation.structure import structure_scores
from splatart_ns.files import require_writable, write_json
from splatart_ns.records import read_record


@torch.no_grad()
def evaluate(
    bundle_folder: Path, capture_path: Path, device: torch.device | str = "cpu", meshes: bool = True
) -> dict[str, Any]:
    """Score a bundle and write `metrics.json` into its folder; returns what the file holds. Renders on `device`.

    Without `meshes`, which take the most seconds, "geometry" has the figures of the Gaussians' centres alone. A capture
    without `ground_truth.json` gives image metrics only. Raises InputError for unusable input.
    """
    bundle_folder, capture_path = Path(bundle_folder), Path(capture_path)
    bundle = load_bundle(bundle_folder)
    require_writable(bundle_folder, "metrics.json goes there: evaluate a copy of the bundle")
    capture = load_capture(capture_path)
    if len(capture.states) != len(bundle.states):
        raise InputError(
            f"{bundle_folder / ARTICULATION}: has {len(bundle.states)} states but {capture_path} has "
            f"{len(capture.states)}; evaluate a bundle on the capture that it was fitted to"
        )
    if not {part.id: part.name for part in bundle.parts}.items() <= capture.parts.items():
        raise InputError(
            f"{capture_path}: has other parts than {bundle_folder / ARTICULATION}; evaluate a bundle on the capture "
            "that it was fitted to"
        )
    report = bundle_folder / "report.json"
    told = read_record(report, "run `splatart fit` again").fields if report.is_file() else {}
    notes = []
    if is_another(told, capture_identity(capture)):
        notes.append(f"{capture_path}: is not the capture that was fitted, {told['capture']}; its states may be others")
    capture = in_canonical_world(capture, bundle)
    truth = load_ground_truth(capture_path)
    notes.append("images.lpips: its network's weights are not part of this package")
    metrics: dict[str, Any] = {
        "joints": [],
        "joints_mean": {},
        "structure": {},
        "parts": [],
        "geometry": {"mesh": None, "centres": None},
        "images": {},
        "held_out": {},
        "speed": {},
    }
    if truth is None:
        notes.append("joints, structure, parts, geometry: the capture has no ground_truth.json")
    else:
        _score_model(metrics, notes, bundle, truth, len(capture.states), capture_path, meshes)
    novel = load_novel(capture_path)
    _score_images(metrics, notes, bundle, truth, capture, novel, device)
    fitted = fitted_residuals(bundle, capture) if novel else {}
    for state in novel:
        metrics["held_out"][state.name] = held_out_scores(bundle, capture, state, fitted, device)
    metrics["speed"] = told
    if not told:
        notes.append("speed: the bundle has no report.json")
    metrics["notes"] = list(dict.fromkeys(notes))
    write_json(bundle_folder / METRICS, metrics)
    return metrics


def _score_model(
    metrics: dict[str, Any],
    notes: list[str],
    bundle: Bundle,
    truth: GroundTruth,
    num_states: int,
    capture_path: Path,
    meshes: bool,
) -> None:
    if len(truth.motions[truth.root]) != num_states:
        raise InputError(
            f"{capture_path / 'ground_truth.json'}: has {len(truth.motions[truth.root])} states but the capture has "
            f"{num_states}; give the truth of the same states"
        )
    for joint in truth.joints:
        record, note = joint_errors(joint, truth, bundle)
        metrics["joints"].append(record)
        if note is not None:
            notes.append(f"joint {joint.name}: {note}")
    metrics["joints_mean"] = mean_errors(metrics["joints"])
    metrics["structure"] = structure_scores(truth, bundle)
    metrics["parts"] = part_pose_errors(truth, bundle)
    geometry = {"mesh": chamfer_mesh(truth, bundle)} if meshes else {}
    geometry["centres"] = chamfer_centres(truth, bundle)
    metrics["geometry"] |= geometry
    for of, figures in geometry.items():
        if lost := [name for name, value in figures["parts"].items() if value is None]:
            notes.append(f"geometry.{of}: nothing is shown of {', '.join(lost)}; means that it belongs to are null")
    few = [name for part, name in truth.parts.items() if len(truth.points[part]) < SAMPLES]
    if few:
        notes.append(f"geometry: of {', '.join(few)} the truth has fewer than {SAMPLES} points: figures are larger so")


def _score_images(
    metrics: dict[str, Any],
    notes: list[str],
    bundle: Bundle,
    truth: GroundTruth | None,
    capture: Capture,
    novel: Sequence[State],
    device: torch.device | str,
) -> None:
    def score(state: State, motions: dict[str, torch.Tensor]) -> None:
        split = "test" if state.split("test") else "val"
        views = load_views(capture, state, split)
        scores, why = image_scores(bundle, motions, views, capture, device)
        metrics["images"][state.name] = scores
        notes.extend(f"images.{state.name}: {text}" for text in why)

    for index, state in enumerate(capture.states):
        score(state, observed_motions(bundle, index))
    for state in novel:
        true_state = next((n for n in truth.novel if Path(n.folder).name == state.name), None) if truth else None
        if true_state is None:
            notes.append(f"images.{state.name}: the truth does not tell its joint values")
            continue
        if not is_mapped(bundle, truth):
            notes.append(f"images.{state.name}: some joints differ in kind from the true ones, their values are scaled")
        score(state, novel_motions(bundle, truth, true_state))
