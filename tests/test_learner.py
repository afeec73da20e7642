"""What the learner makes of rewards of any size."""

from dataclasses import replace

import numpy as np
import pytest
from toy_task import Step, ToyTask

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

import torch
from ray.rllib.core import DEFAULT_MODULE_ID

from pup.policy.gradients import differentiated
from pup.policy.losses import LossWeights, Samples
from pup.policy.network import ProjectedPolicy
from pup.policy.shape import Method, PolicyShape
from workers.learner import FragmentsToBatch, Learning
from workers.module import PolicyModule
from workers.rollouts import Sampler, Sampling, spaces

SHAPE = PolicyShape.of(Method.PUP, 2, 2, 2, 2)
LEARNING = Learning(epochs=4, minibatch=256, rate=1e-3)


class PaidWell(ToyTask):
    """Rewards are a hundred times as large, as those of a walk are."""

    def step(self, action: np.ndarray) -> Step:
        told = super().step(action)
        return replace(told, reward=100 * told.reward)


def actor(policy: ProjectedPolicy) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in policy.actor.parameters()])


def ways_of_the_actor(task: type[ToyTask], iterations: int) -> list[float]:
    """How far the actor comes in each iteration."""
    seen, done = spaces(2, 2, 11)
    told = {"shape": SHAPE.document(), "seed": 0, "start": None}
    module = PolicyModule(observation_space=seen, action_space=done, model_config=told)
    parameters = list(module.policy.parameters())
    adam = torch.optim.Adam(parameters, lr=LEARNING.rate, eps=1e-5)
    sampler, batches = Sampler(Sampling(task, 32, 32, 0, 1), 0), FragmentsToBatch(LEARNING)
    ways = []
    for _ in range(iterations):
        before, episodes = actor(module.policy), [sampler.sample(module.policy)]
        batch = batches(rl_module={DEFAULT_MODULE_ID: module}, episodes=episodes)
        columns = (one.split(LEARNING.minibatch) for one in Samples(**batch[DEFAULT_MODULE_ID]))
        for minibatch in zip(*columns, strict=True):
            _, found = differentiated(module.policy, Samples(*minibatch), LossWeights(), None)
            for parameter, gradient in zip(parameters, found, strict=True):
                parameter.grad = gradient
            torch.nn.utils.clip_grad_norm_(parameters, LEARNING.gradient)
            adam.step()
        observations, returns = module.shown
        module.policy.observations.update(observations)
        if returns is not None:
            module.policy.learn_returns(returns)
        ways.append(float((actor(module.policy) - before).norm()))
    return ways


@pytest.mark.parametrize("task", [ToyTask, PaidWell])
def test_the_actor_comes_as_far_in_the_first_iteration_as_later(task: type[ToyTask]) -> None:
    """The value function knows the scale of returns from the first step, and leaves it the clip."""
    first, *later = ways_of_the_actor(task, 4)
    assert first > 0.5 * np.mean(later)


def test_the_first_steps_do_not_hang_on_the_size_of_rewards() -> None:
    one, other = (ways_of_the_actor(task, 1)[0] for task in (ToyTask, PaidWell))
    assert other == pytest.approx(one, rel=0.05)


def test_each_return_is_learnt_once() -> None:
    """The first ones before the steps, later ones after them."""
    seen, done = spaces(2, 2, 11)
    told = {"shape": SHAPE.document(), "seed": 0, "start": None}
    module = PolicyModule(observation_space=seen, action_space=done, model_config=told)
    sampler, batches = Sampler(Sampling(ToyTask, 32, 32, 0, 1), 0), FragmentsToBatch(LEARNING)
    fragments = [sampler.sample(module.policy) for _ in range(2)]
    last = module.policy.critic[-1].weight.clone()
    batches(rl_module={DEFAULT_MODULE_ID: module}, episodes=fragments[:1])
    assert module.shown[1] is None
    assert module.policy.returns.count == fragments[0].live.sum()
    torch.testing.assert_close(module.policy.critic[-1].weight, last)
    batches(rl_module={DEFAULT_MODULE_ID: module}, episodes=fragments[1:])
    assert len(module.shown[1]) == fragments[1].live.sum()
