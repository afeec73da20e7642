"""Tells as JSON where a cluster of several nodes puts the actors of fits, and a training's learner.

A program of its own, as Ray keeps to the token that it began with.
"""

import json
import sys
from contextlib import closing
from dataclasses import replace
from typing import Any

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
from test_training import LEARNING, SAMPLING, SHAPE

from workers.cluster import connected
from workers.fits import _actor
from workers.ppo import Setup, Trainer

ACTORS = 8


def node(_: object = None) -> str:
    """Where this process is."""
    return str(ray.get_runtime_context().get_node_id())


@ray.remote(num_cpus=1)
def train() -> list[str]:
    """Nodes of the learner of a training that samples here on two threads, after an iteration."""
    setup = Setup(SHAPE, replace(SAMPLING, threads=2), LEARNING)
    with closing(Trainer(setup)) as trainer:
        trainer.iterate()
        return [one.get() for one in trainer.algorithm.learner_group.foreach_learner(node)]


def placed(address: str) -> dict[str, Any]:
    """The nodes: of the driver, of actors of fits, of a process that trains and of its learner."""
    with connected(address):
        actors = [_actor() for _ in range(ACTORS)]
        fits = ray.get([actor.__ray_call__.remote(node) for actor in actors])
        free = ray.available_resources()["CPU"]
        last = max(ray.nodes(), key=lambda node: str(node["NodeManagerAddress"]) == "127.0.0.2")
        there = NodeAffinitySchedulingStrategy(last["NodeID"], soft=False)
        learners = ray.get(train.options(scheduling_strategy=there).remote())
        told = {"head": node(), "fits": fits, "free": free}
        return told | {"trains": last["NodeID"], "learners": learners}


if __name__ == "__main__":
    print(json.dumps(placed(sys.argv[1])))
