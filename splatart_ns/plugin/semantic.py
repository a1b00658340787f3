"""Stage 1 in nerfstudio: one labelled splat of one state."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import torch
from gsplat.strategy import DefaultStrategy
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from splatart_ns.capture.capture import State
from splatart_ns.capture.digest import training_digest
from splatart_ns.capture.seen_surface import LEAST_CONFIRMED
from splatart_ns.capture.worlds import OTHER_WORLDS_MEND, looks_elsewhere
from splatart_ns.choices import RefineCameras
from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import inverse
from splatart_ns.plugin.model import SplatartModel, SplatartModelConfig
from splatart_ns.rasterize.ssim import l1_ssim_loss
from splatart_ns.stages.camera_refinement import (
    EXACT_PIXELS,
    PASSES,
    TRIED,
    camera_change,
    image_shift,
    refine_cameras,
)
from splatart_ns.stages.exposure import at_gain, frame_gains, unevenness
from splatart_ns.stages.hull import inside_silhouettes, slack
from splatart_ns.stages.semantic import (
    accumulation_loss,
    ballots,
    depth_loss,
    part_image,
    segmentation_loss,
    spike_loss,
    trusted,
    vote_logits,
)
from splatart_ns.stages.spread import TOLD, spread

HALF_SIZE = 0.4
"""The share of the first phase that sees images of half the size."""
LEAST_PIXELS = 256
"""Images of fewer pixels along a side than this, as they are in their files, are always seen at the size at which the
stage looks at them: at this one it was measured."""

EVENED = (0.2, 0.4, 0.6)
"""When frames are brought to one exposure, as shares of the steps on geometry and colour."""
UNEVEN = 0.1
"""Least `unevenness` at which they are: even frames, of thin things too, measured 0.06 at most, of exposures 0.7 to 1.3
times as long 0.16 and more."""
LEAST_STEPS = 50
"""A splat that has learned for fewer steps says nothing of exposures."""


@dataclass
class SemanticModelConfig(SplatartModelConfig):
    """Splatfacto with an accumulation loss, then a phase in which only the part logits learn."""

    _target: type = field(default_factory=lambda: SemanticModel)
    semantic_start: int = 1000
    """Step from which geometry and colour stay as they are and the part logits learn."""
    accumulation_weight: float = 0.4
    """Weight of the loss between accumulation and the image's silhouette."""
    depth_weight: float = 0.5
    """Weight of the mean distance, in the normalised world, of what is rendered from the surface that the frames' own
    depth tells. (With what stereo finds in its place, two random cupboards' meshes gained 8 and 0 %, and images lost
    0.15 dB.)"""
    vote_init: bool = True
    """Whether the logits start from the labels' votes, counted in one backward pass a labelled view."""
    max_gaussians: int = 12000
    """Gaussians are not split or duplicated beyond this number, nor beyond 3 / 2 of those that start inside the
    silhouettes, and 3 / 2 of those that start on the surroundings."""
    background_color: Literal["random", "black", "white"] = "random"
    refine_cameras: RefineCameras = "auto"
    """Whether the cameras' poses are refined while geometry and colour learn; auto: if no hull fits the silhouettes;
    where images have none it always tries, and goes on if that moves the images by 0.7 pixels or more."""


