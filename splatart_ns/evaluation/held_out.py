"""How well the finished model explains a configuration that it was not fitted to; no ground truth is needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.configuration_fit import appearance_residuals, fit_configuration
from splatart_ns.bundle.posing import configured_motions, observed_motions
from splatart_ns.capture.capture import Capture, State
from splatart_ns.capture.view import View, load_views
from splatart_ns.evaluation.images import image_scores


@torch.no_grad()
def fitted_residuals(bundle: Bundle, capture: Capture) -> dict[str, float]:
    """Each part's mean residual in the held-out views of the states that the model was fitted to."""
    residuals: dict[str, list[float]] = {}
    for index, state in enumerate(capture.states):
        motions, views = observed_motions(bundle, index), _held_out_views(capture, state)
        for name, residual in appearance_residuals(bundle, motions, views, capture.normalization).items():
            residuals.setdefault(name, []).append(residual)
    return {name: _mean(values) for name, values in residuals.items()}


@torch.no_grad()
def held_out_scores(
    bundle: Bundle,
    capture: Capture,
    state: State,
    fitted: Mapping[str, float],
    device: torch.device | str = "cpu",
) -> dict[str, Any]:
    """Find the joint values that a state's images show, and score the object there; `fitted`: `fitted_residuals`.

    Returns:
        `values` of the joints (radians, lengths); `converged`; the mean `residual` of the moving parts at those values,
        and `fitted_residual`, theirs in the views of the states that the model was fitted to: a joint that is wrong
        makes the first much the larger; `residuals` by part; `psnr`, its `silhouette` and `part_iou` as in `images`;
        `unseen` parts. Nulls where no view has labels.
    """
    views = _held_out_views(capture, state)
    found = fit_configuration(bundle, views, capture.normalization)
    both = [name for name in found.residual if name in fitted]
    scores, _ = image_scores(bundle, configured_motions(bundle, found.q), views, capture, device)
    return {
        "values": {name: value.tolist() for name, value in found.q.items()},
        "converged": found.converged,
        "residual": _mean([found.residual[name] for name in both]),
        "fitted_residual": _mean([fitted[name] for name in both]),
        "residuals": found.residual,
        "psnr": scores["psnr"],
        "silhouette": scores["silhouette"],
        "part_iou": scores["part_iou"],
        "unseen": found.unseen,
    }


def _held_out_views(capture: Capture, state: State) -> list[View]:
    """The state's test or validation views; all of them where none is held out."""
    split = next((split for split in ("test", "val") if state.split(split)), "train")
    return load_views(capture, state, split)


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
