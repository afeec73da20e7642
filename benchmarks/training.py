"""Training against its physics and against rivals, in environment steps per second.

All step the same walking task (batch of simulations, PUP's observation and mu) for the same number
of steps an iteration and learn from them with the same sizes of network, epochs and minibatch:

- physics: `WalkingTask.step` alone, with random actions;
- ours: `workers.ppo`, mirror loss and all;
- bare: a plain torch loop with the same sampler and losses, without RLlib;
- stock: RLlib's own runner and module (TorchMultiCategorical) on the task as a vector environment;
- sb3: Stable-Baselines3's PPO on the task as its vector environment.

They are run in turn, iteration by iteration, in one process; a first round is not counted. Rivals
that are not installed are left out. None but ours and bare has a mirror loss, which costs about
a third of an update.
"""

import argparse
import logging
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import torch
from ray.rllib.algorithms.ppo import PPOConfig

from benchmarks.paired import ROBOT, Report, in_turn, parser, ratio
from pup.errors import how_to_install
from pup.locomotion.settings import TaskSettings
from pup.policy.losses import Samples, TorchMirror, losses
from pup.policy.mirror import MirrorMap
from pup.policy.shape import Method, PolicyShape
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds
from workers.cluster import connected
from workers.learner import Learning, prepared, shuffled
from workers.module import PolicyModule
from workers.ppo import Setup, Trainer
from workers.rollouts import Sampler, Sampling, spaces
from workers.walking import Walking

BARS = {
    "physics": (">= 0.70 of the physics", 0.70),
    "stock": (">= 2 times stock RLlib", 2.0),
    "sb3": (">= 1.5 times Stable-Baselines3", 1.5),
    "bare": (">= 1 / 1.3 of a bare torch loop", 1 / 1.3),
}
HIDDEN = (64, 64, 64)


@dataclass(frozen=True)
class Work:
    """What every rival does in an iteration."""

    walking: Walking
    shape: PolicyShape
    sampling: Sampling
    learning: Learning

    @property
    def steps(self) -> int:
        """Environment steps."""
        return self.sampling.simulations * self.sampling.steps


def main() -> None:
    options = parser(__doc__, rounds=3)
    options.add_argument("--simulations", type=int, default=256)
    options.add_argument("--length", type=int, default=80)
    given = options.parse_args()
    torch.set_num_threads(1)  # for all of them: networks are so small that two are slower
    logging.getLogger("ray").setLevel(logging.ERROR)
    report = Report("training", given.json)
    work = _work(given)
    with ExitStack() as stack:
        stack.enter_context(connected(cores=given.threads))
        rivals: dict[str, Callable[[], object]] = {"physics": _physics(work)}
        rivals["ours"] = _ours(work, stack)
        rivals["bare"] = _bare(work)
        rivals["stock"] = _stock(work, stack)
        if find_spec("stable_baselines3"):
            rivals["sb3"] = _sb3(work)
        else:
            report.say(
                f"Stable-Baselines3 is not installed and left out; {how_to_install('bench')}"
            )
        costs = dict(zip(rivals, in_turn(list(rivals.values()), given.rounds), strict=True))
    for name, of_one in costs.items():
        rate = work.steps / np.median([c.wall for c in of_one])
        spent = 1e6 * np.median([c.processor for c in of_one]) / work.steps
        report.say(f"{name}: {rate:,.0f} steps/s, {spent:.0f} us of the processor a step")
        report.add(name, [asdict(c) for c in of_one])
    for name, (told, bar) in BARS.items():
        if name in costs:
            pairs = [
                ratio(
                    [getattr(c, of) for c in costs[name]], [getattr(c, of) for c in costs["ours"]]
                )
                for of in ("wall", "processor")
            ]
            met = "met" if pairs[0].median >= bar else "missed"
            report.say(f"ours over {name}: {pairs[0]}; by processor {pairs[1]}; {told}: {met}")
            report.add(f"ours_over_{name}", [asdict(pair) for pair in pairs])
    report.finish()


def _work(given: argparse.Namespace) -> Work:
    robot = RobotDescription.load(ROBOT)
    walking = Walking(robot, read_bounds(robot.identified_path, robot), TaskSettings())
    task = walking(1, 0, 1)
    names = task.observation_names, task.parameter_names
    sizes = map(len, (*names, task.privileged_names, task.joints))
    shape = PolicyShape.of(Method.PUP, *sizes, task.bins)
    sampling = Sampling(walking, given.simulations, given.length, 0, given.threads)
    mirror = MirrorMap.of(robot, *names, bins=task.bins)
    return Work(walking, shape, sampling, Learning(mirror=mirror))


def _physics(work: Work) -> Callable[[], object]:
    s = work.sampling
    task, rng = work.walking(s.simulations, 0, s.threads), np.random.default_rng(0)
    task.reset()

    def run() -> None:
        for _ in range(s.steps):
            task.step(rng.integers(0, task.bins, (task.n, len(task.joints))))

    return run


