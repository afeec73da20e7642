"""What the nodes of a cluster hold: a process has all of its cores on one of them."""

from collections.abc import Sequence
from typing import Any

import ray
from ray._private.state import available_resources_per_node


def cores_free() -> list[int]:
    """Cores of each node that nobody has; a job's process has some itself."""
    return [int(node.get("CPU", 0)) for node in available_resources_per_node().values()]


def cores_whole() -> list[int]:
    """Cores of each node, whoever has them."""
    return [int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]]


def room(cores: Sequence[int], share: int) -> int:
    """Processes with a share of cores each that nodes of so many hold."""
    return sum(one // share for one in cores)


def largest_share(cores: Sequence[int], processes: int) -> int:
    """Most cores that each of some processes can have on nodes of so many; 0: there is no room."""
    shares = range(max(cores, default=0), 0, -1)
    return next((share for share in shares if room(cores, share) >= processes), 0)


def beside() -> dict[str, float]:
    """What has a process without cores of its own placed on this node, which samples for it.

    Ray would place it anywhere, on a head too that is to do no work. Where that is this node, as of
    who joins a cluster from there, it is the one with most cores.
    """
    me = ray.get_runtime_context().get_node_id()

    def suits(node: dict[str, Any]) -> tuple[bool, float]:
        cores = node["Resources"].get("CPU", 0)
        return node["NodeID"] == me and cores > 0, cores

    best = max((node for node in ray.nodes() if node["Alive"]), key=suits)
    return {f"node:{best['NodeManagerAddress']}": 0.001}
