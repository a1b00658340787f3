"""Stage 2 in nerfstudio: part poses over all states, then one splat per part from all of them."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from gsplat.strategy.ops import remove
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from splatart_ns.bundle.motion_file import read_motions
from splatart_ns.capture.view import View
from splatart_ns.choices import require_seed
from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import inverse
from splatart_ns.plugin.gaussians import gauss_params_from_splat
from splatart_ns.plugin.model import SplatartModel, SplatartModelConfig, refuse_unread
from splatart_ns.plugin.semantic_run import LabelledState, find_semantic_runs, read_state
from splatart_ns.plugin.trainer import LaterPipelineConfig
from splatart_ns.rasterize.render import render
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.flush import border_against_others
from splatart_ns.stages.free_space import FreeSpace, strays
from splatart_ns.stages.image_error import image_error
from splatart_ns.stages.initial_motion import InitialMotion, initial_motion
from splatart_ns.stages.merge import merge_parts
from splatart_ns.stages.neighbours import turned_as_neighbours_let
from splatart_ns.stages.pose import PartPoses, PoseLossWeights, carry, part_extents, pose_loss, unmixed
from splatart_ns.stages.pose_notes import doubtful_rest, ill_shown, open_turns, turns_alike, unknown_poses
from splatart_ns.stages.reference import is_sure, reference_states, refine_known_poses, since_state_0
from splatart_ns.stages.registration import part_points
from splatart_ns.stages.shared_labels import share_labels
from splatart_ns.stages.siblings import slid_alike, slide_ways
from splatart_ns.stages.silhouette import with_rendered_labels
from splatart_ns.stages.thinning import BUDGET, MAX_VIEWS, ROUNDS, Absences, absences, expendable, veils
from splatart_ns.stages.visibility import HIDDEN, looked_at
from splatart_ns.stages.world import (
    anchors,
    fit_worlds,
    moved_splat,
    moved_views,
    refine_world,
    resting_part,
    world_record,
    world_sentence,
)

THINNING_PARTS = 25
"""Into so many parts the steps on merged Gaussians fall; each of the first few begins with a round of thinning."""
BESIDE, SET_FREE = 0.5, 0.1
"""Poses of parts learn along with merged Gaussians if one state shows more than the first share of their border against
others, and the other less of it by the second. 16 doors and drawers had 0.12 to 0.38 less, 80 of 93 links of robots
less than 0.1; the others are fingers and wrists that fold."""
RATES = 1e-3, 2e-5
"""Of these poses, in the first and in the last step; radians and radii of the part."""
MOST = 3.0
"""So many standard deviations at most these poses move: light counts in that loss, and leads them astray."""
WELL_KNOWN = 0.01
"""Their largest standard deviation, in radians and radii: others would be led by single views."""


@dataclass
class PoseModelConfig(SplatartModelConfig):
    """Poses by rendering every state's parts at every other state, then Gaussians merged from all states."""

    _target: type = field(default_factory=lambda: PoseModel)
    pose_steps: int = 0
    """Steps of gradient descent on the poses, as in the paper; poses that start from registration need none. Then they
    are refined on all views by Gauss-Newton, and the Gaussians of all states are merged and learn."""
    learn_gaussians: Literal["after", "along"] = "after"
    """Whether Gaussians wait until the poses are found, or learn along with them as in the paper."""
    loss_weights: PoseLossWeights = field(default_factory=PoseLossWeights)
    """Weights of the four losses."""