def _ours(work: Work, stack: ExitStack) -> Callable[[], object]:
    trainer = stack.enter_context(closing(Trainer(Setup(work.shape, work.sampling, work.learning))))

    def run() -> None:
        trainer.iterate()
        trainer.algorithm.settle()  # what it samples for the next is not for others to pay

    return run


def _bare(work: Work) -> Callable[[], object]:
    learning = work.learning
    assert learning.mirror is not None
    seen, done = spaces(work.shape.proprioception, work.shape.joints, work.shape.bins)
    module = PolicyModule(
        observation_space=seen,
        action_space=done,
        model_config={"shape": work.shape.document(), "seed": 0, "start": None},
    )
    policy, mirror = module.policy, TorchMirror(learning.mirror)
    sampler = Sampler(replace(work.sampling, seed=1), 0)
    adam = torch.optim.Adam(policy.parameters(), lr=learning.rate, eps=1e-5, fused=True)
    rng = np.random.default_rng(0)

    def run() -> None:
        samples = prepared(module, sampler.sample(policy), learning)
        shown, returns = samples.proprioception, samples.returns
        standard = (samples.advantages - samples.advantages.mean()) / samples.advantages.std()
        scaled = (returns - policy.returns.mean) / policy.returns.scale
        samples = samples._replace(advantages=standard, returns=scaled)
        order = torch.from_numpy(shuffled(len(returns), learning, rng))
        for chosen in order.split(learning.minibatch):
            adam.zero_grad()
            minibatch = Samples(*(column[chosen] for column in samples))
            losses(policy, minibatch, learning.weights, mirror).total.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), learning.gradient)
            adam.step()
        policy.observations.update(shown)
        policy.learn_returns(returns)

    return run


class VectorTask(gymnasium.vector.VectorEnv):
    """The task as Gymnasium's vector environment; observation and mu side by side."""

    def __init__(self, work: Work) -> None:
        s = work.sampling
        self.task = work.walking(s.simulations, 2, s.threads)
        self.num_envs = self.task.n
        size = len(self.task.observation_names) + len(self.task.parameter_names)
        self.single_observation_space, self.single_action_space = spaces(
            size, len(self.task.joints), self.task.bins
        )
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, self.num_envs)
        self.action_space = batch(self.single_action_space, self.num_envs)
        self.metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """See VectorEnv."""
        return _beside(self.task.reset()), {}

    def step(self, actions: Any) -> Any:
        """See VectorEnv."""
        told = self.task.step(np.asarray(actions))
        return _beside(told.observation), told.reward, told.terminated, told.truncated, {}


def _beside(seen: Any) -> Any:
    return np.concatenate([seen.proprioception, seen.parameters], axis=1)


def _stock(work: Work, stack: ExitStack) -> Callable[[], object]:
    name = "walking-v0"
    if name not in gymnasium.registry:
        gymnasium.register(name, vector_entry_point=lambda **_: VectorTask(work))
    learning, s = work.learning, work.sampling
    config = (
        PPOConfig()
        .environment(name, disable_env_checking=True)
        .env_runners(
            num_env_runners=0,
            num_envs_per_env_runner=s.simulations,
            gym_env_vectorize_mode="vector_entry_point",
            rollout_fragment_length=s.steps,
        )
        .training(
            train_batch_size=work.steps,
            minibatch_size=learning.minibatch,
            num_epochs=learning.epochs,
            lr=learning.rate,
            use_kl_loss=False,
            vf_clip_param=float("inf"),
        )
        .rl_module(model_config={"fcnet_hiddens": list(HIDDEN), "fcnet_activation": "tanh"})
        .debugging(log_level="ERROR")
    )
    algorithm = config.build_algo()
    stack.callback(algorithm.stop)
    return algorithm.train


def _sb3(work: Work) -> Callable[[], object]:
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnv

    class Vec(VecEnv):
        """The task as Stable-Baselines3 has it; a reset counts as a step without reward."""

        def __init__(self) -> None:
            self.inner = VectorTask(work)
            single = self.inner.single_observation_space, self.inner.single_action_space
            super().__init__(self.inner.num_envs, *single)

        def reset(self) -> Any:
            return self.inner.reset()[0]

        def step_async(self, actions: Any) -> None:
            self.actions = actions

        def step_wait(self) -> Any:
            seen, reward, terminated, truncated, _ = self.inner.step(self.actions)
            return seen, reward, terminated | truncated, [{} for _ in range(self.num_envs)]

        def close(self) -> None: ...
        def get_attr(self, attr_name: str, indices: Any = None) -> Any:
            return [None] * self.num_envs

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...
        def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> Any: ...
        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Any:
            return [False] * self.num_envs

    learning = work.learning
    model = PPO(
        "MlpPolicy",
        Vec(),
        n_steps=work.sampling.steps,
        batch_size=learning.minibatch,
        n_epochs=learning.epochs,
        learning_rate=learning.rate,
        policy_kwargs={"net_arch": list(HIDDEN), "activation_fn": torch.nn.Tanh},
        device="cpu",
        verbose=0,
    )
    return lambda: model.learn(work.steps, reset_num_timesteps=False)


if __name__ == "__main__":
    main()
