"""Rollouts of a batched task, as a runner of RLlib: whole arrays, no Python per simulation."""

import secrets
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.core import COMPONENT_RL_MODULE, DEFAULT_MODULE_ID
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.utils.checkpoints import Checkpointable
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED, NUM_ENV_STEPS_SAMPLED_LIFETIME

from pup.errors import InputError
from pup.policy.network import ProjectedPolicy, draw

Array = NDArray[np.float32]
Flags = NDArray[np.bool_]


class Observation(Protocol):
    """What `pup.locomotion` tells of its simulations; n of them."""

    proprioception: Array
    parameters: Array
    privileged: Array


class Step(Protocol):
    """What became of an action; see `pup.locomotion`."""

    observation: Any
    reward: Array
    terminated: Flags
    truncated: Flags
    live: Flags
    distance: NDArray[np.float64]
    time: NDArray[np.float64]


class Task(Protocol):
    """A batch of simulations with next-step autoreset, as `pup.locomotion.WalkingTask`."""

    n: int
    bins: int

    @property
    def joints(self) -> tuple[str, ...]:
        """Actuated joints."""
        ...

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Entries of an observation."""
        ...

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Entries of mu."""
        ...

    def reset(self) -> Any:
        """Begin all episodes; an Observation."""
        ...

    def step(self, action: NDArray[np.int64]) -> Any:
        """Do a control step; a Step."""
        ...

    def state(self) -> dict[str, NDArray[Any]]:
        """All that a task which goes on alike needs."""
        ...

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on where another task told its state."""
        ...


MakeTask = Callable[[int, int, int], Task]
"""Makes a task of so many simulations, from a seed, on so many threads; is sent to runners."""


@dataclass(frozen=True)
class Sampling:
    """What a runner needs beside RLlib's configuration.

    Attributes:
      make: makes the task.
      simulations: of a runner, at once.
      steps: control steps of a fragment.
      seed: of the task and the drawn actions; runners have seeds of their own by their index.
      threads: of a runner's simulations.
    """

    make: MakeTask
    simulations: int
    steps: int
    seed: int
    threads: int


@dataclass(frozen=True)
class Fragment:
    """What a runner saw: T steps of N simulations.

    Attributes:
      proprioception: before each step and after the last, shape (T + 1, N, n_entries).
      parameters: mu as given to the policy, shape (T + 1, N, n_parameters).
      privileged: shape (T + 1, N, n_privileged).
      bins: actions, shape (T, N, joints).
      log: logarithm of their probability, shape (T, N).
      reward: shape (T, N).
      terminated: shape (T, N).
      truncated: shape (T, N).
      live: whether the step was one, shape (T, N); the others were resets.
      ended: return, distance in m and duration in s of the episodes that ended, and whether by a
        fall, shape (n_ended, 4).
    """

    proprioception: Array
    parameters: Array
    privileged: Array
    bins: NDArray[np.int8]
    log: Array
    reward: Array
    terminated: Flags
    truncated: Flags
    live: Flags
    ended: NDArray[np.float64]

    def __len__(self) -> int:
        """Steps sampled; those that were resets count too."""
        return int(self.reward.size)


class Sampler:
    """Steps a task with a policy that explores; knows no Ray.

    Args:
      sampling: see there.
      index: of the runner.
      life: of the runner: one that takes another's place draws other robots than that one did.
    """

    def __init__(self, sampling: Sampling, index: int, life: int = 0) -> None:
        self.sampling, self.index = sampling, index
        self.life = life
        seed = int(self._entropy(index).generate_state(1)[0])
        self.task = sampling.make(sampling.simulations, seed, sampling.threads)
        self.fragments = 0
        self.returns = np.zeros(self.task.n)
        self.now: Any = None
        self._stopped = False

    def _entropy(self, *of: int) -> np.random.SeedSequence:
        life = (self.life,) if self.life else ()
        return np.random.SeedSequence((self.sampling.seed, *of, *life))

    @torch.no_grad()
    def sample(self, policy: ProjectedPolicy) -> Fragment:
        """The next fragment.

        Raises:
          CancelledError: another thread has called `stop`.
        """
        task, steps = self.task, self.sampling.steps
        now = task.reset() if self.now is None else self.now
        # The seed is of the fragment, so that a training that goes on needs no generator's state.
        seed = self._entropy(1 + self.index, self.fragments)
        noise = torch.Generator().manual_seed(int(seed.generate_state(1, np.uint64)[0] >> 1))
        shape = (steps, task.n)
        names = ("proprioception", "parameters", "privileged")
        seen = {
            name: np.empty((steps + 1, *getattr(now, name).shape), dtype=np.float32)
            for name in names
        }
        bins = np.empty((*shape, len(task.joints)), dtype=np.int8)
        told = {name: np.empty(shape, dtype=np.float32) for name in ("log", "reward")}
        flags = {name: np.empty(shape, dtype=bool) for name in ("terminated", "truncated", "live")}
        ended = []
        for t in range(steps):
            if self._stopped:
                raise CancelledError
            for name in names:
                seen[name][t] = getattr(now, name)
            logits = policy(
                torch.from_numpy(seen["proprioception"][t]), torch.from_numpy(seen["parameters"][t])
            )
            uniform = torch.rand((task.n, len(task.joints)), generator=noise)
            action, log = draw(logits, uniform)
            step = task.step(action.numpy())
            bins[t], told["log"][t], told["reward"][t] = action.numpy(), log.numpy(), step.reward
            for name, values in flags.items():
                values[t] = getattr(step, name)
            ended.append(self._ended(step))
            now = step.observation
        for name in names:
            seen[name][steps] = getattr(now, name)
        self.now = now
        self.fragments += 1
        return Fragment(**seen, bins=bins, **told, **flags, ended=np.concatenate(ended))

    def stop(self) -> None:
        """Have no more steps done."""
        self._stopped = True

    def _ended(self, step: Step) -> NDArray[np.float64]:
        self.returns += step.reward
        over = step.terminated | step.truncated
        columns = (self.returns, step.distance, step.time, step.terminated)
        told = np.stack([column[over] for column in columns], axis=-1).astype(np.float64)
        self.returns[over] = 0.0
        return told

    def state(self) -> dict[str, NDArray[Any]]:
        """All that a sampler which goes on alike needs."""
        told = {"fragments": np.array(self.fragments), "returns": self.returns.copy()}
        if self.now is not None:
            told |= {f"task/{name}": value for name, value in self.task.state().items()}
            for name in ("proprioception", "parameters", "privileged"):
                told[f"now/{name}"] = getattr(self.now, name)
        return told

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on where another sampler told its state."""
        self.fragments = int(state["fragments"])
        self.returns = state["returns"].copy()
        if self.fragments:
            prefixed = {k.partition("/")[::2]: v for k, v in state.items() if "/" in k}
            self.task.restore({k[1]: v for k, v in prefixed.items() if k[0] == "task"})
            self.now = _Now(**{k[1]: v for k, v in prefixed.items() if k[0] == "now"})


