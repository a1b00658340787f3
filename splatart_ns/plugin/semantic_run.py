"""What later stages read of a finished splatart-semantic run: a state's labelled splat, and the views of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from splatart_ns.capture.capture import Capture
from splatart_ns.capture.digest import training_digest
from splatart_ns.capture.seen_surface import measured_surface
from splatart_ns.capture.view import View, load_views
from splatart_ns.errors import InputError
from splatart_ns.plugin.compat import finished_runs, read_checkpoint, read_run_config, run_setting
from splatart_ns.plugin.gaussians import SPLAT_SHAPES, splat_from_state
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.exposure import at_gain
from splatart_ns.stages.silhouette import rendered_silhouette, with_silhouette

_SHAPES = {
    **{"_model.cameras_refined": (), "_model.trained_on": (32,)},
    **{"_model.viewmats": ("views", 4, 4), "_model.gains": ("views", 3), "_model.trusted": ("views",)},
}


@dataclass(frozen=True)
class LabelledState:
    """One state of a capture, alone, in its own world."""

    splat: Splat
    views: list[View]
    """The training views, with the cameras that the run ended with. Each says where the object ends: parts are rendered
    without what surrounds them. None of them has labels that contradict the others'."""
    cameras_refined: bool


def read_state(
    capture: Capture, state: int, run: Path, num_parts: int, device: str, downscale: int = 1
) -> LabelledState:
    """What a run, given by its config.yml, made of a state; views are `downscale` times smaller than the images.

    Raises:
        InputError: the run is not of this state of the capture as it is now, or learned no parts.
    """
    checkpoint = read_checkpoint(run, SPLAT_SHAPES | _SHAPES)
    _require_trained_on(capture, state, run, checkpoint["_model.trained_on"].tolist())
    splat = splat_from_state(checkpoint).to(device)
    if splat.part_logits.shape[1] != num_parts + 1:
        raise InputError(
            f"{run} was trained with {splat.part_logits.shape[1] - 1} parts and the capture has "
            f"{num_parts}; train splatart-semantic again."
        )
    if not bool((splat.part_ids > 0).any()):
        raise InputError(
            f"{run} learned no parts: no Gaussian fits the silhouettes and labels of {capture.states[state].name}; "
            f"`splatart check {capture.path}` tells wrong poses, axes, masks and worlds (--worlds); else train longer."
        )
    views = [view.to(device) for view in learned_views(capture, state, checkpoint, downscale)]
    views = [with_silhouette(view) or rendered_silhouette(view, splat) for view in views]
    return LabelledState(splat, views, bool(checkpoint["_model.cameras_refined"]))


def _require_trained_on(capture: Capture, state: int, run: Path, digest: list[int]) -> None:
    """Raises `InputError` if a run's `training_digest` is not that of the state."""
    if digest == list(training_digest(capture, state)):
        return
    name = capture.states[state].name
    for k, other in enumerate(capture.states):
        if digest == list(training_digest(capture, k)):
            raise InputError(
                f"{run} is given for {name} and was trained on {other.name}; give --pipeline.semantic-runs one run of "
                "each state, in the order of the states."
            )
    raise InputError(
        f"{run} was trained on other frames, cameras or --worlds than {name} of {capture.path} has; run "
        f"`ns-train splatart-semantic --data {capture.path} splatart-capture --state {state}` again."
    )


def find_semantic_runs(runs_dir: Path, capture: Path, num_states: int) -> tuple[Path, ...]:
    """The config.yml of the latest finished splatart-semantic run of each state below a folder of runs.

    Raises:
        InputError: naming a state that has none.
    """
    found: dict[int, Path] = {}
    for config in finished_runs(runs_dir, capture, "splatart-semantic"):
        state = run_setting(config, "pipeline", "datamanager", "dataparser", "state")
        if isinstance(state, int):
            found[state] = config
    for state in range(num_states):
        if state not in found:
            raise InputError(
                f"{runs_dir} holds no finished splatart-semantic run of state {state} of {capture}; run "
                f"`ns-train splatart-semantic --data {capture} splatart-capture --state {state}` first, or name its "
                "--output-dir by --pipeline.runs-dir or every state's config.yml by --pipeline.semantic-runs."
            )
        CONSOLE.print(f"State {state}: {found[state]}", markup=False, soft_wrap=True)
    runs = tuple(found[s] for s in range(num_states))
    if names := _differing_settings(runs):
        CONSOLE.print(
            f"Warning: these runs had different settings ({', '.join(names)}), so that one state is worse known than "
            "another; train them alike, or name others by --pipeline.semantic-runs.",
            markup=False,
            soft_wrap=True,
        )
    return runs


def _differing_settings(runs: Sequence[Path]) -> list[str]:
    """Names of the settings of a splat's training that are not the same in all runs."""
    settings = [_settings(run) for run in runs]
    names = {name: None for each in settings for name in each}  # in their order
    return [name for name in names if any(each.get(name) != settings[0].get(name) for each in settings)]


def _settings(run: Path) -> dict[str, Any]:
    fields = read_run_config(run)
    manager, model = (fields["pipeline"].get(name) for name in ("datamanager", "model"))
    own = {name: value for name, value in manager.items() if name not in ("data", "dataparser")}
    return {"max_num_iterations": fields["max_num_iterations"], **own, **(model if isinstance(model, dict) else {})}


def learned_views(capture: Capture, state: int, checkpoint: dict[str, Tensor], downscale: int = 1) -> list[View]:
    """The training views of a state as its splatart-semantic run saw them in the end: with the cameras that it refined,
    at one exposure, and without the labels and the depth that it did not trust."""
    views = load_views(capture, state, "train", downscale)
    learned = [checkpoint[f"_model.{name}"] for name in ("viewmats", "gains", "trusted")]
    views = [
        replace(view, viewmat=viewmat.float(), rgb=at_gain(view.rgb, gain), labels=view.labels if trusted else None)
        for view, viewmat, gain, trusted in zip(views, *learned, strict=True)
    ]
    return measured_surface(views).trusted_views()
