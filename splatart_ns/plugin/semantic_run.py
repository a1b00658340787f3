"""What later stages read of a finished splatart-semantic run: a state's labelled splat, and the views of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from splatart_ns.capture.capture import Capture
from splatart_ns.capture.view import View, load_views
from splatart_ns.errors import InputError
from splatart_ns.plugin.compat import finished_runs, read_checkpoint, read_run_config
from splatart_ns.plugin.gaussians import splat_from_state
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.exposure import at_gain
from splatart_ns.stages.semantic import ballots, trusted
from splatart_ns.stages.silhouette import rendered_silhouette, with_silhouette


@dataclass(frozen=True)
class LabelledState:
    """One state of a capture, alone, in its own world."""

    splat: Splat
    views: list[View]
    """The training views, with the cameras that the run ended with and without labels that contradict the others'. Each
    says where the object ends: parts are rendered without what surrounds them."""
    cameras_refined: bool


def read_state(capture: Capture, state: int, run: Path, num_parts: int, device: str) -> LabelledState:
    """What a run, given by its config.yml, made of a state.

    Raises:
        InputError: the run is not of this capture, or learned no parts.
    """
    checkpoint = read_checkpoint(run)
    splat = splat_from_state(checkpoint).to(device)
    if splat.part_logits.shape[1] != num_parts + 1:
        raise InputError(
            f"{run} was trained with {splat.part_logits.shape[1] - 1} parts and the capture has "
            f"{num_parts}; train splatart-semantic again."
        )
    if not bool((splat.part_ids > 0).any()):
        raise InputError(f"{run} learned no parts; train splatart-semantic longer, with labelled frames.")
    views = _trusted([v.to(device) for v in refined_views(capture, state, checkpoint)], splat, num_parts)
    views = [with_silhouette(view) or rendered_silhouette(view, splat) for view in views]
    return LabelledState(splat, views, bool(checkpoint["_model.cameras_refined"]))


def find_semantic_runs(capture: Path, num_states: int) -> tuple[Path, ...]:
    """The config.yml of the latest finished splatart-semantic run of each state under outputs/.

    Raises:
        InputError: naming a state that has none.
    """
    found: dict[int, Path] = {}
    for config in finished_runs(capture, "splatart-semantic"):
        found[read_run_config(config)["pipeline"]["datamanager"]["dataparser"]["state"]] = config
    for state in range(num_states):
        if state not in found:
            raise InputError(
                f"outputs/ holds no finished splatart-semantic run of state {state} of {capture}; run "
                f"`ns-train splatart-semantic --data {capture} splatart-capture --state {state}` first."
            )
    return tuple(found[s] for s in range(num_states))


def refined_views(capture: Capture, state: int, checkpoint: dict[str, Tensor]) -> list[View]:
    """The training views of a state with the cameras and exposures that its splatart-semantic run ended with."""
    views = load_views(capture, state, "train")
    viewmats, gains = (checkpoint.get(f"_model.{name}", ()) for name in ("viewmats", "gains"))
    if not len(viewmats) == len(gains) == len(views):
        raise InputError(
            f"{capture.path}: {capture.states[state].name} has {len(views)} training frames, but its splatart-semantic "
            f"run has {len(viewmats)}, or is of an earlier version; train it again."
        )
    return [
        replace(view, viewmat=viewmat.float(), rgb=at_gain(view.rgb, gain))
        for view, viewmat, gain in zip(views, viewmats, gains, strict=True)
    ]


def _trusted(views: list[View], splat: Splat, num_parts: int) -> list[View]:
    """The views of a state, without labels that contradict those of the other views."""
    labelled = [i for i, view in enumerate(views) if view.labels is not None]
    kept = trusted(ballots(splat, [views[i] for i in labelled], num_parts))
    drop = {i for i, keep in zip(labelled, kept.tolist(), strict=True) if not keep}
    return [replace(view, labels=None) if i in drop else view for i, view in enumerate(views)]
