"""Projection, policy and value function (paper, section IV), in plain torch.

Logits have the layout (batch, bins, joints), **bins-major**, everywhere: a softmax over the middle
axis of so small a block is several times as fast as over the last one. In a weight matrix or where
they are flat, the logit of bin b at joint j stands at b * joints + j.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from pup.policy.shape import PolicyShape

CLIP = 5.0
"""Standard deviations at which normalised observations end (the authors' filter)."""
FLOOR = 1e-6
"""Least variance; an entry that never changes stays near 0."""
SPREAD = 0.7
"""Standard deviation, in bins about the middle, of the actions of a policy that learnt nothing.

With all bins alike the noise of 20 joints throws the robot before what one of them did can be told
from chance: after 0.4 M steps it falls after 1.1 s, with 1.0 after 5.5 s, with 0.7 after 8 s. Less
keeps it up longer still, but leaves the outer bins out of reach.
"""


class Normaliser(torch.nn.Module):
    """Running mean and variance of what it is shown, in buffers.

    Args:
      size: entries of a sample.
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))

    @property
    def scale(self) -> Tensor:
        """Standard deviations, shape (size,)."""
        return self.variance.clamp(min=FLOOR).sqrt()

    def forward(self, samples: Tensor) -> Tensor:
        """Samples with mean 0 and variance 1, clipped; shape (..., size)."""
        return ((samples - self.mean) / self.scale).clamp(-CLIP, CLIP)

    @torch.no_grad()
    def update(self, samples: Tensor) -> None:
        """Take samples, shape (n, size), into account (Chan, Golub and LeVeque 1979)."""
        added = samples.shape[0]
        total = self.count + added
        variance, mean = torch.var_mean(samples, dim=0, correction=0)
        off = mean - self.mean
        share = added / total
        self.variance.mul_(1 - share).add_(share * (variance + (1 - share) * off**2))
        self.mean.add_(share * off)
        self.count.copy_(total)


class ProjectedPolicy(torch.nn.Module):
    """A policy conditioned on eta, the projection of mu to it, and a value function.

    The value function sees the true mu in place of eta, and the course that the robot is on: it is
    used in training alone, where these are known. Its values are in units of the standard deviation
    of returns.

    Args:
      shape: sizes.
    """

    def __init__(self, shape: PolicyShape) -> None:
        super().__init__()
        self.shape = shape
        self.observations = Normaliser(shape.proprioception)
        self.returns = Normaliser(1)
        if shape.latent:
            self.projection = _layers(shape.parameters, shape.projection, shape.latent, 1.0)
        self.actor = _layers(
            shape.proprioception + shape.eta, shape.hidden, shape.bins * shape.joints, 0.01
        )
        middle = torch.full((shape.joints,), (shape.bins - 1) / 2)
        self.actor[-1].bias.data = bell(middle, shape.bins).flatten()
        self.critic = _layers(shape.proprioception + shape.privileged, shape.hidden, 1, 1.0)

    def project(self, parameters: Tensor) -> Tensor:
        """What the policy is conditioned on, shape (n, eta).

        Args:
          parameters: mu on the unit scale of the bounds, shape (n, n_parameters); not looked at
            by a policy that sees none.
        """
        told = self.conditions(parameters)
        return torch.tanh(self.projection(told)) if self.shape.latent else told

    def conditions(self, parameters: Tensor) -> Tensor:
        """Mu about 0: all of it where it is projected, else what the policy sees of it."""
        centred = 2 * parameters - 1
        return centred if self.shape.latent else centred[..., : self.shape.eta]

    def logits(self, proprioception: Tensor, eta: Tensor) -> Tensor:
        """Logits of the bins, shape (n, bins, joints)."""
        flat = self.actor(torch.cat([self.observations(proprioception), eta], dim=-1))
        return flat.unflatten(-1, (self.shape.bins, self.shape.joints))

    def forward(self, proprioception: Tensor, parameters: Tensor) -> Tensor:
        """Logits by mu, shape (n, bins, joints)."""
        return self.logits(proprioception, self.project(parameters))

    def value(self, proprioception: Tensor, privileged: Tensor) -> Tensor:
        """Values in units of the returns' standard deviation from their mean, shape (n,)."""
        known = self.observations(proprioception), privileged
        return self.critic(torch.cat(known, dim=-1))[..., 0]

    @torch.no_grad()
    def sharpen(self, factor: float) -> None:
        """Multiply all logits: above one, actions scatter less about what they are on average."""
        last = self.actor[-1]
        last.weight.mul_(factor)
        last.bias.mul_(factor)

    @torch.no_grad()
    def learn_returns(self, returns: Tensor) -> None:
        """Take returns, shape (n,), into account without a change of what values mean.

        The last layer is moved against the normaliser (PopArt, van Hasselt et al. 2016).
        """
        mean, scale = self.returns.mean.clone(), self.returns.scale
        self.returns.update(returns[:, None])
        last = self.critic[-1]
        last.weight.mul_(scale / self.returns.scale)
        last.bias.mul_(scale).add_(mean - self.returns.mean).div_(self.returns.scale)


def expected(logits: Tensor) -> Tensor:
    """The mean of the bins of each joint, between 0 and bins - 1, shape (n, joints).

    What a policy does when it does not explore. The likeliest bin is a poor stand-in: it stays in
    the middle until another one has more than a third of the probability.
    """
    order = torch.arange(logits.shape[-2], dtype=logits.dtype, device=logits.device)
    return torch.einsum("...bj,b->...j", torch.softmax(logits, dim=-2), order)


def bell(about: Tensor, bins: int) -> Tensor:
    """Logits of bells of SPREAD over the bins, shape (..., bins, joints).

    Args:
      about: the bin that each joint's bell stands over, shape (..., joints).
      bins: of a joint.
    """
    off = torch.arange(bins, dtype=about.dtype)[:, None] - about[..., None, :]
    return -(off**2) / (2 * SPREAD**2)


def draw(logits: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
    """Draw bins.

    Args:
      logits: shape (n, bins, joints).
      uniform: a number in [0, 1) per joint, shape (n, joints).

    Returns:
      Bins, shape (n, joints), and the logarithm of their probability together, shape (n,).
    """
    log = torch.log_softmax(logits, dim=-2)
    below = log.exp().cumsum(dim=-2) <= uniform[..., None, :]
    bins = below.sum(dim=-2).clamp(max=logits.shape[-2] - 1)
    return bins, log_probability(log, bins)


def log_probability(log: Tensor, bins: Tensor) -> Tensor:
    """Logarithm of the probability of bins at all joints together, shape (n,).

    Args:
      log: logarithms of each bin's probability, shape (n, bins, joints).
      bins: shape (n, joints).
    """
    return log.gather(-2, bins[..., None, :]).sum(dim=(-2, -1))


def _layers(inputs: int, hidden: Sequence[int], outputs: int, last: float) -> torch.nn.Sequential:
    """Linear layers with tanh between them; rows of unit norm, the last layer's of norm `last`."""
    sizes = (inputs, *hidden, outputs)
    layers: list[torch.nn.Module] = []
    for i, (before, after) in enumerate(pairwise(sizes)):
        layer = torch.nn.Linear(before, after)
        norm = last if i == len(hidden) else 1.0
        with torch.no_grad():
            layer.weight.normal_()
            layer.weight.mul_(norm / layer.weight.norm(dim=1, keepdim=True))
            layer.bias.zero_()
        layers += [layer, torch.nn.Tanh()]
    return torch.nn.Sequential(*layers[:-1])