class SemanticModel(SplatartModel):
    """Two phases in one run: all but the logits, then the logits alone."""

    config: SemanticModelConfig
    shows_surroundings = True

    def populate_modules(self) -> None:
        super().populate_modules()
        config = self.config
        # Images of half the size first take a fifth off the seconds and give as sharp Gaussians.
        config.resolution_schedule = max(1, min(config.resolution_schedule, int(HALF_SIZE * config.semantic_start)))
        cameras = [frame.camera for frame in self.kwargs["metadata"]["frames"]]
        if min(min(camera.width, camera.height) for camera in cameras) < LEAST_PIXELS:
            config.num_downscales = 0
        reset_every = config.reset_alpha_every * config.refine_every
        resets = reset_every < config.semantic_start
        self.strategy = DefaultStrategy(
            prune_opa=config.cull_alpha_thresh,
            grow_grad2d=config.densify_grad_thresh,
            grow_scale3d=config.densify_size_thresh,
            grow_scale2d=config.split_screen_size,
            prune_scale3d=config.cull_scale_thresh,
            prune_scale2d=config.cull_screen_size,
            refine_scale2d_stop_iter=config.stop_screen_size_at,
            refine_start_iter=config.warmup_length,
            refine_stop_iter=min(config.stop_split_at, config.semantic_start),
            reset_every=reset_every,
            refine_every=config.refine_every,
            # The strategy takes the start for a reset; without one there is nothing to wait for.
            pause_refine_after_reset=self.num_train_data + config.refine_every if resets else 0,
            absgrad=config.use_absgrad,
            verbose=False,
        )
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)
        # Points that were as many as the object's pixels can teach grow in proportion.
        self._most = 3 * self.kwargs["metadata"].get("points3D_inside", config.max_gaussians) // 2
        self._for_surroundings = 3 * self.kwargs["metadata"].get("points3D_around", 0) // 2
        # World to camera, OpenCV axes, of the training frames as they were last refined.
        self.register_buffer("viewmats", torch.eye(4, dtype=torch.float64).repeat(self.num_train_data, 1, 1))
        self.register_buffer("cameras_refined", torch.tensor(False))
        # How many times brighter than their mean the training frames are, by channel.
        self.register_buffer("gains", torch.ones(self.num_train_data, 3))
        # Whether they have labels that do not contradict the others'.
        self.register_buffer("trusted", torch.zeros(self.num_train_data, dtype=torch.bool))
        # The `training_digest` of its state.
        self.register_buffer("trained_on", torch.zeros(32, dtype=torch.uint8))

    def load_state_dict(self, state, **kwargs):
        for name in ("viewmats", "gains", "trusted"):
            setattr(self, name, torch.zeros_like(state[name], device=self.device))
        return super().load_state_dict(state, **kwargs)

    @property
    def learns_parts(self) -> bool:
        """Whether the second phase has begun."""
        return self.step >= self.config.semantic_start

    @property
    def shown_degree(self) -> int:
        return self.step // self.config.sh_degree_interval

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        if self.training and self.learns_parts:
            splat = self.splat
            frozen = splat.detach()
            frozen.part_logits = splat.part_logits
            rendering = self.rasterize(frozen, camera, parts=True, depth=False)
            accumulation = rendering.accumulation[0]
            background = self._get_background_color()
            return {
                "rgb": rendering.rgb[0] + (1 - accumulation) * background,
                "accumulation": accumulation,
                "background": background,
                "part_probabilities": part_image(rendering)[0],
            }
        outputs = super().get_outputs(camera)
        if self.training:
            self.strategy.step_pre_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step, self.info
            )
        return outputs

    def step_post_backward(self, step: int) -> None:
        if not self.learns_parts:
            if step % self.config.refine_every == 0:
                self._limit_growth()
            super().step_post_backward(step)

    def _limit_growth(self) -> None:
        """Raise the strategy's threshold so that only the neediest Gaussians that there is room for grow."""
        room = min(self.config.max_gaussians, self._most) + self._for_surroundings - self.num_points
        self.strategy.grow_grad2d = self.config.densify_grad_thresh
        if self.strategy_state["count"] is None or room >= self.num_points:
            return
        need = self.strategy_state["grad2d"] / self.strategy_state["count"].clamp_min(1)
        if room <= 0:
            self.strategy.grow_grad2d = float("inf")
        else:
            self.strategy.grow_grad2d = max(self.strategy.grow_grad2d, float(need.topk(room + 1).values[-1]))

    @torch.no_grad()
    def fade(self, which: Tensor) -> None:
        """Make some Gaussians [N] bool transparent: they do not show, and go by the next pruning, or the next stage."""
        self.gauss_params["opacities"][which.to(self.device)] = -10.0

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        """Colour and accumulation losses in the first phase, cross-entropy of the parts in the second."""
        if self.training and self.learns_parts:
            labels = batch["semantics"][..., 0].to(self.device)
            wrong = segmentation_loss(outputs["part_probabilities"], self._downscale_labels(labels))
            return {"segmentation": batch["share"] * wrong}
        image = self.get_gt_img(batch["image"])
        target = self.composite_with_background(image, outputs["background"])
        rgb, accumulation = outputs["rgb"], outputs["accumulation"][..., 0]
        if "mask" in batch:
            mask = (self._downscale_if_required(batch["mask"].float()) > 0.5).to(rgb)
            target, rgb = target * mask, rgb * mask
        losses = {"main_loss": l1_ssim_loss(rgb, target, self.config.ssim_lambda)}
        if image.shape[-1] == 4:
            alpha = image[..., 3]
            if "mask" in batch:
                alpha, accumulation = alpha * mask[..., 0], accumulation * mask[..., 0]
            losses["accumulation"] = self.config.accumulation_weight * accumulation_loss(accumulation, alpha)
        if "depth" in batch:
            seen = self._downscale_labels(batch["depth"].to(rgb))
            wrong = depth_loss(outputs["depth"][..., 0], outputs["accumulation"][..., 0], seen)
            losses["depth"] = self.config.depth_weight * wrong
        # Beside the piece that shows the object nothing is wrong: the means are those over the whole image.
        losses = {name: batch.get("share", 1.0) * loss for name, loss in losses.items()}
        if self.config.use_scale_regularization and self.step % 10 == 0:  # as often as Splatfacto
            losses["scale_reg"] = 0.1 * spike_loss(self.scales, self.config.max_gauss_ratio)
        return losses

    def _downscale_labels(self, labels: Tensor) -> Tensor:
        """Every d-th label, or depth: they must not mix."""
        d = self._get_downscale_factor()
        return labels[d // 2 :: d, d // 2 :: d][: labels.shape[0] // d, : labels.shape[1] // d]


@dataclass
class SemanticPipelineConfig(VanillaPipelineConfig):
    """Stage 1."""

    _target: type = field(default_factory=lambda: SemanticPipeline)


class SemanticPipeline(VanillaPipeline):
    """Lets the second phase see labelled frames only, and starts it from votes."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.notes: list[str] = []
        self._has_voted = False
        self.findings: dict[str, Any] = {}
        self._slack = self.datamanager.slack
        dataset = self.datamanager.train_dataset
        self._labelled = {i for i, frame in enumerate(dataset.metadata["frames"]) if frame.labels is not None}
        if self.datamanager.test_mode == "val":
            if (strange := looks_elsewhere(self.datamanager.capture, self._state)) is not None:
                self.notes.append(f"{self._state.name}: {strange}; {OTHER_WORLDS_MEND}.")
            self._note_depth()
            self._views = list(dataset.views)
            wanted, contradicted = self.model.config.refine_cameras, self._slack.pixels > 0
            # Where no silhouettes tell whether cameras are exact, refining them does.
            self._tries = wanted == "auto" and not contradicted and any(v.alpha is None for v in self._views)
            self._refines = wanted == "on" or self._tries or (wanted == "auto" and contradicted)
            if contradicted and not self._refines:
                self.notes.append(
                    f"{self._state.name}: the silhouettes contradict each other by {self._slack.pixels} pixels, so "
                    "cameras or masks are not exact; --refine-cameras off leaves them so."
                )
            self._given = torch.stack([view.viewmat for view in self._views]).double()
            self.model.viewmats = self._given.to(self.device)
            digest = training_digest(self.datamanager.capture, self.datamanager.dataparser.config.state)
            self.model.trained_on = torch.tensor(list(digest), dtype=torch.uint8, device=self.device)

    @property
    def _state(self) -> State:
        return self.datamanager.capture.states[self.datamanager.dataparser.config.state]

    def _note_depth(self) -> None:
        """Say so where frames have a depth that others contradict."""
        share = self.datamanager.measured.confirmed
        if any(view.depth is not None for view in self.datamanager.measured.views):
            self.findings["depth"] = {"confirmed": round(share, 3)}
            if share < LEAST_CONFIRMED:
                self.notes.append(
                    f"{self._state.name}: other frames confirm {share:.0%} of the frames' depth, so it is not used; a "
                    "count must be depth_unit_scale_factor (0.001 if that is missing) of the poses' unit."
                )

    def get_train_loss_dict(self, step: int):
        if self.model.learns_parts:
            camera, batch = self._next_labelled(step)
            outputs = self._model(camera)
            return outputs, self.model.get_loss_dict(outputs, batch), self.model.get_metrics_dict(outputs, batch)
        return super().get_train_loss_dict(step)

    def _next_labelled(self, step: int):
        """The next labelled frame that is trusted; others are passed over."""
        while True:
            camera, batch = self.datamanager.next_train(step)
            if batch["image_idx"] in self._labelled:
                return camera, batch

    def get_training_callbacks(self, training_callback_attributes) -> list[TrainingCallback]:
        start, steps = self.model.config.semantic_start, training_callback_attributes.trainer.config.max_num_iterations
        if start >= steps:
            raise InputError(
                f"The run ends after {steps} steps and the parts are learned from step {start} on; "
                f"raise --max-num-iterations or lower --pipeline.model.semantic-start."
            )
        callbacks = super().get_training_callbacks(training_callback_attributes)
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        if self._refines:
            callbacks.append(TrainingCallback(before, self._refine_cameras))
        callbacks.append(TrainingCallback(before, self._even_exposures))
        callbacks.append(TrainingCallback(before, self._keep_inside))
        callbacks.append(TrainingCallback(before, self._vote))
        return callbacks

    def _keep_inside(self, step: int) -> None:
        """Before every refinement: no Gaussians outside the silhouettes, where all frames have one, or seen by no view;
        and, where cameras are exact, no fog."""
        config = self.model.config
        if step % config.refine_every != 0 or not 0 < step <= config.semantic_start:
            return
        if all(view.alpha is not None for view in self._views):
            means = self.model.means.detach().cpu()
            outside = ~inside_silhouettes(self._views, means, 2 + self._slack.pixels, self._slack.views)
            self.model.fade(outside if self._refines else outside | self._is_fog(means))

    def _is_fog(self, means: Tensor) -> Tensor:
        """Which Gaussians [N] fill a hollow: wide ones that views see past to a surface.

        Of two cupboards without texture half and more of what lies far from the surface is found so, of a table of rods
        nothing that is right; without looking at the width 5 % of it.
        """
        widths = self.model.scales.detach().cpu().exp().sort(dim=-1).values[:, 1]
        return self.datamanager.found.passed(means, widths, self.datamanager.voxel)

    def _refine_cameras(self, step: int) -> None:
        """Where it is time for it, move the cameras of the training frames."""
        due = [p for p in PASSES if step == round(p.at * self.model.config.semantic_start)]
        if not due or not self._refines:
            return
        splat, pixels = self.model.splat.detach(), due[-1].pixels
        found = refine_cameras(splat, self._views, self._given, pixels, self.datamanager.outlined)
        if self._tries and due[-1] is TRIED and image_shift(found, self._given, self._views) < EXACT_PIXELS:
            self._refines = False
            found = self._given.to(found)
        self._move_cameras(found)
        if self._refines and due[-1] is PASSES[-1]:
            self._note_cameras()

    def _move_cameras(self, viewmats: Tensor) -> None:
        """Let the training frames have world-to-camera matrices [N, 4, 4]."""
        self.model.viewmats = viewmats
        self.model.cameras_refined = torch.tensor(self._refines, device=self.device)
        pairs = zip(self._views, viewmats.float().cpu(), strict=True)
        self._views = [replace(view, viewmat=viewmat) for view, viewmat in pairs]
        poses = inverse(viewmats) * torch.tensor([1.0, -1.0, -1.0, 1.0]).to(viewmats)
        # The datamanager takes a copy of its dataset's whenever it loads images, those of an evaluation, too.
        for cameras in (self.datamanager.train_cameras, self.datamanager.train_dataset.cameras):
            cameras.camera_to_worlds.copy_(poses[:, :3].to(cameras.camera_to_worlds))
        if self._slack.pixels > 0:
            self._slack = slack(self._views)[0]

    def _note_cameras(self) -> None:
        """Say by how much cameras were moved, and why."""
        viewmats = self.model.viewmats
        change, shift = camera_change(viewmats, self._given), image_shift(viewmats, self._given, self._views)
        before, now = self.datamanager.slack.pixels, self._slack.pixels
        self.findings["cameras"] = {**asdict(change), "pixels": shift, "slack_pixels": [before, now]}
        moved = f"turned by {change.degrees:.2f} deg and moved by {change.percent:.2f} % of their distance"
        if 0 < before <= now:
            why = f"contradict each other by {now} pixels, and refining them did not help: they were {moved}"
            if shift < EXACT_PIXELS:  # silhouettes have gaps where such parts are
                why += f", {shift:.1f} pixels in the images; if no part is thinner than a pixel, as cables are,"
            else:
                why += ";"
            why += " check poses, intrinsics and masks"
        elif before > 0:
            why = f"contradicted each other by {before} pixels; they were {moved}, and now do so by {now}"
        else:
            why = f"were {moved}, so that images agree: {shift:.1f} pixels where they look"
        self.notes.append(f"{self._state.name}: the cameras {why}.")

    def _even_exposures(self, step: int) -> None:
        """Where it is time for it and they differ, bring the training frames to one exposure."""
        model = self.model
        due = [at for at in EVENED if step == round(at * model.config.semantic_start)]
        if not due or step < LEAST_STEPS:
            return
        # As they were taken: of an evened image nothing tells where it was cut off.
        taken = [view.rgb for view in self.datamanager.train_dataset.views]
        views = [replace(view, rgb=rgb) for view, rgb in zip(self._views, taken, strict=True)]
        found = frame_gains(model.splat.detach(), views, model.shown_degree)
        uneven = unevenness(found, views)
        if uneven > UNEVEN:
            model.gains = self.datamanager.gains = found
            self._views = [replace(v, rgb=at_gain(v.rgb, gain)) for v, gain in zip(views, found, strict=True)]
        if due[-1] == EVENED[-1] and uneven > UNEVEN:
            self.findings["exposure"] = {"log_deviation": uneven}
            self.notes.append(
                f"{self._state.name}: the frames' exposures differ by {100 * uneven:.0f} %; they were evened."
            )

    def _vote(self, step: int) -> None:
        """Where the second phase begins: which frames' labels to trust, and what they say together."""
        if step < self.model.config.semantic_start or self._has_voted:
            return
        self._has_voted = True
        frames, labelled = self.datamanager.train_dataset.metadata["frames"], sorted(self._labelled)
        splat = self.model.splat.detach()
        votes, shown = ballots(splat, [self._views[i] for i in labelled], self.model.num_parts)
        kept = trusted(votes, shown)
        for i in (labelled[v] for v in (~kept).nonzero()[:, 0].tolist()):
            self.notes.append(f"{frames[i].labels}: contradicts the other frames' labels and is not used.")
            CONSOLE.log(self.notes[-1], markup=False)
        self._labelled = {labelled[v] for v in kept.nonzero()[:, 0].tolist()}
        self.model.trusted[sorted(self._labelled)] = True
        if not self.model.config.vote_init:
            return
        told = (shown[kept] >= TOLD).any(0)
        semantics = self.model.gauss_params["semantics"]
        # Adam makes steps as long of the faint gradients of what lies behind others.
        semantics.register_hook(lambda gradient: gradient * told[:, None])
        if step == self.model.config.semantic_start:
            with torch.no_grad():
                semantics.copy_(spread(splat, vote_logits(votes[kept]), told))
