"""PPO with a mirror loss, as a learner of RLlib: from fragments to batches to weights."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from pup.policy.gradients import differentiated
from pup.policy.losses import Losses, LossWeights, Samples, TorchMirror, advantages, losses
from pup.policy.mirror import MirrorMap
from pup.policy.network import ProjectedPolicy, log_probability
from workers.module import PolicyModule, load
from workers.rollouts import Fragment

CHUNK = 16384
"""States whose values or actions are judged at once."""
IMPORTANCE = 2.0
"""Largest weight of a sample that a policy has become more likely to draw since it was drawn."""


@dataclass(frozen=True)
class Learning:
    """How the networks are moved.

    Attributes:
      epochs: passes over the samples of an iteration.
      minibatch: samples of a step.
      rate: Adam's, at the beginning.
      schedule: of the rate: `linear` falls to a tenth over the training, `adaptive` follows the
        divergence between iterations, `constant` stays.
      divergence: that `adaptive` aims at, nats.
      gradient: largest norm of a step's gradient.
      discount: of the future by a control step, gamma.
      decay: lambda of the advantages.
      weights: of the losses; that of the entropy falls to 0 over the training.
      sharpen: by which the logits grow in the course of the training, beside what is learnt: the
        less a policy explores, the faster it may walk without a fall.
      mirror: the robot's symmetry; None where the task does not have it.
      iterations: of the whole training.
      seed: of the order of samples.
      threads: of torch.
    """

    epochs: int = 5
    minibatch: int = 256
    rate: float = 3e-4
    schedule: Literal["linear", "adaptive", "constant"] = "linear"
    divergence: float = 0.01
    gradient: float = 1.0
    discount: float = 0.99
    decay: float = 0.95
    weights: LossWeights = field(default_factory=LossWeights)
    sharpen: float = 1.0
    mirror: MirrorMap | None = None
    iterations: int = 1
    seed: int = 0
    threads: int = 1


class FragmentsToBatch(ConnectorV2):
    """Makes one batch of fragments: advantages, then every epoch's samples in an order of its own.

    The samples were drawn with the weights of an iteration ago. PPO's clip would hold the policy
    near those, and let it move half as far in each iteration; here it is held near the weights that
    the iteration begins with, and samples are weighted by how much likelier they are with these
    (Hilton, Cobbe and Schulman 2022, the decoupled objective).

    A training that goes on needs no generator's state.
    """

    def __init__(self, learning: Learning) -> None:
        super().__init__()
        self.learning, self.iteration = learning, 0

    def __call__(
        self, *, rl_module: Any, episodes: Sequence[Fragment], **_: Any
    ) -> dict[str, dict[str, Any]]:
        """See ConnectorV2."""
        module = rl_module[DEFAULT_MODULE_ID].unwrapped()
        samples = merged([prepared(module, f, self.learning) for f in episodes])
        policy = module.policy
        module.shown = samples.proprioception, _unknown(policy, samples.returns)
        log = likelihoods(policy, samples)
        importance = (log - samples.log).exp().clamp(max=IMPORTANCE)
        scaled = samples._replace(
            log=log,
            advantages=_standard(samples.advantages) * importance,
            returns=(samples.returns - policy.returns.mean) / policy.returns.scale,
        )
        rng = np.random.default_rng((self.learning.seed, self.iteration))
        order = torch.from_numpy(shuffled(len(samples.log), self.learning, rng))
        order = order.to(samples.log.device)
        told = {name: v.index_select(0, order) for name, v in scaled._asdict().items()}
        return {DEFAULT_MODULE_ID: told}


def shuffled(count: int, learning: Learning, rng: np.random.Generator) -> NDArray[np.int64]:
    """The samples of all epochs in the order of their use: whole minibatches only."""
    whole = max(count // learning.minibatch * learning.minibatch, min(count, learning.minibatch))
    return np.concatenate([rng.permutation(count)[:whole] for _ in range(learning.epochs)])


def prepared(module: PolicyModule, fragment: Fragment, learning: Learning) -> Samples:
    """The transitions of a fragment; advantages and returns in the units of rewards."""
    device = next(module.parameters()).device

    def tensor(values: NDArray[Any]) -> torch.Tensor:
        # Arrays from the object store cannot be written to, which torch warns of.
        return torch.from_numpy(values if values.flags.writeable else values.copy()).to(device)

    states = [
        tensor(a).flatten(0, 1)
        for a in (fragment.proprioception, fragment.parameters, fragment.privileged)
    ]
    with torch.no_grad():
        chunks = zip(states[0].split(CHUNK), states[2].split(CHUNK), strict=True)
        told = torch.cat(
            [module.compute_values({Columns.OBS: o, "privileged": m}) for o, m in chunks]
        )
    values = told.cpu().numpy().reshape(-1, fragment.reward.shape[1])
    ahead = advantages(
        fragment.reward,
        values,
        fragment.terminated,
        fragment.truncated,
        learning.discount,
        learning.decay,
    )
    live = torch.from_numpy(np.flatnonzero(fragment.live)).to(device)
    flat = [
        tensor(a).flatten(0, 1)[live]
        for a in (fragment.bins, fragment.log[..., None], ahead[..., None])
    ]
    returns = (tensor(ahead) + tensor(values[:-1])).flatten()[live]
    seen = [s[: fragment.reward.size][live] for s in states]
    return Samples(*seen, flat[0].long(), flat[1][:, 0], flat[2][:, 0], returns)


@torch.no_grad()
def likelihoods(policy: ProjectedPolicy, samples: Samples) -> torch.Tensor:
    """Logarithms of the probabilities of the samples' actions with the weights of now, (n,)."""
    columns = (samples.proprioception, samples.parameters, samples.bins)
    chunks = zip(*(column.split(CHUNK) for column in columns), strict=True)
    told = [
        log_probability(torch.log_softmax(policy(seen, mu), dim=-2), bins)
        for seen, mu, bins in chunks
    ]
    return torch.cat(told)


