"""Runners that cannot begin, hang or are fewer than before, on a real Ray."""

import json
import os
import signal
import time
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy_task import ToyTask

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

from pup.errors import InputError
from pup.policy.losses import LossWeights
from pup.policy.shape import Method, PolicyShape
from pup.robot import RobotDescription
from services import training
from services.training_options import Options
from workers import runners
from workers.learner import Learning
from workers.ppo import Setup, Trainer
from workers.rollouts import Sampling

SAMPLING = Sampling(ToyTask, simulations=32, steps=32, seed=0, threads=1)
LEARNING = Learning(epochs=1, minibatch=256, iterations=10)
TWO = Setup(PolicyShape.of(Method.PUP, 2, 2, 2, 2), SAMPLING, LEARNING, runners=2)
ROBOT = RobotDescription.load("darwin_op2")
SMALL = Options(
    steps=192,
    simulations=4,
    length=8,
    learning=Learning(epochs=1, minibatch=16, weights=LossWeights()),
    runners=2,
)


class Elsewhere(ToyTask):
    """A task whose files are on no other node."""

    def __init__(self, n: int, seed: int, threads: int = 1) -> None:
        raise InputError("robots/mine/model.xml: cannot be read")


def test_runners_are_waited_for_by_how_long_they_usually_take() -> None:
    assert runners.patience([]) == runners.FIRST_SECONDS
    assert runners.patience([1.0, 2.0, 400.0]) == runners.LEAST_SECONDS
    assert runners.patience([100.0, 90.0, 1000.0]) == 1000.0


@pytest.mark.ray
def test_what_a_runner_cannot_read_is_told(ray_here: None) -> None:
    """At once, in its own words."""
    begin = time.monotonic()
    told = "robots/mine/model.xml: cannot be read; robot folders must be at the same path"
    with pytest.raises(InputError, match=told):
        Trainer(replace(TWO, sampling=replace(SAMPLING, make=Elsewhere)))
    assert time.monotonic() - begin < 40


@pytest.mark.ray
def test_a_runner_that_hangs_is_replaced(ray_here: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its steps are counted as lost, and why is told."""
    monkeypatch.setattr(runners, "LEAST_SECONDS", 2.0)
    with closing(Trainer(TWO)) as trainer:
        trainer.iterate()
        first, second = trainer.each_runner(lambda runner: os.getpid())
        os.kill(first, signal.SIGSTOP)
        trainer.iterate()  # were sampled before
        struck = trainer.iterate()
        assert (struck.steps, struck.lost) == (1024, 1024)
        assert struck.trouble == "runner 1: did not answer for 2 s"
        for _ in range(60):
            if trainer.iterate().lost == 0:
                break
            time.sleep(0.5)
        another, same = trainer.each_runner(lambda runner: os.getpid())
        assert another != first and same == second
        lives = trainer.each_runner(lambda runner: runner.sampler.life)
        assert lives[0] > 0 == lives[1]


@pytest.mark.ray
def test_a_training_that_ends_does_not_wait_for_a_runner_that_hangs(ray_here: None) -> None:
    trainer = Trainer(TWO)
    trainer.iterate()
    first, _ = trainer.each_runner(lambda runner: os.getpid())
    os.kill(first, signal.SIGSTOP)
    begin = time.monotonic()
    trainer.algorithm.begin()
    trainer.close()
    assert time.monotonic() - begin < 20


@pytest.mark.ray
@pytest.mark.parametrize("now", [0, 1, 3])
def test_a_training_goes_on_with_another_number_of_runners(ray_here: None, now: int) -> None:
    """Those that were there go on; what was done counts for as many steps as it had."""
    with closing(Trainer(replace(TWO, runners=2))) as trainer:
        for _ in range(3):
            trainer.iterate()
        state, weights = trainer.state(), trainer.weights()
    with closing(Trainer(replace(TWO, runners=now, cores=0 if now > 2 else 1))) as trainer:
        trainer.restore(state)
        assert all(np.array_equal(v, weights[k]) for k, v in trainer.weights().items())
        fragments = trainer.each_runner(lambda runner: runner.sampler.fragments)
        assert fragments == [4, 4, 0][: max(1, now)]
        assert trainer.state()["learner/iteration"] == {0: 6, 1: 6, 3: 2}[now]
        told = trainer.iterate()
        assert (told.steps, told.lost) == (1024 * max(1, now), 0)


def job(out: Path, options: Options, told=lambda row, steps: None) -> dict[str, object]:
    return training.train(ROBOT, None, options, out, lambda: nullcontext(2), told)


@pytest.mark.ray
def test_a_job_goes_on_with_fewer_runners(
    ray_here: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """To as many steps; that its weights are others is said. Other options are refused as ever."""
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)

    def stop(row: dict[str, object], steps: int) -> None:
        if row["steps"] == 128:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        job(tmp_path, SMALL, stop)
    assert json.loads((tmp_path / "training.json").read_text())["steps"] == 64
    with pytest.raises(InputError, match="another training"):
        job(tmp_path, replace(SMALL, runners=1, steps=384))
    capsys.readouterr()
    done = job(tmp_path, replace(SMALL, runners=1))
    assert "--runners 1 after 2 before: weights will not be" in capsys.readouterr().err
    assert done["done"] and done["curve"]["steps"] == [64, 96, 128, 160, 192]
    assert done["curve"]["rate"][1] == pytest.approx(3e-4 * (1 - 2 / 6))
    rows: list[object] = []
    assert job(tmp_path, SMALL, lambda row, steps: rows.append(row))["done"]
    assert not rows  # nothing is left to do, by as many runners as it may be


@pytest.mark.ray
def test_iterations_of_other_runners_are_whole_ones(
    ray_here: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A half of one counts as one: what its checkpoints tell is never more than was done."""
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    options = replace(SMALL, steps=128)

    def stop(row: dict[str, object], steps: int) -> None:
        if row["steps"] == 64:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        job(tmp_path, replace(options, runners=1), stop)
    assert job(tmp_path, options)["curve"]["steps"] == [32, 96]
    assert (tmp_path / "policy" / "policy.json").exists()
