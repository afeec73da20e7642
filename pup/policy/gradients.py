"""The losses of `pup.policy.losses` and their gradients, written out.

An iteration takes hundreds of steps of a few hundred samples. On a processor, autograd's records of
such small operations take a fifth of each step. Numbers are the same. On a GPU it was not tried.
"""

from collections.abc import Sequence
from itertools import islice

import torch
from torch import Tensor

from pup.policy.losses import Losses, LossWeights, Samples, TorchMirror, with_mirrored
from pup.policy.network import ProjectedPolicy, log_probability


@torch.no_grad()
def differentiated(
    policy: ProjectedPolicy, samples: Samples, weights: LossWeights, mirror: TorchMirror | None
) -> tuple[Losses, tuple[Tensor, ...]]:
    """Losses of a minibatch as `losses` has them, and the gradients of their total.

    Returns:
      The losses, and a gradient for each of the policy's parameters in their order.
    """
    count, joints = len(samples.log), policy.shape.joints
    seen, parameters, few = with_mirrored(samples, weights, mirror)
    seen = policy.observations(seen)
    projected, eta = [], policy.conditions(parameters)
    if policy.shape.latent:
        projected = _forward(policy.projection, eta)
        eta = projected[-1].tanh()
    acted = _forward(policy.actor, torch.cat([seen, eta], dim=-1))
    log = torch.log_softmax(acted[-1].unflatten(-1, (policy.shape.bins, joints)), dim=-2)
    chance = log.exp()
    slope = torch.empty_like(chance)  # of the total by the logits
    surrogate, change, ratio, clipped = _surrogate(
        log[:count], chance[:count], samples, weights.clip, slope[:count]
    )
    own = chance[:count] * log[:count]
    entropy = -own.sum() / (count * joints)
    if weights.entropy > 0:
        own -= chance[:count] * own.sum(dim=-2, keepdim=True)
        slope[:count].add_(own, alpha=weights.entropy / (count * joints))
    apart = log.new_zeros(())
    if mirror is not None and few:
        off = chance[count:] - mirror.probabilities(chance[:few])
        apart = off.square().sum() / (few * joints)
        off *= 2 * weights.mirror / (few * joints)
        slope[count:] = _by_logits(off, chance[count:])
        slope[:few] -= _by_logits(mirror.probabilities(off), chance[:few])
    judged = _forward(policy.critic, torch.cat([seen[:count], samples.privileged], dim=-1))
    error = judged[-1] - samples.returns[:, None]
    value = 0.5 * error.square().mean()
    _, critic = _backward(policy.critic, judged, error.mul_(weights.value / count))
    inputs, actor = _backward(policy.actor, acted, slope.flatten(-2))
    projection: list[Tensor] = []
    if policy.shape.latent:
        by_eta = inputs[:, seen.shape[1] :] * (1 - eta.square())
        _, projection = _backward(policy.projection, projected, by_eta)
    total = surrogate + weights.value * value + weights.mirror * apart - weights.entropy * entropy
    kl = (ratio - 1 - change).mean()
    told = Losses(total, surrogate, value, apart, entropy, kl, clipped)
    return told, (*projection, *actor, *critic)


def _surrogate(
    log: Tensor, chance: Tensor, samples: Samples, clip: float, slope: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """PPO's surrogate, change and ratio of each action's probability, share beyond the clip.

    Args:
      log: logarithms of the bins' probabilities, shape (n, bins, joints).
      chance: the probabilities.
      samples: n of them.
      clip: largest change that is followed.
      slope: where the gradient by the logits goes, likewise.
    """
    count = len(log)
    change = log_probability(log, samples.bins) - samples.log
    ratio = change.exp()
    kept = ratio.clamp(1 - clip, 1 + clip)
    free, held = ratio * samples.advantages, kept * samples.advantages
    pull = torch.where(free <= held, free, 0.0).div_(-count)[:, None, None]
    torch.mul(chance, -pull, out=slope)
    slope.scatter_add_(-2, samples.bins[:, None], pull.expand(-1, 1, log.shape[-1]))
    return -torch.minimum(free, held).mean(), change, ratio, (ratio != kept).float().mean()


def _by_logits(gradient: Tensor, chance: Tensor) -> Tensor:
    """A gradient by the logits, of one by the probabilities; shape (n, bins, joints)."""
    weighted = gradient * chance
    return weighted - chance * weighted.sum(dim=-2, keepdim=True)


def _forward(layers: torch.nn.Sequential, inputs: Tensor) -> list[Tensor]:
    """What goes into each linear layer of those with tanh between them, and what comes out."""
    told = [inputs]
    for layer in islice(layers, 0, None, 2):
        if len(told) > 1:
            _bend(told[-1])
        told.append(torch.addmm(layer.bias, told[-1], layer.weight.t()))
    return told


def _bend(values: Tensor) -> None:
    """Their tanh, in place; a processor makes exponentials in half the time of tanh."""
    values.mul_(2).sigmoid_().mul_(2).sub_(1)


def _backward(
    layers: torch.nn.Sequential, told: Sequence[Tensor], gradient: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """Gradients by the inputs, and by weights and biases in the layers' order.

    Args:
      layers: as in `_forward`.
      told: by it.
      gradient: by what came out.
    """
    found: list[Tensor] = []
    linear = list(islice(layers, 0, None, 2))
    for place in reversed(range(len(linear))):
        found = [gradient.t() @ told[place], gradient.sum(dim=0), *found]
        gradient = gradient @ linear[place].weight
        if place:
            gradient = torch.ops.aten.tanh_backward(gradient, told[place])
    return gradient, found