class PoseModel(SplatartModel):
    """First the labelled splats of all states and a pose for every part and state, then the merged parts."""

    config: PoseModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        self.state = self.kwargs["metadata"]["state"]
        self.register_buffer("state_ids", torch.zeros(self.num_points, dtype=torch.long))
        self.register_buffer("merged", torch.tensor(False))
        self.register_buffer("covariance", torch.zeros(1, self.num_parts, 6, 6, dtype=torch.float64))
        self.register_buffer("held_ratio", torch.full((self.num_parts, self.num_parts), torch.nan))
        # Parts that may have turned quite otherwise in some state.
        self.register_buffer("alike", torch.zeros(self.num_parts, dtype=torch.bool))
        self.register_buffer("worlds", torch.eye(4, dtype=torch.float64)[None])
        eye = torch.eye(4, dtype=torch.float64).repeat(1, self.num_parts, 1, 1)
        self.poses = PartPoses(eye, torch.zeros(self.num_parts, 3), torch.ones(self.num_parts))

    def start(self, splats: list[Splat], base: Tensor, frozen: Tensor) -> None:
        """Begin from one splat per state and initial poses [S, P, 4, 4]; `frozen` [S, P] ones stay."""
        self.gauss_params = nn.ParameterDict(gauss_params_from_splat(Splat.cat(splats).to(self.device)))
        self.state_ids = torch.cat([torch.full((len(s),), k) for k, s in enumerate(splats)]).to(self.device)
        self.merged = torch.tensor(False, device=self.device)
        self.poses = PartPoses(base, *part_extents(splats[0], self.num_parts), frozen).to(self.device)
        self.covariance = torch.zeros(*base.shape[:2], 6, 6, dtype=torch.float64, device=self.device)

    @property
    def num_states(self) -> int:
        return self.poses.base.shape[0]

    def state_splat(self, state: int) -> Splat:
        """The Gaussians that came from one state, before the merger."""
        return self.splat.select(self.state_ids == state)

    def splat_at(self, state: int, T: Tensor) -> Splat:
        """The merged Gaussians at an observed state, T [S, P, 4, 4], without parts whose pose there is not known."""
        known = self.covariance[state].isfinite().flatten(1).all(-1)
        splat = self.splat
        if not known.all():
            splat = splat.select(torch.cat([torch.ones_like(known[:1]), known])[splat.part_ids])
        return splat if state == 0 else carry([splat], T[[0, state]], 0, 1)

    @torch.no_grad()
    def posed_splat(self) -> Splat:
        if not self.merged:
            return self.state_splat(self.state)
        return self.splat_at(self.state, self.poses.T())

    def load_state_dict(self, state, **kwargs):
        for name in ("state_ids", "covariance", "held_ratio", "worlds"):
            setattr(self, name, torch.zeros_like(state[name], device=self.device))
        base = state["poses.base"].to(self.device)
        eye = torch.eye(4, dtype=torch.float64, device=self.device).expand_as(base).clone()
        self.poses = PartPoses(eye, *(state[f"poses.{k}"].to(self.device) for k in ("centroids", "radii")))
        return super().load_state_dict(state, **kwargs)


def seen_of_parts(
    splats: Sequence[Splat], views: Sequence[Sequence[View]]
) -> tuple[list[Splat], list[list[View]], list[Tensor], list[Tensor]]:
    """The parts' Gaussians of each state that some view shows, the views with labels everywhere, and what they show of
    each Gaussian: its `visibility`, and the share of it in the `clearest` view."""
    everywhere = [[with_rendered_labels(view, s) for view in some] for s, some in zip(splats, views, strict=True)]
    parts = [splat.select(splat.part_ids > 0) for splat in splats]
    looks = [looked_at(splat, some) for splat, some in zip(parts, everywhere, strict=True)]
    # What lies behind the front of a shut drawer comes to light when the drawer moves, and is nothing but haze.
    shown = [share >= HIDDEN for _, share in looks]
    return (
        [splat.select(which) for splat, which in zip(parts, shown, strict=True)],
        everywhere,
        [seen[which] for (seen, _), which in zip(looks, shown, strict=True)],
        [share[which] for (_, share), which in zip(looks, shown, strict=True)],
    )


