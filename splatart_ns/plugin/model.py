"""A Splatfacto that runs with and without CUDA and knows the parts of its Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.models.base_model import Model
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from splatart_ns.choices import Rasterizer
from splatart_ns.errors import InputError
from splatart_ns.geometry.camera import viewmat_from_opengl
from splatart_ns.plugin.compat import StartView
from splatart_ns.plugin.gaussians import gauss_params_from_splat, random_splat, splat_from_points
from splatart_ns.rasterize.rasterization import set_backend
from splatart_ns.rasterize.render import Rendering, render
from splatart_ns.rasterize.ssim import ssim
from splatart_ns.splats.palette import part_colours
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.semantic import part_image


@dataclass
class SplatartModelConfig(SplatfactoModelConfig):
    """What all SPLATART models share."""

    _target: type = field(default_factory=lambda: SplatartModel)
    num_random: int = 8000
    """Number of random Gaussians to start from, when neither points nor silhouettes say where the object is."""
    random_scale: float = 2.0
    """Side of the cube of random Gaussians; 2 is what the cameras see at the distance of their focus."""
    background_color: Literal["random", "black", "white"] = "white"
    """Background of rendered images: random (in training), black or white."""
    sh_degree: int = 1
    """Degree of the spherical harmonics; higher ones pay where surfaces shine."""
    lpips: bool = False
    """Whether evaluation computes LPIPS, whose weights are downloaded on first use."""
    rasterizer: Rasterizer = "auto"
    """For the whole process; auto: what was chosen before, else gsplat on CUDA, numba where installed, torch."""


_READ = {"background_color", "camera_optimizer", "rasterize_mode"}
"""The options of Splatfacto that say how a splat is shown, or are refused by all models."""


def refuse_unread(config: SplatartModelConfig, method: str) -> None:
    """Raise `InputError` for an option of Splatfacto's that a later stage's method would pass over."""
    usual = type(config)()
    for name in (one.name for one in fields(SplatfactoModelConfig) if one.name not in _READ):
        if (value := getattr(config, name)) != getattr(usual, name):
            option = f"--pipeline.model.{name.replace('_', '-')}"
            raise InputError(
                f"{option} is {value}, but {method} does not read it; leave it out, or give it to splatart-semantic."
            )


class SplatartModel(SplatfactoModel):
    """Splatfacto with part logits; everything it renders comes out of one rasterization."""

    config: SplatartModelConfig
    shows_surroundings = False
    """Whether also what lies around the object is modelled, where images do not tell where it ends."""

    def populate_modules(self) -> None:
        """Gaussians from seed points or at random, strategy and metrics; nothing is downloaded."""
        if (mode := self.config.camera_optimizer.mode) != "off":
            raise InputError(
                f"--pipeline.model.camera-optimizer.mode is {mode}, but later stages do not read what it finds; leave "
                "it off, and refine cameras by --pipeline.model.refine-cameras on of splatart-semantic."
            )
        if self.config.use_bilateral_grid:
            raise InputError(
                "--pipeline.model.use-bilateral-grid is True, but there is none in SPLATART's models; leave it out: "
                "splatart-semantic brings frames to one exposure without it."
            )
        if self.config.color_corrected_metrics:
            raise InputError(
                "--pipeline.model.color-corrected-metrics is True, but SPLATART's models measure images as they are; "
                "leave it out: splatart-semantic brings frames to one exposure."
            )
        if not 0 <= (degree := self.config.sh_degree) <= 3:
            raise InputError(f"--pipeline.model.sh-degree is {degree}; give 0 to 3.")
        if self.config.num_random < 1:
            raise InputError(f"--pipeline.model.num-random is {self.config.num_random}; give 1 or more.")
        if self.config.rasterizer != "auto":
            set_backend(self.config.rasterizer)
            if self.config.rasterizer == "numba" and torch.device(self.kwargs.get("device", "cpu")).type != "cpu":
                raise InputError("The numba rasterizer runs on the CPU: add --machine.device-type cpu, or take auto.")
        metadata = self.kwargs["metadata"]
        self.part_names = metadata["part_names"]
        self.num_parts = len(self.part_names) - 1
        first_camera = metadata["normalization"].camera_to_normal(metadata["frames"][0].T_world_camera)
        self.start_view = StartView(first_camera[:3, 3])
        if self.seed_points is not None and not self.config.random_init:
            normals = metadata.get("points3D_normals", torch.zeros_like(self.seed_points[0]))
            splat = splat_from_points(*self.seed_points, normals, self.config.sh_degree, self.num_parts)
        else:
            splat = random_splat(
                self.config.num_random, self.config.random_scale, self.config.sh_degree, self.num_parts
            )
        self.gauss_params = nn.ParameterDict(gauss_params_from_splat(splat))
        # Off; Splatfacto asks it for its parameters.
        self.camera_optimizer = self.config.camera_optimizer.setup(num_cameras=self.num_train_data, device="cpu")
        self.register_buffer("palette", part_colours(self.num_parts), persistent=False)
        self.step = 0
        self._told_within_rendered = False
        self.crop_box = None
        self.background_color = torch.ones(3)  # of what is not training, where that is on random colours

    @property
    def splat(self) -> Splat:
        """The Gaussians, as they are optimised."""
        p = self.gauss_params
        return Splat(
            means=p["means"],
            quats=p["quats"],
            log_scales=p["scales"],
            opacity_logits=p["opacities"][:, 0],
            sh=torch.cat([p["features_dc"][:, None], p["features_rest"]], dim=1),
            part_logits=p["semantics"],
        )

    @property
    def shown_degree(self) -> int | None:
        """The highest degree of spherical harmonics that is rendered; None: all there are."""
        return None

    def get_gaussian_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {name: [parameter] for name, parameter in self.gauss_params.items()}

    def posed_splat(self) -> Splat:
        """The Gaussians to show."""
        return self.splat

    def rasterize(self, splat: Splat, camera: Cameras, *, parts: bool, depth: bool) -> Rendering:
        """Render a splat from one nerfstudio camera, at the training resolution of this step."""
        factor = self._get_downscale_factor()
        camera.rescale_output_resolution(1 / factor)
        K = camera.get_intrinsics_matrices().to(self.device)
        width, height = int(camera.width[0].item()), int(camera.height[0].item())
        camera.rescale_output_resolution(factor)
        return render(
            splat,
            viewmat_from_opengl(camera.camera_to_worlds.to(self.device)),
            K,
            width,
            height,
            features=splat.part_probabilities if parts else None,
            with_depth=depth,
            sh_degree=self.shown_degree,
            rasterize_mode=self.config.rasterize_mode,
            absgrad=self.config.use_absgrad and self.training,
        )

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """rgb, depth, accumulation, background and, outside training, the parts as colours and their confidence."""
        splat = self.splat if self.training else self.posed_splat()
        if self.crop_box is not None and not self.training:
            splat = splat.select(self.crop_box.within(splat.means).reshape(-1))
        depth = not self.training or self.config.output_depth_during_training or "depth" in (camera.metadata or {})
        rendering = self.rasterize(splat, camera, parts=not self.training, depth=depth)
        self.info = rendering.info
        if "whole" in (camera.metadata or {}):  # the strategy measures in shares of the image
            factor = self._get_downscale_factor()
            self.info |= {
                side: x // factor for side, x in zip(("width", "height"), camera.metadata["whole"], strict=True)
            }
        accumulation = rendering.accumulation[0]
        background = self._get_background_color()
        outputs = {
            "rgb": (rendering.rgb[0] + (1 - accumulation) * background).clamp(0, 1),
            "accumulation": accumulation,
            "background": background,
        }
        if rendering.depth is not None:
            depth = rendering.depth[0]
            outputs["depth"] = torch.where(accumulation > 0, depth, depth.detach().max())
        if not self.training:
            probabilities = part_image(rendering)[0]
            outputs["parts"] = probabilities @ self.palette
            outputs["part_confidence"] = probabilities.amax(-1, keepdim=True)
            outputs["background"] = background.expand(*accumulation.shape[:2], 3)
        return outputs

    def get_metrics_dict(self, outputs, batch) -> dict[str, Tensor]:
        if self.training and self.step % 10 != 0:  # nerfstudio logs every tenth step and asks at each
            return {"gaussian_count": self.num_points}
        target = self.composite_with_background(self.get_gt_img(batch["image"]), outputs["background"])
        mse = batch.get("share", 1.0) * (outputs["rgb"].detach() - target).square().mean()
        return {"psnr": -10 * mse.clamp_min(1e-10).log10(), "gaussian_count": self.num_points}

    def get_image_metrics_and_images(self, outputs, batch) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, SSIM and LPIPS (when asked for) of one evaluation image, all its pixels, and pictures to look at.

        The object alone is compared with opaque images within its rendered silhouette, and `rendered_silhouette` is 1.
        """
        image = self.get_gt_img(batch["image"])
        within_rendered = image.shape[-1] == 3 and not self.shows_surroundings
        if within_rendered:
            image = torch.cat([image, outputs["accumulation"]], dim=-1)
            self._tell_within_rendered()
        target = self.composite_with_background(image, outputs["background"])
        rgb = outputs["rgb"]
        metrics = {
            "psnr": float(-10 * (rgb - target).square().mean().clamp_min(1e-10).log10()),
            "ssim": float(ssim(rgb, target)),
        }
        if not self.shows_surroundings:
            metrics["rendered_silhouette"] = float(within_rendered)
        if self.config.lpips:
            metrics["lpips"] = float(self._lpips()(target.movedim(-1, 0)[None], rgb.movedim(-1, 0)[None]))
        images = {"img": torch.cat([target, rgb], dim=1), "accumulation": outputs["accumulation"]}
        if "parts" in outputs:
            images["parts"] = outputs["parts"]
        return metrics, images

    def _tell_within_rendered(self) -> None:
        """Say so once."""
        if not self._told_within_rendered:
            self._told_within_rendered = True
            CONSOLE.print(
                "Images do not tell where the object ends: figures are measured within its rendered silhouette, and "
                "do not compare with those of other captures.",
                markup=False,
                soft_wrap=True,
            )

    def _lpips(self) -> nn.Module:
        """Built on first use: its constructor downloads weights."""
        if not hasattr(self, "_lpips_module"):
            from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

            # Kept out of the module's registry, so that checkpoints do not carry it.
            object.__setattr__(
                self, "_lpips_module", LearnedPerceptualImagePatchSimilarity(normalize=True).to(self.device)
            )
        return self._lpips_module

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """An output with the accumulation as its alpha [H, W, 4] (`ns-render --rendered-output-names rgba`)."""
        accumulation = outputs["accumulation"]
        premultiplied = outputs[output_name] - (1 - accumulation) * outputs["background"]
        colour = (premultiplied / accumulation.clamp_min(1e-3)).clamp(0, 1)
        return torch.cat([colour, accumulation], dim=-1)

    def load_state_dict(self, state, **kwargs):
        """Load a checkpoint with any number of Gaussians."""
        count = state["gauss_params.means"].shape[0]
        for name, parameter in list(self.gauss_params.items()):
            saved = state.get(f"gauss_params.{name}")
            shape = parameter.shape[1:] if saved is None else saved.shape[1:]
            self.gauss_params[name] = nn.Parameter(torch.zeros(count, *shape, device=self.device))
        self.step = 30000  # all SH bands are on, as Splatfacto has it
        return Model.load_state_dict(self, state, **kwargs)
