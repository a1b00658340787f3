"""The method `splatart-semantic`: stage 1, one labelled splat of one state."""

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.plugins.types import MethodSpecification

from splatart_ns.plugin.compat import FusedAdamOptimizerConfig
from splatart_ns.plugin.datamanager import SplatartDatamanagerConfig
from splatart_ns.plugin.dataparser import SplatartDataParserConfig
from splatart_ns.plugin.semantic import SemanticModelConfig, SemanticPipelineConfig
from splatart_ns.plugin.trainer import StageTrainerConfig

STEPS = 1000
PART_STEPS = 100


def _adam(lr: float, final: float | None = None) -> dict:
    scheduler = None if final is None else ExponentialDecaySchedulerConfig(lr_final=lr * final, max_steps=STEPS)
    return {"optimizer": FusedAdamOptimizerConfig(lr=lr, eps=1e-15), "scheduler": scheduler}


method = MethodSpecification(
    config=StageTrainerConfig(
        method_name="splatart-semantic",
        steps_per_save=2000,
        steps_per_eval_batch=0,
        steps_per_eval_image=500,
        steps_per_eval_all_images=0,
        max_num_iterations=STEPS + PART_STEPS,
        mixed_precision=False,
        pipeline=SemanticPipelineConfig(
            datamanager=SplatartDatamanagerConfig(dataparser=SplatartDataParserConfig(), seed_gaussians=8000),
            model=SemanticModelConfig(
                semantic_start=STEPS,
                num_downscales=1,
                sh_degree_interval=100,
                warmup_length=300,
                stop_split_at=700,
                stop_screen_size_at=0,  # splitting by size on the screen knows no bound
                refine_every=100,
                reset_alpha_every=1000,
                cull_alpha_thresh=0.02,
                use_absgrad=False,
                densify_grad_thresh=2e-4,
            ),
        ),
        # Rates for a world in which the object has a radius of about 1.
        optimizers={
            "means": _adam(1.2e-3, 0.02),
            "scales": _adam(1e-2),
            "quats": _adam(1e-2),
            "opacities": _adam(5e-2),
            "features_dc": _adam(1.5e-2),
            "features_rest": _adam(1e-3),
            "semantics": _adam(5e-2),
        },
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="SPLATART stage 1: a Gaussian splat of one state whose Gaussians know their part",
)