def merged(samples: Sequence[Samples]) -> Samples:
    """The samples of several fragments."""
    if len(samples) == 1:
        return samples[0]
    return Samples(*(torch.cat(columns) for columns in zip(*samples, strict=True)))


def _unknown(policy: ProjectedPolicy, returns: torch.Tensor) -> torch.Tensor | None:
    """Returns to be learnt after the steps; None of the first ones, which are learnt here.

    Without a scale of them the value function's gradient would be as large as the rewards happen
    to be, and the clip, which is common to both, would leave the actor nothing. As values mean
    nothing yet, there is nothing that their last layer is to be moved for.
    """
    if policy.returns.count:
        return returns
    policy.returns.update(returns[:, None])
    return None


def _standard(values: torch.Tensor) -> torch.Tensor:
    return (values - values.mean()) / (values.std() + 1e-8)


class MirrorLearner(PPOTorchLearner):
    """PPO's learner with the losses of `pup.policy`.

    Its state is asked for and restored by itself, not through RLlib's checkpoints, which are
    pickled.
    """

    def build(self) -> None:
        """See Learner."""
        self.learning: Learning = self.config.learner_config_dict["learning"]
        torch.set_num_threads(self.learning.threads)
        super().build()
        mirror = self.learning.mirror
        self.mirror = None if mirror is None else TorchMirror(mirror, self._device)
        self.logged: list[Losses] = []
        self.skipped = self.iteration = 0

    @property
    def policy_module(self) -> PolicyModule:
        """The module, out of what wraps it."""
        return self.module[DEFAULT_MODULE_ID].unwrapped()

    @property
    def optimizer(self) -> torch.optim.Adam:
        """The only one."""
        return self.get_optimizer(DEFAULT_MODULE_ID)

    def configure_optimizers_for_module(self, module_id: str, config: Any = None) -> None:
        """See Learner."""
        # One vector, of which the weights are views: Adam and the clip handle it at once.
        self.parameters = list(self.policy_module.policy.parameters())
        self.vector = parameters_to_vector(self.parameters).detach()
        vector_to_parameters(self.vector, self.parameters)
        adam = torch.optim.Adam([self.vector], lr=self.learning.rate, eps=1e-5, fused=True)
        self.register_optimizer(
            module_id=module_id,
            optimizer=adam,
            params=[self.vector],
            lr_or_lr_schedule=self.learning.rate,
        )

    def before_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        """See Learner."""
        super().before_gradient_based_update(timesteps=timesteps)
        (connector,) = self._learner_connector.connectors
        connector.iteration = self.iteration

    def _update(self, batch: dict[str, Any], **_: Any) -> tuple[Any, Any, Any]:
        """All steps of an iteration; RLlib asks for each by itself, for a third of its time.

        See TorchLearner.
        """
        given = batch[DEFAULT_MODULE_ID]
        columns = (given[name].split(self.learning.minibatch) for name in Samples._fields)
        weights = self._weights_now()
        for minibatch in zip(*columns, strict=True):
            self._step(Samples(*minibatch), weights)
        return {}, {DEFAULT_MODULE_ID: self.logged[-1].total}, {}

    def _step(self, samples: Samples, weights: LossWeights) -> None:
        """Descend by a minibatch; gradients that are no numbers move nothing, and are counted."""
        given = self.policy_module.policy, samples, weights, self.mirror
        if self._device.type == "cpu":
            told, gradients = differentiated(*given)
        else:
            told = losses(*given)
            gradients = torch.autograd.grad(told.total, self.parameters)
        gradient = torch.cat([one.flatten() for one in gradients])
        norm = torch.linalg.vector_norm(gradient)
        if torch.isfinite(norm):
            self.vector.grad = gradient.mul_((self.learning.gradient / norm).clamp(max=1.0))
            self.optimizer.step()
        else:
            self.skipped += 1
        self.logged.append(Losses(*(value.detach() for value in told)))

    def _weights_now(self) -> LossWeights:
        w = self.learning.weights
        left = 1 - min(1.0, self.iteration / self.learning.iterations)
        return LossWeights(w.clip, w.value, w.entropy * left, w.mirror)

    def after_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        """Normalisers learn after the steps: all of an iteration's samples share their statistics.

        That of the returns has learnt its first ones before (`_unknown`).
        RLlib's schedules are left out: they follow counts that a restored training does not have.
        See Learner.
        """
        module = self.policy_module
        seen, returns = module.shown
        module.policy.observations.update(seen)
        if returns is not None:
            module.policy.learn_returns(returns)
        module.policy.sharpen(self.learning.sharpen ** (1 / self.learning.iterations))
        del module.shown
        self.iteration += 1
        told = {name: float(torch.stack(v).mean()) for name, v in self._columns().items()}
        last = self.logged[-(len(self.logged) // self.learning.epochs or 1) :]
        told["kl"] = float(torch.stack([one.kl for one in last]).mean())
        told["rate"] = self.optimizer.param_groups[0]["lr"]
        self.optimizer.param_groups[0]["lr"] = self._next_rate(told["rate"], told["kl"])
        told |= {"skipped": self.skipped, "moved": len(self.logged) - self.skipped}
        self.logged, self.skipped = [], 0
        for name, value in told.items():
            self.metrics.log_value((DEFAULT_MODULE_ID, name), value, window=1)

    def _columns(self) -> dict[str, list[torch.Tensor]]:
        return {name: [getattr(one, name) for one in self.logged] for name in Losses._fields}

    def _next_rate(self, rate: float, divergence: float) -> float:
        of = self.learning
        if of.schedule == "linear":
            return of.rate * max(0.1, 1 - self.iteration / of.iterations)
        if of.schedule == "adaptive":  # as rsl_rl has it, once an iteration
            if divergence > 2 * of.divergence:
                return max(rate / 1.5, 1e-5)
            if divergence < of.divergence / 2:
                return min(rate * 1.5, 1e-2)
        return rate

    def training_state(self) -> dict[str, NDArray[Any]]:
        """Weights, buffers and what Adam knows, by name."""
        told = {
            f"policy/{k}": v.cpu().numpy().copy()
            for k, v in self.policy_module.policy.state_dict().items()
        }
        for key, value in self.optimizer.state.get(self.vector, {}).items():
            told[f"adam/{key}"] = value.cpu().numpy().copy()
        told["rate"] = np.array(self.optimizer.param_groups[0]["lr"])
        told["iteration"] = np.array(self.iteration)
        return told

    def restore_training(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on where another learner told its state."""
        policy = self.policy_module.policy
        weights = {k.removeprefix("policy/"): v for k, v in state.items() if k[:7] == "policy/"}
        load(policy, weights)
        for key in ("step", "exp_avg", "exp_avg_sq"):
            value = torch.from_numpy(state[f"adam/{key}"].copy()).to(self.vector.device)
            self.optimizer.state[self.vector][key] = value
        self.optimizer.param_groups[0]["lr"] = float(state["rate"])
        self.iteration = int(state["iteration"])
