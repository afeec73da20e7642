"""PPO on RLlib from batched tasks: the algorithm, its configuration, and its exact state."""

import logging
import math
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, fields, replace
from typing import Any

import gymnasium
import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.exceptions import RayActorError
from ray.rllib.algorithms.ppo import PPO, PPOConfig
from ray.rllib.core import COMPONENT_LEARNER, COMPONENT_RL_MODULE, DEFAULT_MODULE_ID
from ray.rllib.core.rl_module.rl_module import RLModuleSpec

from pup.errors import InputError
from pup.policy.losses import Losses
from pup.policy.shape import PolicyShape
from workers.learner import FragmentsToBatch, Learning, MirrorLearner
from workers.module import PolicyModule
from workers.nodes import beside
from workers.rollouts import BatchRunner, Fragment, Sampling, spaces
from workers.runners import LEAST_SECONDS, Crew

State = dict[str, NDArray[Any]]
GPU_MINIBATCH = 1024
"""Samples from which a step of the learner takes a GPU: with 256 a core of a processor is faster,
6 ms against 9, with 4,096 a GPU, 10 ms (docs/results/training.md)."""


@dataclass(frozen=True)
class Setup:
    """All that a training is made from.

    Attributes:
      shape: of the policy.
      sampling: the task and how it is stepped.
      learning: how the networks are moved.
      runners: processes that sample; 0 samples in the learner's own.
      cores: of each such process.
      seed: of the first weights.
      start: weights to begin with, by name; None draws them.
    """

    shape: PolicyShape
    sampling: Sampling
    learning: Learning
    runners: int = 0
    cores: int = 1
    seed: int = 0
    start: State | None = None

    @property
    def samples(self) -> int:
        """Steps of an iteration."""
        return max(1, self.runners) * self.sampling.simulations * self.sampling.steps


@dataclass(frozen=True)
class Iteration:
    """What an iteration came to.

    Attributes:
      steps: sampled.
      lost: not sampled because runners were lost.
      ended: see Fragment, of all runners.
      reward: mean of a live step.
      seconds: of waiting for samples and of learning.
      learnt: means of the losses, the rate, and steps that moved nothing (`skipped`).
      stuck: whether all steps moved nothing.
      trouble: why runners were lost, where some were.
    """

    steps: int
    lost: int
    ended: NDArray[np.float64]
    reward: float
    seconds: tuple[float, float]
    learnt: dict[str, float]
    trouble: str = ""
    stuck: bool = False


class BatchPPO(PPO):
    """PPO that samples while it learns, goes on with the runners that answer, and counts the lost.

    The fragments of an iteration are sampled during the one before, with the weights that that one
    began with: neither the runners nor the learner wait for each other. What is sampled with which
    weights does not hang on the clock, so that equal seeds still give equal weights.
    """

    told: Iteration

    def setup(self, config: Any) -> None:
        """See Algorithm."""
        super().setup(config)
        self.crew = Crew(self.env_runner_group)
        self._thread = ThreadPoolExecutor(1, "sampling")
        self._coming: Future[list[Fragment]] | None = None

    def _setup_logdir(self) -> None:
        """Without a folder of RLlib's own in the user's home; results are told elsewhere."""
        self._folder = tempfile.TemporaryDirectory(prefix="pup-rllib-")
        self._logdir = self._folder.name

    def cleanup(self) -> None:
        """See Algorithm."""
        self.env_runner_group._worker_manager.clear()  # RLlib would wait for what they sample
        super().cleanup()  # stops what is being sampled here
        self._thread.shutdown()
        self._folder.cleanup()

    def training_step(self) -> None:
        """See Algorithm."""
        begin = time.perf_counter()
        fragments, trouble = self.coming(), self.crew.trouble
        self.begin()
        if not fragments:
            none, lost = np.empty((0, 4)), self._expected()
            self.told = Iteration(0, lost, none, np.nan, (0.0, 0.0), {}, trouble)
            return
        sampled = time.perf_counter()
        results = self.learner_group.update(episodes=fragments, timesteps={})
        self.metrics.aggregate(results, key="learners")
        steps = sum(map(len, fragments))
        live = sum(int(f.live.sum()) for f in fragments)
        learnt = _numbers(results[0][DEFAULT_MODULE_ID])
        self.told = Iteration(
            steps=steps,
            lost=self._expected() - steps,
            ended=np.concatenate([f.ended for f in fragments]),
            reward=float(sum(f.reward.sum(dtype=np.float64) for f in fragments) / live),
            seconds=(sampled - begin, time.perf_counter() - sampled),
            learnt=learnt,
            trouble=trouble,
            stuck=learnt.pop("moved") == 0,
        )

    def coming(self) -> list[Fragment]:
        """What the coming iteration learns from; after this nothing is being sampled."""
        coming = self._coming or self.begin()
        return coming.result()

    def bring(self, fragments: list[Fragment]) -> None:
        """Let the coming iteration learn from these."""
        self._coming = Future()
        self._coming.set_result(fragments)

    def settle(self) -> None:
        """Wait until nothing is being sampled; runners answer no two questions at once."""
        if self._coming:
            wait([self._coming])

    def begin(self) -> Future[list[Fragment]]:
        """Sample with the learner's weights of now, beside what this process does next."""
        super().restore_env_runners(self.env_runner_group)
        self._broadcast()
        self._coming = self._thread.submit(self._sampled)
        return self._coming

    def restore_env_runners(self, env_runner_group: Any) -> list[int]:
        """Nothing: RLlib asks for it in the midst of sampling, `begin` does it before."""
        return []

    def _expected(self) -> int:
        return int(self.config.train_batch_size)

    def _sampled(self) -> list[Fragment]:
        group = self.env_runner_group
        if group.num_remote_env_runners():
            return self.crew.sample()
        return group.local_env_runner.sample()

    def _broadcast(self) -> None:
        """Give the runners the learner's weights; a runner in this process needs no Ray for it."""
        group = self.env_runner_group
        if group.num_remote_env_runners():
            group.sync_weights(from_worker_or_learner_group=self.learner_group, inference_only=True)
            return
        state = self.learner_group.get_state(
            components=f"{COMPONENT_LEARNER}/{COMPONENT_RL_MODULE}", inference_only=True
        )
        group.local_env_runner.set_state(state[COMPONENT_LEARNER])


