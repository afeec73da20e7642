"""Cores for runners: each has its own on one node, whatever the nodes have together."""

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from commandline import pup_process
from hypothesis import given
from hypothesis import strategies as st
from ray_clusters import RayCluster, two_workers

from pup.errors import InputError
from services.places import training
from workers.cluster import connected, staying
from workers.nodes import largest_share, room


@given(st.lists(st.integers(0, 40), max_size=6), st.integers(1, 60))
def test_a_share_is_the_largest_that_all_runners_find_room_for(
    cores: list[int], runners: int
) -> None:
    share = largest_share(cores, runners)
    assert (share > 0) == (sum(cores) >= runners)
    assert all(room(cores, larger) < runners for larger in range(share + 1, 42))
    if share:
        assert room(cores, share) >= runners
        assert share <= max(cores) and share * runners <= sum(cores)


@pytest.mark.parametrize(
    ("cores", "runners", "share"),
    [([8, 8], 1, 8), ([8, 8], 2, 8), ([8, 8], 3, 4), ([8, 3], 2, 4), ([7, 0], 2, 3), ([1], 2, 0)],
)
def test_shares(cores: list[int], runners: int, share: int) -> None:
    assert largest_share(cores, runners) == share


@pytest.mark.ray
def test_runners_that_wait_for_a_cluster_to_grow_say_so(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def options(cores: int) -> argparse.Namespace:
        return argparse.Namespace(address="there", cores=cores, runners=2)

    with staying(), connected(cores=2):
        with training(options(2)) as cores:
            assert cores == 2
        assert not capsys.readouterr().err
        with training(options(8)) as cores:
            assert cores == 8
        told = capsys.readouterr().err
        assert "waiting for nodes with 4 free cores" in told and "largest node has 2" in told
        with pytest.raises(InputError, match="--runners 2 on 1 cores"), training(options(1)):
            pass


@pytest.fixture(scope="module")
def two_nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RayCluster]:
    """Whose processes can import the tests' own tasks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent))
        with two_workers(tmp_path_factory.mktemp("ray")) as cluster:
            yield cluster


@pytest.mark.ray
def test_a_runner_takes_no_more_cores_than_a_node_has(
    two_nodes: RayCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four cores on two nodes: a runner that asked for all of them would wait for ever."""
    pytest.importorskip("torch")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", two_nodes.token)
    small = ("--simulations", 8, "--length", 8, "--minibatch", 16, "--pattern", 0, "--steps", 1000)
    where = ("--address", f"127.0.0.1:{two_nodes.gcs}", "--runners", 1)
    done = pup_process("train", *small, *where, "--json", "--out", tmp_path / "out")
    assert done.json()["done"]


@pytest.mark.ray
def test_nothing_is_put_on_a_head_that_does_no_work(
    two_nodes: RayCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor is a learner anywhere but where its samples come from; none of them holds a core."""
    pytest.importorskip("torch")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", two_nodes.token)
    program = [sys.executable, Path(__file__).with_name("placed.py")]
    done = subprocess.run(
        [*program, f"127.0.0.1:{two_nodes.gcs}"], capture_output=True, text=True, timeout=570
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["head"] not in told["fits"] and len(set(told["fits"])) == 2
    assert told["free"] == 4
    assert told["learners"] == [told["trains"]]
