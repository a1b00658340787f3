"""The method `splatart-joint`: stages 3 to 5, joints, tree and a splat that can be posed."""

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.plugins.types import MethodSpecification

from splatart_ns.plugin import compat  # noqa: F401  (lets torch read nerfstudio's checkpoints)
from splatart_ns.plugin.datamanager import SplatartDatamanagerConfig
from splatart_ns.plugin.dataparser import SplatartDataParserConfig
from splatart_ns.plugin.joint import JointModelConfig, JointPipelineConfig, JointTrainerConfig

# Nothing learns in this method, but nerfstudio wants an optimizer for every group of parameters.
GROUPS = ("means", "scales", "quats", "opacities", "features_dc", "features_rest", "semantics")

method = MethodSpecification(
    config=JointTrainerConfig(
        method_name="splatart-joint",
        max_num_iterations=1,
        mixed_precision=False,
        pipeline=JointPipelineConfig(
            datamanager=SplatartDatamanagerConfig(dataparser=SplatartDataParserConfig()),
            model=JointModelConfig(),
        ),
        optimizers={group: {"optimizer": AdamOptimizerConfig(), "scheduler": None} for group in GROUPS},
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="SPLATART stages 3 to 5: joints and kinematic tree; the viewer shows one slider a joint",
)