@dataclass(frozen=True)
class _Now:
    """An observation that was kept."""

    proprioception: Array
    parameters: Array
    privileged: Array


class BatchRunner(EnvRunner, Checkpointable):
    """A runner whose `sample` gives one Fragment.

    Attributes:
      trouble: why it cannot, where it could not make its task: RLlib takes a remote runner whose
        constructor raises for a lost one, and tells nobody why.
    """

    def __init__(self, *, config: Any, **told: Any) -> None:
        super().__init__(config=config, **told)
        self.sampling: Sampling = self.config.env_config["sampling"]
        self.spaces = _spaces(self.config)
        spec = self.config.get_rl_module_spec(spaces=self.spaces, inference_only=True)
        self.module = spec.build()
        self.newest = 0
        # Beside remote runners the one in the algorithm's process only holds weights.
        here = self.worker_index > 0 or self.config.num_env_runners == 0
        if here:
            torch.set_num_threads(1)  # its simulations have the cores
        self.sampler: Sampler | None = None
        self.trouble = ""
        try:
            self.sampler = Sampler(self.sampling, self.worker_index, _life()) if here else None
        except Exception as error:
            if not self.worker_index:
                raise
            kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
            self.trouble = f"{kind}{error}"

    def sample(self, **_: Any) -> list[Fragment]:
        """See EnvRunner."""
        assert self.sampler is not None
        fragment = self.sampler.sample(self.module.policy)
        self.metrics.log_value(NUM_ENV_STEPS_SAMPLED, len(fragment), reduce="sum")
        self.metrics.log_value(NUM_ENV_STEPS_SAMPLED_LIFETIME, len(fragment), reduce="lifetime_sum")
        return [fragment]

    def stop(self) -> None:
        """See EnvRunner."""
        if self.sampler:
            self.sampler.stop()

    def get_metrics(self) -> Any:
        """See EnvRunner."""
        return self.metrics.reduce()

    def get_spaces(self) -> dict[str, Any]:
        """See EnvRunner."""
        return self.spaces

    def get_state(self, *_: Any, **__: Any) -> dict[str, Any]:
        """See Checkpointable; the task's state is asked for by itself."""
        return {COMPONENT_RL_MODULE: self.module.get_state(), "weights_seq_no": self.newest}

    def set_state(self, state: dict[str, Any]) -> None:
        """See Checkpointable."""
        weights = state.get(COMPONENT_RL_MODULE)
        if weights is None:
            return
        if isinstance(weights, ray.ObjectRef):
            weights = ray.get(weights)
        self.module.set_state(weights.get(DEFAULT_MODULE_ID, weights))
        self.newest = state.get("weights_seq_no", 0)

    def get_ctor_args_and_kwargs(self) -> tuple[tuple[()], dict[str, Any]]:
        """See Checkpointable."""
        return (), {"config": self.config}

    def get_checkpointable_components(self) -> list[tuple[str, Any]]:
        """See Checkpointable."""
        return [(COMPONENT_RL_MODULE, self.module)]

    def assert_healthy(self) -> None:
        """See EnvRunner."""
        assert self.module is not None


def _life() -> int:
    """Zero, or a number of its own for a runner that takes the place of one that was lost."""
    here = ray.get_runtime_context() if ray.is_initialized() else None
    in_place = here and here.get_actor_id() and here.was_current_actor_reconstructed
    return 1 + secrets.randbits(62) if in_place else 0


def _spaces(config: Any) -> dict[str, Any]:
    single = config.observation_space, config.action_space
    return {INPUT_ENV_SPACES: single, INPUT_ENV_SINGLE_SPACES: single, DEFAULT_MODULE_ID: single}


def spaces(entries: int, joints: int, bins: int) -> tuple[gymnasium.Space, gymnasium.Space]:
    """What one simulation sees and does, as RLlib asks for it."""
    seen = gymnasium.spaces.Box(-np.inf, np.inf, (entries,), np.float32)
    return seen, gymnasium.spaces.MultiDiscrete([bins] * joints)
