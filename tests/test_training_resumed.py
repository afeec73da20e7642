"""Training to files: interrupted and resumed alike, and policies trained further, on a real Ray."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

from policies import same

from pup.errors import InputError
from pup.locomotion.settings import Direction
from pup.physics.parameters import robot_space
from pup.policy.bundle import NumpyPolicy
from pup.policy.losses import LossWeights
from pup.policy.network import ProjectedPolicy
from pup.policy.shape import Method
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected
from services import training
from services.arguments import parser
from services.failures import FailedError
from services.training_options import Options, training_options
from workers.learner import Learning
from workers.ppo import Iteration

ROBOT = RobotDescription.load("darwin_op2")
SMALL = Options(
    steps=128,
    simulations=4,
    length=8,
    learning=Learning(epochs=2, minibatch=16, weights=LossWeights(mirror=1.0)),
    pattern=0,
)


def job(out: Path, options: Options = SMALL, told=lambda row, steps: None):
    return training.train(ROBOT, None, options, out, lambda: nullcontext(2), told)


def weights_of(out: Path) -> dict[str, np.ndarray]:
    with np.load(out / "policy" / "weights.npz", allow_pickle=False) as packed:
        return {name: packed[name] for name in packed.files}


def test_runners_that_do_not_come_back_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """After a while; before, one that comes back has the training go on."""
    monkeypatch.setattr(training, "EMPTY_SECONDS", 0.0)
    empty = Iteration(0, 32, np.empty((0, 4)), np.nan, (0.0, 0.0), {}, "runner 2: no memory")
    whole = replace(empty, steps=32, lost=0, reward=1.0, trouble="")
    told = [*[empty] * (training.MOST_EMPTY - 1), whole]
    trainer = SimpleNamespace(iterate=lambda: told.pop(0) if told else empty)
    one = training._Job(ROBOT, None, SMALL, tmp_path, lambda row, steps: None, lambda *_: None)
    assert one._iterate(trainer)["steps"] == 32
    assert one.lost == 32 * (training.MOST_EMPTY - 1)
    with pytest.raises(ConnectionError, match=r"all runners were lost.*\(runner 2: no memory\)"):
        one._iterate(trainer)
    assert capsys.readouterr().err.splitlines() == 2 * ["32 steps lost: runner 2: no memory"]

    def stopped() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("services.stopping.check", stopped)
    with pytest.raises(KeyboardInterrupt):
        one._iterate(trainer)


@pytest.mark.parametrize("method", [Method.PUP, Method.ROBUST])
def test_no_mirror_loss_where_mu_has_no_mirror_image(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], method: Method
) -> None:
    """Of a policy that sees mu: to another one it is all the same."""
    term = TermSpec("backlash", "joint", "l_knee", {"gap": 0.02, "behind": 1.0})
    robot = write_corrected(ROBOT, tmp_path / "corrected", {}, (term,), actuator="nn_pd")
    told = json.loads(ROBOT.identified_path.read_text())
    play = {"name": "backlash/gap@joint:l_knee", "nominal": 0.02, "lower": 0.01, "upper": 0.03}
    told["parameters"].append(play)
    bounds = tmp_path / "bounds.json"
    bounds.write_text(json.dumps(told))

    def mirrored(source: Path | None) -> bool:
        options = replace(SMALL, method=method)
        nobody = (lambda row, steps: None), (lambda words, share: None)
        one = training._Job(robot, source, options, tmp_path, *nobody)
        return one.learning.mirror is not None

    assert mirrored(ROBOT.identified_path) and not capsys.readouterr().err
    assert mirrored(bounds) == (method is Method.ROBUST)
    line = "mirror loss left out: the bounds hold no mirror image of backlash/gap@joint:l_knee\n"
    assert capsys.readouterr().err == ("" if method is Method.ROBUST else line)


@pytest.mark.ray
def test_an_interrupted_job_ends_alike(
    ray_here: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped after two of four iterations, the same command gives the same weights and curve."""
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    whole = job(tmp_path / "whole")
    assert whole["done"] and whole["steps"] == 128 and whole["lost_steps"] == 0

    def stop(row: dict[str, object], steps: int) -> None:
        if row["steps"] == 96:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        job(tmp_path / "halves", told=stop)
    assert not (tmp_path / "halves" / "policy").exists()
    part = json.loads((tmp_path / "halves" / "training.json").read_text())
    assert (part["done"], part["steps"]) == (False, 64)
    halves = job(tmp_path / "halves")
    assert same(weights_of(tmp_path / "whole"), weights_of(tmp_path / "halves"))
    for name in ("steps", "return", "reward", "kl", "value", "rate", "skipped"):
        assert halves["curve"][name] == whole["curve"][name]
    rows: list[object] = []
    assert job(tmp_path / "halves", told=lambda row, steps: rows.append(row))["done"]
    assert not rows  # there was nothing left to do
    with pytest.raises(InputError, match="another training"):
        job(tmp_path / "halves", replace(SMALL, seed=1))


