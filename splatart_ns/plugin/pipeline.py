"""What the pipelines of all stages share."""

from __future__ import annotations

from typing import Any

from nerfstudio.pipelines.base_pipeline import VanillaPipeline

from splatart_ns.errors import InputError


class StagePipeline(VanillaPipeline):
    """A stage that is trained as a whole: what it made of views and cameras on the way, no checkpoint brings back."""

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Take over a checkpoint, to look at it.

        Raises:
            InputError: in training; nerfstudio's optimizers would go on with the tensors that they had before.
        """
        if self.datamanager.test_mode == "val":  # as the Trainer alone has it
            raise InputError(
                "A stage is trained as a whole and does not go on from a checkpoint; leave --load-dir and "
                "--load-checkpoint out."
            )
        super().load_pipeline(loaded_state, step)