@dataclass
class PosePipelineConfig(LaterPipelineConfig):
    """Stage 2."""

    _target: type = field(default_factory=lambda: PosePipeline)
    semantic_runs: tuple[Path, ...] = ()
    """The config.yml of each state's splatart-semantic run, in the order of the states; the latest ones on
    this capture below `runs_dir` when not given."""
    init: Literal["registration", "centroids", "file"] = "registration"
    """How poses start: many-start ICP chosen by rendering, parts' centroids, or `init_file`."""
    init_file: Path | None = None
    """A bundle's articulation.json, or another JSON file with the parts' motions in the same form."""
    snap: bool = True
    """Whether parts whose images fit no motion are held still."""
    root: str | None = None
    """Where the states have worlds of their own: name of the part that brings them together; chosen when not given."""
    seed: int = 0
    """Seed of the registration and of the order of views."""


class PosePipeline(VanillaPipeline):
    """Estimates T[state][part] over all states of a capture, then merges and polishes the parts' Gaussians."""

    config: PosePipelineConfig

    def __init__(self, config: PosePipelineConfig, device: str, test_mode: str = "val", *args, **kwargs):
        super().__init__(config, device, test_mode, *args, **kwargs)
        self.notes: list[str] = []
        self.findings: dict[str, Any] = {}
        if test_mode != "val":  # a checkpoint brings everything
            return
        capture = self.datamanager.capture
        if config.root is not None and config.root not in capture.parts.values():
            raise InputError(
                f"{capture.path} has no part '{config.root}'; choose --pipeline.root from "
                f"{', '.join(capture.parts.values())}, or leave it out."
            )
        refuse_unread(self.model.config, "splatart-pose")
        require_seed(config.seed, "--pipeline.seed")
        if self.model.config.pose_steps < 0:
            raise InputError(f"--pipeline.model.pose-steps is {self.model.config.pose_steps}; give 0 or more.")
        runs = config.semantic_runs or find_semantic_runs(config.runs_dir, capture.path, len(capture.states))
        if len(runs) != len(capture.states):
            raise InputError(
                f"--pipeline.semantic-runs names {len(runs)} of the runs of {capture.path}, which has "
                f"{len(capture.states)} states; name one of each, in their order."
            )
        what = (self.model.num_parts, device, self.datamanager.train_dataset.downscale)
        states = [read_state(capture, s, run, *what) for s, run in enumerate(runs)]
        self._cameras_refined = any(state.cameras_refined for state in states)
        self._begin(states, next((p for p, name in capture.parts.items() if name == config.root), None))

    def _begin(self, states: Sequence[LabelledState], root: int | None, starts: Sequence[Tensor] = ()) -> None:
        """Bring the states into one world, where they have worlds of their own, and find the first poses.

        Args:
            root: The part that brings worlds together, where it is known.
            starts: Similarities [4, 4] near those by which it does, of all states but state 0; else they are sought.
        """
        capture = self.datamanager.capture
        self.notes, self.findings = [], {}
        splats, views = [state.splat for state in states], [state.views for state in states]
        self.model.worlds = torch.from_numpy(np.stack([s.placement for s in capture.states])).to(self.model.worlds)
        if capture.worlds != "shared":
            part, worlds = self._worlds(splats, views, root, starts)
            splats = [splats[0], *map(moved_splat, splats[1:], worlds)]
            views = [views[0], *map(moved_views, views[1:], worlds)]
        around = [splat.select(splat.part_ids == 0) for splat in splats]
        splats, self.views, self._seen, self._clear = seen_of_parts(share_labels(splats, views), views)
        self._shown = [image_error(splat, views) for splat, views in zip(splats, self.views, strict=True)]
        S, P = len(splats), self.model.num_parts
        self._reference, self._known, self._frozen = [0] * P, torch.ones(S, P, dtype=torch.bool), torch.zeros(S, P) > 0
        self._maybe_moved = torch.zeros(S, P) > 0
        self._alike: dict[tuple[int, int], InitialMotion] = {}  # by state and part
        M = self._initial_poses(splats)
        if capture.worlds != "shared" and root is None and self.config.init == "registration":
            points = part_points(splats[0], self._seen[0], part)
            parts = sorted(anchors(splats, self._seen, P), key=lambda p: p != part)
            if (rests := resting_part(around, M, self._known, points, parts)) is not None:
                names = capture.parts
                CONSOLE.log(f"What surrounds the object rests with {names[rests]}, not {names[part]}.", markup=False)
                held = M[1:, rests - 1].to(worlds[0])
                self._begin(states, rests, [inverse(T) @ world for T, world in zip(held, worlds, strict=True)])
                return
        self.model.start(splats, M, self._frozen)
        # Gaussians learn labels that somebody gave: by those that they showed themselves, images come out worse.
        self._pairs = self._shuffled_pairs(views)
        self._own = self._shuffled_views(views)

    def _worlds(
        self, splats: list[Splat], views: list[list[View]], root: int | None, starts: Sequence[Tensor]
    ) -> tuple[int, list[Tensor]]:
        """The part that brings worlds together, and the similarity [4, 4] of every state but state 0 to its world."""
        capture = self.datamanager.capture
        with_scale = capture.worlds == "similar"
        objects, labelled, seen, _ = seen_of_parts(splats, views)
        if starts:
            pairs = [((objects[0], objects[k]), (labelled[0], labelled[k])) for k in range(1, len(objects))]
            part = root
            fits = [refine_world(*pair, root, T, with_scale) for pair, T in zip(pairs, starts, strict=True)]
        else:
            parts = anchors(objects, seen, self.model.num_parts) if root is None else [root]
            around = [splat.select(splat.part_ids == 0) for splat in splats]
            found = fit_worlds(objects, labelled, seen, parts, with_scale, self.config.seed, around)
            if found is None:
                raise InputError(
                    f"{capture.path}: no part is seen well enough in all states to bring their worlds together; label "
                    "a part in more frames of every state, or name one by --root."
                )
            part, fits = found
        self.findings["worlds"] = []
        for k, fit in enumerate(fits, start=1):
            to_first = torch.from_numpy(capture.normalization.motion_to_world(fit.T.numpy(force=True)))
            self.model.worlds[k] = to_first.to(self.model.worlds) @ self.model.worlds[k]
            told = world_record(capture.states[k].name, self.model.part_names[part], self.model.worlds[k], fit)
            self.findings["worlds"].append(told)
            self._note([world_sentence(told, capture.states[0].name)])
        return part, [fit.T for fit in fits]

    def _initial_poses(self, splats: list[Splat]) -> Tensor:
        """Poses [S, P, 4, 4] to begin from; keeps in mind the reference states, and what is known and what stays."""
        if self.config.init == "file":
            return self._poses_from_file()
        S, P = self._known.shape
        M = torch.eye(4, dtype=torch.float64).repeat(S, P, 1, 1)
        if self.config.init == "centroids":
            centroids = torch.stack([part_extents(s, P)[0].cpu() for s in splats])
            M[..., :3, 3] = centroids - centroids[0]
            return M
        # Where cameras were refined, each state has kept the mean error of its own: what rests seems to move by that.
        # A part that brought worlds together rests by definition, but is found no more exactly than one that moved.
        snap = self.config.snap and not self._cameras_refined and "worlds" not in self.findings
        self._reference = reference_states(splats, self._seen, P)
        found: dict[tuple[int, int], dict[int, InitialMotion]] = {}
        for p, first in enumerate(self._reference):
            for s in range(S):
                if s != first:
                    pair = [(everything[first], everything[s]) for everything in (splats, self.views, self._seen)]
                    found.setdefault((first, s), {})[p + 1] = initial_motion(*pair, p + 1, self.config.seed)
        moves = {part for motions in found.values() for part, m in motions.items() if m.found and not m.still}
        for (first, s), motions in found.items():
            ways = slide_ways(splats[first], motions)
            pair = [(everything[first], everything[s]) for everything in (splats, self.views)]
            slid = {part: slid_alike(*pair, part, m, ways) if m.alike else m for part, m in motions.items()}
            for part, motion in turned_as_neighbours_let(*pair, slid).items():
                p = part - 1
                M[s, p] = motion.T.cpu()
                self._known[s, p] = motion.found
                # Of what moves at another state it is no surprise that it has moved a little.
                still = motion.still and not (motion.maybe_moved and part in moves)
                self._frozen[s, p] = not motion.found or (snap and still)
                self._maybe_moved[s, p] = motion.maybe_moved
                if motion.alike:
                    self._alike[s, p] = motion
        return since_state_0(M, self._known)

    def _note(self, notes: list[str], in_doubt: Tensor | None = None) -> None:
        """Keep and say notes, and mark the parts [P] of which they are in doubt for stage 3."""
        self.notes += notes
        for note in notes:
            CONSOLE.log(note, markup=False)
        if in_doubt is not None:
            self.model.alike |= in_doubt.to(self.model.alike)

    def _poses_from_file(self) -> Tensor:
        if self.config.init_file is None:
            raise InputError("--pipeline.init is file, but no file is given; name one by --pipeline.init-file.")
        capture = self.datamanager.capture
        motions = read_motions(self.config.init_file, list(capture.parts.values()), len(capture.states))
        return torch.from_numpy(capture.normalization.motion_to_normal(motions.numpy()))

    def _shuffled_pairs(self, of_states: list[list[View]]) -> Iterator[tuple[int, int, View]]:
        """(source, target, target view): all pairs of states in turn, both ways round, every view of a state before
        any again."""
        rng = random.Random(self.config.seed)
        S = len(of_states)
        queues: list[list[View]] = [[] for _ in range(S)]
        while True:
            pairs = [(a, b) for a in range(S) for b in range(S) if a < b]
            rng.shuffle(pairs)
            for a, b in pairs:
                for source, target in ((a, b), (b, a)):
                    if not queues[target]:
                        queues[target] = rng.sample(of_states[target], len(of_states[target]))
                    yield source, target, queues[target].pop()

    def _shuffled_views(self, of_states: list[list[View]]) -> Iterator[tuple[int, View, float]]:
        """(state, view, share): the piece around the object of every view of every state before any again, and its
        share of the image."""
        rng = random.Random(self.config.seed)
        pieces = [(s, v, v.cropped(v.object_window())) for s, views in enumerate(of_states) for v in views]
        everything = [(s, piece, piece.alpha.numel() / v.alpha.numel()) for s, v, piece in pieces]
        while True:
            yield from rng.sample(everything, len(everything))

    def get_train_loss_dict(self, step: int):
        model = self.model
        losses: dict[str, Tensor] = {}
        background = torch.rand(3, device=model.device)
        if model.merged:
            # Beside the piece that shows the object nothing is wrong: the means are those over the whole image.
            state, view, share = next(self._own)
            # Where none learns, no gradient need reach them.
            T = model.poses.T() if model.poses.free.any() else model.poses.base
            shots = [(model.splat_at(state, T), view)]
        else:
            shots, share, T = [], 1.0, model.poses.T()
            for _ in range(2):
                source, target, view = next(self._pairs)
                shots.append((carry({source: self._moving_splat(source)}, T, source, target), view))
        for splat, view in shots:
            rendering = render(
                splat,
                view.viewmat[None],
                view.K[None],
                view.width,
                view.height,
                features=splat.part_probabilities,
                with_depth=model.merged and view.depth is not None,
            )
            for name, loss in pose_loss(rendering, view, model.config.loss_weights, background).items():
                losses[name] = losses.get(name, 0) + share * loss / len(shots)
        return {}, losses, {"gaussian_count": model.num_points}

    def _moving_splat(self, state: int) -> Splat:
        """What moves while poses are sought: a state's Gaussians without those that straddle two parts."""
        splat = self.model.state_splat(state)
        if self.model.config.learn_gaussians == "along":
            return splat
        splat = splat.detach()
        return splat.select(unmixed(splat))

    def get_training_callbacks(self, training_callback_attributes) -> list[TrainingCallback]:
        optimizers = training_callback_attributes.optimizers
        steps = training_callback_attributes.trainer.config.max_num_iterations
        if steps <= self.model.config.pose_steps:
            raise InputError(
                f"--max-num-iterations is {steps}, but the parts are merged at step {self.model.config.pose_steps}; "
                "give more iterations or a smaller --pipeline.model.pose-steps."
            )

        def merge(step: int) -> None:
            if step == self.model.config.pose_steps:
                self._merge(optimizers)

        apart = max(1, (steps - self.model.config.pose_steps) // THINNING_PARTS)

        def thin(step: int) -> None:
            turn, rest = divmod(step - self.model.config.pose_steps, apart)
            if rest == 0 and 0 <= turn < ROUNDS:
                self._thin(turn, optimizers)

        def slow_down(step: int) -> None:
            if self.model.merged:
                share = (step - self.model.config.pose_steps) / (steps - self.model.config.pose_steps)
                optimizers.optimizers["part_poses"].param_groups[0]["lr"] = RATES[0] * (RATES[1] / RATES[0]) ** share

        def count(step: int) -> None:
            self.model.step = step

        def hold(step: int) -> None:
            if self.model.merged and self.model.poses.free.any():
                self.model.poses.hold_within(self.model.covariance, MOST)

        def finish(step: int) -> None:
            if step == steps - 1:
                self.model.poses.commit(self.model.poses.T())
                self._remove_strays(optimizers)  # some have gone there since the last thinning
                self._tell_errors()

        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        return [
            *(TrainingCallback(before, function) for function in (merge, thin, slow_down, count)),
            *(TrainingCallback(after, function) for function in (hold, finish)),
        ]

    @torch.no_grad()
    def _merge(self, optimizers: Optimizers) -> None:
        """End the search for poses, then keep one set of Gaussians, in the canonical frame."""
        model = self.model
        splats = [model.state_splat(s).detach() for s in range(model.num_states)]
        as_begun = model.config.learn_gaussians == "after"
        begun = model.poses.T()
        T, model.covariance, model.held_ratio, misfits = refine_known_poses(
            splats,
            self.views,
            begun,
            self._frozen,
            self._reference,
            self._known,
            self._clear if as_begun else None,
        )
        model.poses.commit(T)
        model.poses.release(self._learning_along(splats), model.covariance[..., 3:, 3:].flatten(2).any(-1))
        known = model.covariance.isfinite().flatten(2).all(-1)
        parts = model.part_names[1:]
        self._note(unknown_poses(known, parts))
        self._note(open_turns(model.covariance, parts))
        self._note(*turns_alike(self._alike, self._reference, T, model.covariance, parts))
        self._note(*doubtful_rest(self._maybe_moved, misfits, self._frozen, begun, T, model.covariance, parts))
        merged = Splat.cat(merge_parts(splats, self.views, T, known, self._seen if as_begun else None))
        params = gauss_params_from_splat(merged)
        for name, parameter in params.items():
            model.gauss_params[name] = parameter
            optimizers.optimizers[name].param_groups[0]["params"] = [parameter]
            optimizers.optimizers[name].state.clear()
            optimizers.schedulers[name].last_epoch = 0  # the merged Gaussians' rates begin to decay
        optimizers.schedulers.pop("part_poses", None)
        optimizers.optimizers["part_poses"].state.clear()
        model.state_ids = torch.zeros(len(merged), dtype=torch.long, device=model.device)
        model.merged = torch.tensor(True, device=model.device)

    def _learning_along(self, splats: list[Splat]) -> Tensor:
        """Which poses [S, P] learn along with the merged Gaussians.

        Where a part lies against others, as a shut door does, its edges and what they touch are haze that no view
        shows; set free, it shows, and shifts the part. Merged Gaussians lose it, for all states say what is there.
        Most links of robots lie against as much in all states, or are free all around; they came out worse, so their
        poses stay as they were found.
        """
        model, T = self.model, self.model.poses.base
        border = cache(lambda p, s: border_against_others(self.views[s], p + 1))
        centroids, radii = part_extents(splats[0], model.num_parts)
        learning = torch.zeros_like(self._known)
        for s, p in (self._known & self._known[0] & ~self._frozen).nonzero().tolist():
            if s > 0 and is_sure(T[s, p], model.covariance[s, p], centroids[p], radii[p], WELL_KNOWN):
                less, more = sorted(border(p, t) for t in (self._reference[p], s))
                learning[s, p] = more > BESIDE and more - less > SET_FREE
        return learning

    @torch.no_grad()
    def _thin(self, turn: int, optimizers: Optimizers) -> None:
        """One of the rounds in which merged Gaussians go that the images hardly miss, veils, and strays."""
        start, model = time.perf_counter(), self.model
        if turn == 0:
            self.findings["thinned"] = {
                "gaussians": [model.num_points] * 2,
                "veils": 0,
                "strays": 0,
                "added_error": 0.0,
                "seconds": 0.0,
            }
        self._remove_strays(optimizers)
        found = self._absences(turn)
        if turn == 0:
            self._error = found.error
        told = self.findings["thinned"]
        budget = (turn + 1) / ROUNDS * BUDGET - told["added_error"]
        veil = veils(found, model.splat.detach())
        missed = found.images.masked_fill(veil, 0.0)  # what shows behind them learns to be what it is
        goes = expendable(missed, model.splat.part_ids, budget * self._error)
        self._remove(goes, optimizers)
        told["veils"] += int((veil & goes).sum())
        told["added_error"] += float(missed[goes].sum()) / self._error
        told["seconds"] = round(told["seconds"] + time.perf_counter() - start, 2)

    def _remove(self, goes: Tensor, optimizers: Optimizers) -> None:
        """Some of the merged Gaussians [N] bool, and what the optimisers know of them."""
        model = self.model
        remove(model.gauss_params, {name: optimizers.optimizers[name] for name in model.gauss_params}, {}, goes)
        model.state_ids = model.state_ids[~goes]
        self.findings["thinned"]["gaussians"][1] = model.num_points

    @torch.no_grad()
    def _remove_strays(self, optimizers: Optimizers) -> None:
        """Merged Gaussians that are in free space in some state."""
        model = self.model
        known = model.covariance.isfinite().flatten(2).all(-1)
        stray = strays(model.splat, self._free, model.poses.T(), known)
        self._remove(stray, optimizers)
        self.findings["thinned"]["strays"] += int(stray.sum())

    @cached_property
    def _free(self) -> list[FreeSpace]:
        return [FreeSpace.of(views) for views in self.views]

    def _absences(self, turn: int) -> Absences:
        """What `absences` finds in some views of all states, others in each turn."""
        model = self.model
        splat, T = model.splat.detach(), model.poses.T()
        ids, known = splat.part_ids, model.covariance.isfinite().flatten(2).all(-1)
        views = [(s, view) for s, views in enumerate(self.views) for view in views]
        every = -(-len(views) // MAX_VIEWS)
        found = Absences.none(splat)
        for s in range(model.num_states):
            chosen = [view for of, view in views[turn % every :: every] if of == s]
            shown = torch.cat([known.new_ones(1), known[s]])[ids]
            moved = splat.select(shown).transformed(torch.cat([torch.eye(4).to(T)[None], T[s]])[ids[shown]])
            found = found.plus(absences(moved, chosen, self.config.seed + turn * model.num_states + s), shown)
        return found

    def _tell_errors(self) -> None:
        """How well the images of each state are shown in the end."""
        model, states = self.model, [state.name for state in self.datamanager.capture.states]
        T = model.poses.T().detach()
        posed = [image_error(model.splat_at(s, T).detach(), views) for s, views in enumerate(self.views)]
        self.findings["images"] = [
            {"state": name, "psnr": round(of.psnr, 2)} for name, of in zip(states, posed, strict=True)
        ]
        self._note(*ill_shown(self._shown, posed, states, model.part_names[1:]))

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {**super().get_param_groups(), "part_poses": list(self.model.poses.parameters())}
