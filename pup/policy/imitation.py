"""Teaching a policy the actions of a teacher: behaviour cloning of bells over the bins."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pup.policy.network import ProjectedPolicy, bell

RATE = 1e-3
MINIBATCH = 1024


class Imitation:
    """Learns from all demonstrations shown so far (Ross, Gordon and Bagnell 2011, DAgger).

    What is learnt is a bell about the teacher's action, as wide as that of a policy that learnt
    nothing: the pupil explores about what it was shown.

    Args:
      policy: the pupil; its normaliser takes the observations into account.
      seed: of the order of samples.
    """

    def __init__(self, policy: ProjectedPolicy, seed: np.random.SeedSequence) -> None:
        self.policy = policy
        self._rng = np.random.default_rng(seed)
        learnt = [p for name, p in policy.named_parameters() if not name.startswith("critic")]
        self._adam = torch.optim.Adam(learnt, lr=RATE)
        self._shown: list[tuple[Tensor, Tensor, Tensor]] = []

    def show(
        self,
        proprioception: NDArray[np.float32],
        parameters: NDArray[np.float32],
        bins: NDArray[np.floating],
    ) -> None:
        """Add demonstrations, a row each.

        Args:
          proprioception: shape (n, n_entries).
          parameters: mu as told to the pupil, shape (n, n_parameters).
          bins: the teacher's actions, between 0 and bins - 1, shape (n, joints).
        """
        seen = torch.from_numpy(proprioception)
        self.policy.observations.update(seen)
        actions = torch.from_numpy(bins.astype(np.float32))
        self._shown.append((seen, torch.from_numpy(parameters), actions))

    def learn(self, epochs: int) -> None:
        """Go through all demonstrations so often."""
        seen, told, actions = (torch.cat(parts) for parts in zip(*self._shown, strict=True))
        for _ in range(epochs):
            order = torch.from_numpy(self._rng.permutation(len(seen)))
            for rows in order.split(MINIBATCH):
                self._adam.zero_grad()
                self._divergence(seen[rows], told[rows], actions[rows]).backward()
                self._adam.step()

    def _divergence(self, seen: Tensor, told: Tensor, actions: Tensor) -> Tensor:
        """Cross entropy from the bells about the teacher's actions, nats a joint."""
        log = torch.log_softmax(self.policy(seen, told), dim=-2)
        wanted = torch.softmax(bell(actions, log.shape[-2]), dim=-2)
        return -(wanted * log).sum(dim=-2).mean()