def _numbers(told: dict[str, Any]) -> dict[str, float]:
    """What our learner logged, out of RLlib's statistics."""
    names = (*Losses._fields, "rate", "skipped", "moved")
    return {name: float(told[name].peek()) for name in names}


def learner_place(minibatch: int, here: bool, anywhere: bool, shared: bool) -> tuple[int, int]:
    """Remote learners, and GPUs of a learner.

    Args:
      minibatch: samples of a step.
      here: whether this process sees a GPU.
      anywhere: whether the cluster has a free one: Ray waits for ever for one that others have.
      shared: whether this process samples on several cores: a learner beside it would wait for
        Python's lock, and the samples for the learner.
    """
    if minibatch >= GPU_MINIBATCH and (here or anywhere):
        return int(not here), 1
    return int(shared), 0


def _start(setup: Setup) -> BatchPPO:
    """Build the algorithm on the Ray this process is connected to.

    Raises:
      InputError: a runner cannot make its task.
      ConnectionError: the first runner was lost.
    """
    for name in ("ray", "ray.rllib"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    seen, done = spaces(setup.shape.proprioception, setup.shape.joints, setup.shape.bins)
    shared = setup.runners == 0 and setup.sampling.threads > 1
    minibatch = setup.learning.minibatch
    free = ray.available_resources().get("GPU", 0) >= 1
    remote, gpus = learner_place(minibatch, torch.cuda.is_available(), free, shared)
    if minibatch >= GPU_MINIBATCH and not gpus and ray.cluster_resources().get("GPU", 0):
        line = "others have the cluster's GPUs: the learner takes a processor; stop and repeat the "
        print(line + "command for a GPU once one is free", file=sys.stderr, flush=True)
    config = (
        PPOConfig(algo_class=BatchPPO)
        .environment(
            gymnasium.Env,  # asked for, and never made
            observation_space=seen,
            action_space=done,
            env_config={"sampling": setup.sampling},
            disable_env_checking=True,
        )
        .env_runners(
            env_runner_cls=BatchRunner,
            num_env_runners=setup.runners,
            num_cpus_per_env_runner=setup.cores,
            rollout_fragment_length=setup.sampling.steps,
            merge_env_runner_states=False,
            broadcast_env_runner_states=False,
        )
        .learners(
            num_learners=remote,
            num_cpus_per_learner=0,  # runners may have all there are; it would wait for ever
            num_gpus_per_learner=gpus,
            custom_resources_per_learner={} if gpus else beside(),
            learner_connector=lambda *_: FragmentsToBatch(setup.learning),
            add_default_connectors_to_learner_pipeline=False,
        )
        .training(
            learner_class=MirrorLearner,
            learner_config_dict={"learning": setup.learning},
            train_batch_size=setup.samples,
            minibatch_size=None,  # MirrorLearner splits an iteration's samples
            num_epochs=1,  # FragmentsToBatch lays them out
            lr=setup.learning.rate,
            use_kl_loss=False,
            vf_clip_param=float("inf"),
        )
        .rl_module(
            rl_module_spec=RLModuleSpec(
                module_class=PolicyModule,
                model_config={
                    "shape": setup.shape.document(),
                    "seed": setup.seed,
                    "start": setup.start,
                },
            )
        )
        .fault_tolerance(
            restart_failed_env_runners=True,
            ignore_env_runner_failures=False,
            delay_between_env_runner_restarts_s=1.0,
            max_num_env_runner_restarts=1000,
        )
        .debugging(log_level="ERROR")
    )
    try:
        algorithm = config.build_algo()
    except IndexError as error:  # RLlib takes the first answer of the first runner, of none too
        if not setup.runners:
            raise
        raise ConnectionError(
            "a runner was lost while it started, perhaps for want of memory; the same command "
            "resumes"
        ) from error
    try:
        algorithm.crew.check()
    except InputError:
        algorithm.stop()
        raise
    return algorithm


class Trainer:
    """A training on the Ray this process is connected to.

    Args:
      setup: all that it is made from.
    """

    def __init__(self, setup: Setup) -> None:
        self.algorithm = _start(setup)
        self.setup = setup

    def iterate(self) -> Iteration:
        """Sample and learn.

        Raises:
          ConnectionError: the learner's process was lost.
        """
        try:
            self.algorithm.train()
        except RayActorError as error:  # RLlib replaces runners, but no learner
            raise ConnectionError(
                "the process that learns was lost, perhaps for want of memory; the same command "
                "resumes"
            ) from error
        return self.algorithm.told

    def weights(self) -> State:
        """The policy's weights and buffers by name."""
        return _below(self._learner(), "policy")

    def state(self) -> State:
        """All that a training which goes on alike needs, as arrays by name."""
        told = {f"learner/{k}": v for k, v in self._learner().items()}
        for i, fragment in enumerate(self.algorithm.coming()):
            told |= {f"coming{i}/{f.name}": getattr(fragment, f.name) for f in fields(Fragment)}
        # By their index: one that was lost, and does not answer, leaves the others in their places.
        for place, runner in self.each_runner(lambda one: (_place(one), one.sampler.state())):
            told |= {f"runner{place}/{k}": v for k, v in runner.items()}
        return told | {"runners": np.array(self.setup.runners)}

    def restore(self, state: State) -> None:
        """Go on where another training told its state.

        Of one with more runners some states are left out, beside one with fewer some begin anew.
        What was being sampled is then sampled again, and as an iteration has another number of
        steps, those that were done count for more or fewer.
        """
        before = replace(self.setup, runners=runners_before(state, self.setup.runners))
        learner = _below(state, "learner")
        done = int(learner["iteration"]) * before.samples
        learner["iteration"] = np.array(math.ceil(done / self.setup.samples))
        self.algorithm.learner_group.foreach_learner(lambda one: one.restore_training(learner))
        runners = range(max(1, self.setup.runners))
        states = [_below(state, f"runner{i}") for i in runners]

        def give(runner: BatchRunner) -> None:
            if told := states[_place(runner)]:  # else it was lost, and begins anew
                runner.sampler.restore(told)

        self.each_runner(give)
        if before.runners != self.setup.runners:
            return
        kept = [Fragment(**arrays) for i in runners if (arrays := _below(state, f"coming{i}"))]
        if kept:
            self.algorithm.bring(kept)

    def close(self) -> None:
        """End its processes."""
        self.algorithm.stop()

    def _learner(self) -> State:
        told = self.algorithm.learner_group.foreach_learner(lambda one: one.training_state())
        (learner,) = (one.get() for one in told)
        return dict(learner)

    def each_runner(self, action: Callable[[BatchRunner], Any]) -> list[Any]:
        """What the runners that sample answer, in their order."""
        self.algorithm.settle()
        group = self.algorithm.env_runner_group
        told = group.foreach_env_runner(
            action, local_env_runner=not self.setup.runners, timeout_seconds=LEAST_SECONDS
        )
        return list(told)


def runners_before(state: State, now: int) -> int:
    """Runners of the training that told a state; as many as now, where it did not tell."""
    return int(state.get("runners", now))


def _place(runner: BatchRunner) -> int:
    """Which of those that sample it is: RLlib counts remote ones from 1, and calls its own 0."""
    return max(0, int(runner.worker_index) - 1)


def _below(state: State, prefix: str) -> State:
    return {k.removeprefix(f"{prefix}/"): v for k, v in state.items() if k.startswith(f"{prefix}/")}
