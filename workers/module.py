"""The policy as a module of RLlib."""

from typing import Any

import numpy as np
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.torch.torch_rl_module import TorchRLModule

from pup.policy.network import ProjectedPolicy
from pup.policy.shape import PolicyShape


class PolicyModule(TorchRLModule, ValueFunctionAPI):
    """Wraps a ProjectedPolicy.

    The model's configuration holds its `shape`, the `seed` of its weights, and `start`, weights by
    name in their place or None.
    """

    def setup(self) -> None:
        """See RLModule."""
        shape = PolicyShape.read(self.model_config["shape"])
        with torch.random.fork_rng():
            torch.manual_seed(self.model_config["seed"])
            self.policy = ProjectedPolicy(shape)
        if self.model_config["start"]:
            load(self.policy, self.model_config["start"])

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        """Logits of samples that hold an observation and mu."""
        return {Columns.ACTION_DIST_INPUTS: self.policy(batch[Columns.OBS], batch["parameters"])}

    def _forward_train(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        """Nothing: the losses call the policy themselves, once for states and mirrored states."""
        return {}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        """Values in units of the returns, shape (n,)."""
        policy = self.policy
        told = policy.value(batch[Columns.OBS], batch["privileged"])
        return told * policy.returns.scale + policy.returns.mean


def load(policy: ProjectedPolicy, weights: dict[str, np.ndarray]) -> None:
    """Give a policy weights and buffers by name; all of them and no others."""
    policy.load_state_dict({k: torch.from_numpy(np.array(v)) for k, v in weights.items()})
