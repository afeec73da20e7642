"""Which etas a robot walks: those that parameters of a robot can be projected to."""

from pathlib import Path

import pytest
from agents import bundle, standing, wait
from test_agent import at_work

from hardware_agent.policies import digest_of
from hardware_agent.rollout import Rollout
from pup.errors import InputError
from pup.policy.bundle import NumpyPolicy
from pup.policy.shape import Method
from pup.wire import Armed, Assign, Outcome


def policy_of(folder: Path, method: Method) -> NumpyPolicy:
    return NumpyPolicy.load(bundle(folder, standing(), method=method))


@pytest.mark.parametrize("method", list(Method))
def test_an_eta_of_the_box_is_walked_with_any_method(tmp_path: Path, method: Method) -> None:
    policy = policy_of(tmp_path, method)
    card = policy.card
    for eta in (card.eta_lower, card.eta_upper, (0.0,) * card.shape.eta):
        Rollout(policy, eta, 33.0)


def test_parameters_of_a_fitted_robot_may_lie_beyond_the_box(tmp_path: Path) -> None:
    Rollout(policy_of(tmp_path, Method.UP), (13.8, 0.0, 0.0, 0.0), 33.0)


def test_an_eta_that_nothing_projects_to_is_refused(tmp_path: Path) -> None:
    policy = policy_of(tmp_path, Method.PUP)
    Rollout(policy, (1.0 + 5e-7, -1.0 - 5e-7, 0.0), 33.0)
    for wrong in (1.0 + 2e-6, -1.1, float("nan")):
        with pytest.raises(InputError, match="outside -1 to 1"):
            Rollout(policy, (0.0, wrong, 0.0), 33.0)


def test_a_real_agent_aborts_it_before_anything_moves(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    folder = bundle(tmp_path / "policies" / "still", standing())
    with at_work(tmp_path) as (made, gateway):
        wild = Assign("study", "a", 1, 1, digest_of(folder), (0.0, 9.0, 0.0), 0.4)
        ended = gateway.run(wild, told=made.log)
        assert ended.state is Outcome.ABORTED
        assert ended.reason == "eta [0.0, 9.0, 0.0] is outside -1 to 1, where all projections lie"
        assert not gateway.of(Armed)
        wait(lambda: not made.health()["trial"], 10, made.log)


def test_a_real_agent_walks_a_policy_without_eta(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    folder = bundle(tmp_path / "policies" / "still", standing(), method=Method.ROBUST)
    with at_work(tmp_path) as (made, gateway):
        ended = gateway.run(Assign("s", "a", 1, 1, digest_of(folder), (), 0.4), told=made.log)
        assert ended.state is Outcome.SUCCEEDED, ended.reason
