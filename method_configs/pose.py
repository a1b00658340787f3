"""The method `splatart-pose`: stage 2, part poses over all states."""

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.plugins.types import MethodSpecification

from splatart_ns.plugin.compat import FusedAdamOptimizerConfig
from splatart_ns.plugin.datamanager import SplatartDatamanagerConfig
from splatart_ns.plugin.dataparser import SplatartDataParserConfig
from splatart_ns.plugin.pose import PoseModelConfig, PosePipelineConfig
from splatart_ns.plugin.trainer import StageTrainerConfig

DESCENT_STEPS = 200
MERGE_STEPS = 400


def _adam(lr: float) -> dict:
    scheduler = ExponentialDecaySchedulerConfig(lr_final=0.05 * lr, max_steps=MERGE_STEPS)
    return {"optimizer": FusedAdamOptimizerConfig(lr=lr, eps=1e-15), "scheduler": scheduler}


method = MethodSpecification(
    config=StageTrainerConfig(
        method_name="splatart-pose",
        steps_per_save=2000,
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        max_num_iterations=MERGE_STEPS,
        mixed_precision=False,
        pipeline=PosePipelineConfig(
            datamanager=SplatartDatamanagerConfig(dataparser=SplatartDataParserConfig()),
            model=PoseModelConfig(),
        ),
        optimizers={
            "part_poses": {
                "optimizer": FusedAdamOptimizerConfig(lr=3e-3, eps=1e-15),
                "scheduler": ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=DESCENT_STEPS),
            },
            # Of the merged Gaussians, which learn again after many of them have gone.
            "means": _adam(1.4e-3),
            "scales": _adam(2e-2),
            "quats": _adam(2e-2),
            "opacities": _adam(7e-2),
            "features_dc": _adam(3.4e-2),
            "features_rest": _adam(3.4e-3),
            "semantics": _adam(7e-2),
        },
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="SPLATART stage 2: the pose of every part at every state, and part splats from all states",
)
