"""What a policy is trained with: advantages, PPO's losses and the mirror loss."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pup.policy.mirror import MirrorMap
from pup.policy.network import ProjectedPolicy, log_probability

Array = NDArray[np.float32]
MIRRORED = 4
"""One sample in so many is mirrored."""


@dataclass(frozen=True)
class LossWeights:
    """Weights of the losses.

    Attributes:
      clip: largest change of a probability ratio that is followed (Schulman et al. 2017).
      value: of half the squared error of values.
      entropy: of the policy's entropy per joint.
      mirror: of the squared distance, summed over bins and averaged over joints, between a state's
        probabilities and the mirrored ones of the mirrored state; both are moved (Yu et al. 2018,
        there on means with weight 4). 0 for none.
    """

    clip: float = 0.2
    value: float = 1.0
    entropy: float = 0.0
    mirror: float = 1.0


class Samples(NamedTuple):
    """Transitions of a minibatch; n of them.

    Attributes:
      proprioception: shape (n, n_entries).
      parameters: mu as given to the policy, shape (n, n_parameters).
      privileged: what the value function sees besides, shape (n, n_privileged).
      bins: actions, shape (n, joints).
      log: logarithm of the actions' probability when they were drawn, shape (n,).
      advantages: normalised, shape (n,).
      returns: normalised, shape (n,).
    """

    proprioception: Tensor
    parameters: Tensor
    privileged: Tensor
    bins: Tensor
    log: Tensor
    advantages: Tensor
    returns: Tensor


class Losses(NamedTuple):
    """Scalars.

    Attributes:
      total: what is descended.
      policy: of PPO's surrogate.
      value: half the mean squared error, in variances of the returns.
      mirror: unweighted.
      entropy: per joint, nats.
      kl: divergence from the policy that drew the actions, nats; Schulman's estimate.
      clipped: share of samples whose ratio is beyond the clip.
    """

    total: Tensor
    policy: Tensor
    value: Tensor
    mirror: Tensor
    entropy: Tensor
    kl: Tensor
    clipped: Tensor


class TorchMirror:
    """A mirror map for tensors.

    Args:
      mirror: the map.
      device: where the tensors are.
    """

    def __init__(self, mirror: MirrorMap, device: str = "cpu") -> None:
        self.entries, self.signs, self.parameters, self.logits = (
            torch.from_numpy(told).to(device)
            for told in (mirror.entries, mirror.signs, mirror.parameters, mirror.logits)
        )

    def observation(self, proprioception: Tensor) -> Tensor:
        """The mirrored robot's observation, same shape."""
        return proprioception.index_select(-1, self.entries) * self.signs

    def probabilities(self, told: Tensor) -> Tensor:
        """Mirrored probabilities, shape (n, bins, joints)."""
        return _Exchange.apply(told.flatten(-2), self.logits).view_as(told)


class _Exchange(torch.autograd.Function):
    """Columns in another order, an involution: its gradient is exchanged alike, not scattered."""

    @staticmethod
    def forward(context: Any, columns: Tensor, order: Tensor) -> Tensor:
        context.save_for_backward(order)
        return columns.index_select(-1, order)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (order,) = context.saved_tensors
        return gradient.index_select(-1, order), None


def losses(
    policy: ProjectedPolicy, samples: Samples, weights: LossWeights, mirror: TorchMirror | None
) -> Losses:
    """PPO's losses of a minibatch, and the mirror loss of some of it."""
    count = len(samples.log)
    seen, parameters, few = with_mirrored(samples, weights, mirror)
    whole = torch.log_softmax(policy(seen, parameters), dim=-2)
    log, other = whole.split([count, few])
    apart = whole.new_zeros(())
    if mirror is not None and few:
        off = other.exp() - mirror.probabilities(log[:few].exp())
        apart = off.square().sum() / (few * policy.shape.joints)
    change = log_probability(log, samples.bins) - samples.log
    ratio = change.exp()
    kept = ratio.clamp(1 - weights.clip, 1 + weights.clip)
    surrogate = -torch.minimum(ratio * samples.advantages, kept * samples.advantages).mean()
    with torch.set_grad_enabled(weights.entropy > 0 and torch.is_grad_enabled()):
        entropy = -(log.exp() * log).sum() / (count * policy.shape.joints)
    error = policy.value(samples.proprioception, samples.privileged) - samples.returns
    value = 0.5 * error.square().mean()
    total = surrogate + weights.value * value + weights.mirror * apart - weights.entropy * entropy
    with torch.no_grad():
        kl = (ratio - 1 - change).mean()
        clipped = (ratio != kept).float().mean()
    return Losses(total, surrogate, value, apart, entropy, kl, clipped)


def with_mirrored(
    samples: Samples, weights: LossWeights, mirror: TorchMirror | None
) -> tuple[Tensor, Tensor, int]:
    """Observations and mu, then those of mirrored samples, and how many these are.

    A share of the samples is mirrored, which are shuffled: enough for a tendency, and cheaper.
    """
    seen, parameters = samples.proprioception, samples.parameters
    if mirror is None or weights.mirror <= 0:
        return seen, parameters, 0
    few = len(samples.log) // MIRRORED
    seen = torch.cat([seen, mirror.observation(seen[:few])])
    mirrored = parameters[:few].index_select(-1, mirror.parameters)
    return seen, torch.cat([parameters, mirrored]), few


def advantages(
    rewards: Array,
    values: Array,
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    discount: float,
    decay: float,
) -> Array:
    """Generalised advantage estimates (Schulman et al. 2016), shape (T, N).

    Where an episode ends, the next slot is its simulation's reset: no transition, with a reward of
    0, and nothing flows back from it. Its value still is that of the episode's last state.

    Args:
      rewards: of steps, shape (T, N).
      values: of the states before each step and after the last, shape (T + 1, N).
      terminated: ends without a future, shape (T, N).
      truncated: ends by the clock, whose future the value tells, shape (T, N).
      discount: of the future, gamma.
      decay: lambda.
    """
    errors = rewards + discount * values[1:] * ~terminated - values[:-1]
    carried = discount * decay * ~(terminated | truncated)
    told = np.empty_like(errors)
    ahead = np.zeros_like(errors[0])
    for t in reversed(range(len(errors))):
        ahead = errors[t] + carried[t] * ahead
        told[t] = ahead
    return told