@pytest.mark.ray
def test_a_job_that_learns_nothing_any_more_says_so(ray_here: None, tmp_path: Path) -> None:
    hasty = replace(SMALL, learning=replace(SMALL.learning, rate=1e30))
    with pytest.raises(FailedError, match=r"no gradient of iteration \d was finite.*lower"):
        job(tmp_path, hasty)
    assert not (tmp_path / "policy").exists()


@pytest.mark.ray
def test_what_is_done_has_a_policy(
    ray_here: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after its last iteration, before the policy is written: it is not done yet."""
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    write = training.write_bundle

    def killed(folder: Path, *told: object) -> None:
        if folder.name == "policy":
            raise KeyboardInterrupt
        write(folder, *told)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(training, "write_bundle", killed)
        job(tmp_path)
    assert job(tmp_path)["done"] and weights_of(tmp_path)


def test_eta_is_searched_where_the_policy_was_trained(tmp_path: Path) -> None:
    """UP's eta is mu: of a parameter whose bounds are one it was told by the error alone."""
    told = json.loads(ROBOT.identified_path.read_text())
    told["parameters"][0]["lower"] = told["parameters"][0]["upper"]
    (tmp_path / "bounds.json").write_text(json.dumps(told))
    options = replace(SMALL, method=Method.UP)
    ignored = (lambda row, steps: None), (lambda *_: None)
    made = training._Job(ROBOT, tmp_path / "bounds.json", options, tmp_path, *ignored)
    made.rows = [{"steps": 1}]
    policy = ProjectedPolicy(made.shape)
    made._bundle("policy", {name: value.numpy() for name, value in policy.state_dict().items()})
    card = NumpyPolicy.load(tmp_path / "policy", ROBOT).card
    np.testing.assert_allclose(card.eta_lower, -1.1, atol=1e-3)
    np.testing.assert_allclose(card.eta_upper, [-0.5, *[1.1] * 13], atol=1e-3)


@pytest.mark.ray
def test_a_job_leaves_what_a_robot_and_a_reader_need(ray_here: None, tmp_path: Path) -> None:
    """Bundle, curve and TensorBoard's file; another training can start from the bundle."""
    document = job(tmp_path, replace(SMALL, method=Method.UP))
    assert json.loads((tmp_path / "training.json").read_text()) == document
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    assert list((tmp_path / "tensorboard").glob("events*"))
    run = NumpyPolicy.load(tmp_path / "policy", ROBOT)
    assert run.card.method == "up"
    assert run.card.direction == "forward"
    assert run.card.shape.eta == len(run.card.parameters) == 14
    assert run.act(np.zeros(44), run.project(np.full(14, 0.5))).shape == (20,)
    further = replace(SMALL, method=Method.UP, start=tmp_path / "policy", steps=32)
    assert job(tmp_path / "further", further)["done"]
    with pytest.raises(InputError, match="other sizes"):
        job(tmp_path / "other", replace(SMALL, start=tmp_path / "policy"))


@pytest.mark.ray
def test_a_policy_is_trained_further_with_other_servos(ray_here: None, tmp_path: Path) -> None:
    """It has seen an NN-PD's parameters, and then sees the gains of PD servos."""
    job(tmp_path / "first", replace(SMALL, steps=32))
    space = robot_space(ROBOT, "pd")
    limits = zip(space.names, space.units, space.nominal, strict=True)
    told = json.loads(ROBOT.identified_path.read_text()) | {
        "actuator": {"kind": "pd", "weights": []},
        "parameters": [
            {"name": n, "unit": u, "nominal": x, "lower": x - 1e-3, "upper": x + 1e-3}
            for n, u, x in limits
        ],
    }
    (tmp_path / "pd.json").write_text(json.dumps(told))
    further = replace(SMALL, steps=32, start=tmp_path / "first" / "policy")
    out = tmp_path / "further"
    document = training.train(
        ROBOT, tmp_path / "pd.json", further, out, lambda: nullcontext(2), lambda row, steps: None
    )
    assert document["provenance"]["start"]["other_parameters"]
    assert NumpyPolicy.load(out / "policy", ROBOT).card.parameters == space.names


@pytest.mark.ray
@pytest.mark.parametrize("method", [Method.ROBUST, Method.NOMINAL])
def test_policies_that_see_no_parameters(ray_here: None, tmp_path: Path, method: Method) -> None:
    """Sideways too, where there is no symmetry."""
    options = replace(SMALL, method=method, steps=64, direction=Direction.SIDEWAYS)
    document = job(tmp_path, options)
    assert document["curve"]["mirror"] == [0.0, 0.0]
    run = NumpyPolicy.load(tmp_path / "policy", ROBOT)
    assert run.card.shape.eta == 0
    assert run.act(np.zeros(44), np.zeros(0)).shape == (20,)


@pytest.mark.parametrize(
    ("words", "sharpen"),
    [("", 2.5), ("--start .", 1.0), ("--sharpen 2", 2.0), ("--start . --sharpen 2", 2.0)],
)
def test_exploration_falls_from_scratch_unless_told(words: str, sharpen: float) -> None:
    given = parser().parse_args(["train", "--out", ".", *words.split()])
    assert training_options(given).learning.sharpen == sharpen
