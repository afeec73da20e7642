"""The runners of a training as its algorithm sees them: what they sample, who is lost, and why."""

import time
from collections import deque
from collections.abc import Collection
from statistics import median
from typing import Any

import ray
from ray.rllib.env.env_runner_group import EnvRunnerGroup

from pup.errors import InputError
from workers.rollouts import Fragment

FIRST_SECONDS, LEAST_SECONDS = 1800.0, 300.0
"""Wait for runners: before they have sampled once, as they may compile first, and at the least."""
TIMES = 10
"""Runners are waited for so many times as long as they usually take."""
REMEMBERED = 50
"""Times that tell what is usual."""
SHOWN = 300
"""Characters of what Ray tells of a lost process."""


def patience(past: Collection[float]) -> float:
    """How long runners are waited for that took so long before, s."""
    return max(LEAST_SECONDS, TIMES * median(past)) if past else FIRST_SECONDS


class Crew:
    """Has the remote runners of a group sample, and replaces those that fail or do not answer.

    RLlib waits for them for ever, or else leaves one that hangs in service.

    Args:
      group: of the algorithm.

    Attributes:
      trouble: what became of a runner that was lost the last time they sampled, if one was.
    """

    def __init__(self, group: EnvRunnerGroup) -> None:
        self._group, self._manager = group, group._worker_manager
        self._past = deque[float](maxlen=REMEMBERED)
        self.trouble = ""

    def check(self) -> None:
        """Refuse runners that cannot do their task.

        Raises:
          InputError: one of them could not make it.
        """
        told = self._group.foreach_env_runner(_trouble, local_env_runner=False)
        for host, trouble in told:
            if trouble:
                raise InputError(
                    f"a runner on node {host} cannot begin: {trouble}; robot folders must be at "
                    "the same path on all nodes"
                )

    def sample(self) -> list[Fragment]:
        """A fragment of each runner that answers, in their order."""
        self.trouble = ""
        wait, begin = patience(self._past), time.monotonic()
        answers: dict[int, Any] = dict.fromkeys(self._manager.healthy_actor_ids())
        told = self._manager.foreach_actor(
            lambda runner: runner.trouble or runner.sample(),
            remote_actor_ids=list(answers),
            timeout_seconds=wait,
        )
        answers |= {one.actor_id: one.get() for one in told}
        fragments: list[Fragment] = []
        for place, answer in answers.items():
            if isinstance(answer, list):
                fragments += answer
            else:
                self._replace(place, answer or f"did not answer for {wait:.0f} s")
        if not self.trouble:
            self._past.append(time.monotonic() - begin)
        return fragments

    def _replace(self, place: int, why: str | Exception) -> None:
        """Have another process take a runner's place; Ray itself does for one that has died."""
        self.trouble = f"runner {place}: {' '.join(str(why).split())[:SHOWN]}"
        if isinstance(why, str):
            self._manager.set_actor_state(place, healthy=False)
            ray.kill(self._manager.actors()[place], no_restart=False)


def _trouble(runner: Any) -> tuple[str, str]:
    return ray.util.get_node_ip_address(), runner.trouble
