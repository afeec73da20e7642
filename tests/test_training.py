"""Training: samplers, batches, and the learner on a real Ray."""

import os
import signal
import time
from concurrent.futures import CancelledError
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from toy_task import EPISODE, Step, ToyTask

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

import torch
from policies import same
from ray.rllib.core import DEFAULT_MODULE_ID

from pup.policy.losses import Samples
from pup.policy.network import ProjectedPolicy
from pup.policy.shape import Method, PolicyShape
from pup.robot import RobotDescription
from workers.learner import FragmentsToBatch, Learning, MirrorLearner, merged, prepared, shuffled
from workers.module import PolicyModule, load
from workers.ppo import Setup, Trainer, learner_place
from workers.rollouts import Sampler, Sampling, spaces

SHAPE = PolicyShape.of(Method.PUP, 2, 2, 2, 2)
SAMPLING = Sampling(ToyTask, simulations=32, steps=32, seed=0, threads=1)
LEARNING = Learning(epochs=4, minibatch=256, rate=1e-3, iterations=30)
TOY = Setup(SHAPE, SAMPLING, LEARNING)
ROBOT = RobotDescription.load("darwin_op2")


def policy() -> ProjectedPolicy:
    torch.manual_seed(0)
    return ProjectedPolicy(SHAPE)


def module() -> PolicyModule:
    seen, done = spaces(2, 2, 11)
    told = {"shape": SHAPE.document(), "seed": 0, "start": None}
    return PolicyModule(observation_space=seen, action_space=done, model_config=told)


# --- Without Ray ----------------------------------------------------------------------------------


def test_a_fragment_is_what_the_task_told() -> None:
    """Slots, resets and ended episodes are counted right to the sample."""
    fragment = Sampler(replace(SAMPLING, steps=2 * EPISODE), 0).sample(policy())
    over = fragment.terminated | fragment.truncated
    assert len(fragment) == 32 * 2 * EPISODE
    np.testing.assert_array_equal(fragment.live[1:], ~over[:-1])
    assert len(fragment.ended) == over.sum()
    assert fragment.ended[:, 3].sum() == fragment.terminated.sum()
    assert (fragment.reward[~fragment.live] == 0).all()
    whole = np.isclose(fragment.ended[:, 2], 0.1 * EPISODE) & (fragment.ended[:, 3] == 0)
    assert whole.sum() == fragment.truncated.sum()
    i = int(np.flatnonzero(fragment.truncated.any(axis=0))[0])
    end = int(np.flatnonzero(fragment.truncated[:, i])[0])
    begin = end - EPISODE + 1
    expected = fragment.reward[begin : end + 1, i].sum()
    assert np.isclose(fragment.ended[:, 0], expected, atol=1e-4).any()


def test_a_sampler_goes_on_where_another_stopped() -> None:
    """Bit by bit, in the middle of episodes."""
    one, two = Sampler(SAMPLING, 0), Sampler(SAMPLING, 0)
    one.sample(policy())
    state = {name: value.copy() for name, value in one.state().items()}
    expected = one.sample(policy())
    two.restore(state)
    again = two.sample(policy())
    for name in vars(expected):
        np.testing.assert_array_equal(getattr(again, name), getattr(expected, name))


def test_runners_sample_different_things() -> None:
    """By their index alone."""
    a, b = (Sampler(SAMPLING, index).sample(policy()) for index in (1, 2))
    assert not np.array_equal(a.proprioception[0], b.proprioception[0])
    assert not np.array_equal(a.bins, b.bins)


def test_one_that_takes_another_s_place_samples_different_things() -> None:
    """Else what it is trained on would be the first robots over and over."""
    a, b = (Sampler(SAMPLING, 1, life).sample(policy()) for life in (0, 7))
    assert not np.array_equal(a.proprioception[0], b.proprioception[0])
    assert not np.array_equal(a.bins, b.bins)


def test_samples_of_fragments() -> None:
    """Resets are left out; returns are advantages and values together; nothing is mixed up."""
    fragments = [Sampler(SAMPLING, i).sample(policy()) for i in (1, 2)]
    sampled = [prepared(module(), f, LEARNING) for f in fragments]
    whole = merged(sampled)
    assert len(whole.log) == sum(int(f.live.sum()) for f in fragments)
    live = fragments[0].live
    np.testing.assert_array_equal(sampled[0].bins, fragments[0].bins[live])
    np.testing.assert_array_equal(sampled[0].proprioception, fragments[0].proprioception[:-1][live])
    values = module().policy.value(sampled[0].proprioception, sampled[0].privileged)
    told = (sampled[0].returns - sampled[0].advantages).numpy()
    np.testing.assert_allclose(told, values.detach().numpy(), atol=1e-4)


@pytest.mark.parametrize("bias", [0.0, 0.5])
def test_samples_of_older_weights_are_weighted(bias: float) -> None:
    """By how likely their actions have become; what the clip counts from is the policy of now."""
    fragment = Sampler(SAMPLING, 1).sample(policy())
    now = module()
    load(now.policy, {k: v.numpy() for k, v in policy().state_dict().items()})
    with torch.no_grad():
        now.policy.actor[-1].bias[5 * SHAPE.joints : 6 * SHAPE.joints] += bias  # the middle
    drawn = prepared(now, fragment, LEARNING)
    batch = FragmentsToBatch(LEARNING)(rl_module={DEFAULT_MODULE_ID: now}, episodes=[fragment])
    told = Samples(**batch[DEFAULT_MODULE_ID])
    order = torch.from_numpy(shuffled(len(drawn.log), LEARNING, np.random.default_rng((0, 0))))
    taken = (drawn.bins == 5).sum(dim=1)[order]
    ratio = (told.log - drawn.log[order]).exp()
    standard = (drawn.advantages - drawn.advantages.mean()) / drawn.advantages.std()
    weight = told.advantages / standard[order]
    torch.testing.assert_close(weight, ratio.clamp(max=2.0), rtol=1e-3, atol=1e-3)
    if not bias:
        torch.testing.assert_close(ratio, torch.ones_like(ratio))
    else:
        assert ratio[taken == 0].max() < 1 < ratio[taken == 2].min()


def test_epochs_are_shuffled_alike_by_seed() -> None:
    """Every epoch has whole minibatches of different samples, in another order."""
    order = shuffled(1000, replace(LEARNING, epochs=3), np.random.default_rng(1))
    again = shuffled(1000, replace(LEARNING, epochs=3), np.random.default_rng(1))
    np.testing.assert_array_equal(order, again)
    epochs = order.reshape(3, 768)
    assert all(len(set(epoch)) == 768 for epoch in epochs)
    assert not np.array_equal(epochs[0], np.sort(epochs[0]))
    assert not np.array_equal(epochs[0], epochs[1])


def test_a_runner_that_was_lost_leaves_the_others_their_states() -> None:
    """Those that answered go on where they were; the lost one begins anew."""

    def runner(index: int) -> SimpleNamespace:
        return SimpleNamespace(worker_index=index, sampler=Sampler(SAMPLING, index))

    def trainer(*runners: SimpleNamespace) -> Trainer:
        made = Trainer.__new__(Trainer)
        made.setup = replace(TOY, runners=3)
        learner = SimpleNamespace(get=lambda: {"iteration": np.array(2)})
        made.algorithm = SimpleNamespace(
            settle=lambda: None,
            coming=list,
            learner_group=SimpleNamespace(foreach_learner=lambda action: [learner]),
            env_runner_group=SimpleNamespace(
                foreach_env_runner=lambda action, **_: [action(one) for one in runners]
            ),
        )
        return made

    first, last = runner(1), runner(3)
    for one in (first, last, last):
        one.sampler.sample(policy())
    again = [runner(index) for index in (1, 2, 3)]
    trainer(*again).restore(trainer(first, last).state())
    assert [one.sampler.fragments for one in again] == [1, 0, 2]
    for one, other in ((again[0], first), (again[2], last)):
        np.testing.assert_array_equal(one.sampler.task.x, other.sampler.task.x)


# --- On a real Ray --------------------------------------------------------------------------------


def weights_after(setup: Setup, iterations: int) -> dict[str, np.ndarray]:
    with closing(Trainer(setup)) as trainer:
        for _ in range(iterations):
            trainer.iterate()
        return trainer.weights()


@pytest.fixture(scope="module")
def learnt(ray_here: None) -> dict[str, np.ndarray]:
    """Weights of the toy after three iterations; leave them as they are."""
    return weights_after(TOY, 3)


@pytest.mark.ray
def test_a_toy_is_learnt(ray_here: None) -> None:
    """Masses come to rest within 60 iterations, and the value function knows it."""
    with closing(Trainer(replace(TOY, learning=replace(LEARNING, iterations=60)))) as trainer:
        told = [trainer.iterate() for _ in range(60)]
    assert told[0].reward < 0.3
    assert np.mean([one.reward for one in told[-10:]]) > 0.7
    assert told[-1].learnt["value"] < 0.1
    assert told[-1].learnt["rate"] < 0.2 * told[0].learnt["rate"]
    assert told[-1].ended[:, 3].mean() < 0.05
    assert all(one.steps == 1024 and one.lost == 0 for one in told)
    assert not any(one.stuck or one.learnt["skipped"] for one in told)


class Spoilt(ToyTask):
    """Pays what is no number."""

    def step(self, action: np.ndarray) -> Step:
        told = super().step(action)
        return replace(told, reward=np.nan * told.reward)


@pytest.mark.ray
def test_steps_that_move_nothing_are_counted(ray_here: None) -> None:
    """One of many, and all of an iteration, after which nothing is learnt any more."""

    def spoil(learner: MirrorLearner) -> None:
        fragment = Sampler(SAMPLING, 0).sample(learner.policy_module.policy)
        told = prepared(learner.policy_module, fragment, LEARNING)
        some = Samples(*(column[: LEARNING.minibatch] for column in told))
        some.returns[0] = torch.nan
        before = learner.vector.clone()
        learner._step(some, LEARNING.weights)
        assert torch.equal(learner.vector, before)

    with closing(Trainer(TOY)) as trainer:
        trainer.algorithm.learner_group.foreach_learner(spoil)
        told = trainer.iterate()
        assert (told.learnt["skipped"], told.stuck) == (1, False)
        assert trainer.iterate().learnt["skipped"] == 0
    with closing(Trainer(replace(TOY, sampling=replace(SAMPLING, make=Spoilt)))) as trainer:
        told = trainer.iterate()
    assert told.stuck and told.learnt["skipped"] >= LEARNING.epochs


@pytest.mark.ray
def test_weights_are_those_of_the_seed(learnt: dict[str, np.ndarray]) -> None:
    """Equal seeds give equal weights to the last bit, others do not."""
    assert same(learnt, weights_after(TOY, 3))
    other = replace(TOY, seed=1, sampling=replace(SAMPLING, seed=1))
    assert not same(learnt, weights_after(other, 3))


SHARED = replace(TOY, sampling=replace(SAMPLING, threads=2))
"""Samples on two threads, which the learner leaves alone: it has a process of its own."""


@pytest.mark.ray
def test_a_learner_in_a_process_of_its_own_learns_the_same(learnt: dict[str, np.ndarray]) -> None:
    with closing(Trainer(SHARED)) as trainer:
        learner_pid = trainer.algorithm.learner_group.foreach_learner(lambda _: os.getpid())
        assert [one.get() for one in learner_pid] != [os.getpid()]
    assert same(learnt, weights_after(SHARED, 3))


@pytest.mark.ray
def test_a_learner_that_is_lost_is_told(ray_here: None) -> None:
    with closing(Trainer(SHARED)) as trainer:
        trainer.iterate()
        (told,) = trainer.algorithm.learner_group.foreach_learner(lambda _: os.getpid())
        os.kill(told.get(), signal.SIGKILL)
        with pytest.raises(ConnectionError, match="the same command resumes"):
            for _ in range(3):
                trainer.iterate()


@pytest.mark.ray
@pytest.mark.parametrize("setup", [TOY, replace(TOY, runners=2), SHARED])
def test_a_restored_training_ends_alike(ray_here: None, setup: Setup) -> None:
    """With the same weights as one that went on."""
    with closing(Trainer(setup)) as trainer:
        for _ in range(2):
            trainer.iterate()
        state = trainer.state()
        for _ in range(2):
            trainer.iterate()
        expected = trainer.weights()
    with closing(Trainer(setup)) as trainer:
        trainer.restore(state)
        for _ in range(2):
            trainer.iterate()
        assert same(expected, trainer.weights())


@pytest.mark.ray
def test_training_outlives_a_runner(ray_here: None) -> None:
    """What was lost with it is counted, and another takes its place with the same weights."""
    with closing(Trainer(replace(TOY, runners=2))) as trainer:
        assert trainer.iterate().steps == 2048
        first, _ = trainer.each_runner(lambda runner: os.getpid())
        os.kill(first, signal.SIGKILL)
        assert trainer.iterate().steps == 2048  # were sampled before
        struck = trainer.iterate()
        assert (struck.steps, struck.lost) == (1024, 1024)
        for _ in range(60):
            if trainer.iterate().lost == 0:
                break
            time.sleep(0.5)
        assert trainer.iterate().lost == 0
        before = trainer.weights()["actor.0.weight"]
        trainer.iterate()  # beside it, the runners sample with the weights it began with
        weights = trainer.each_runner(lambda r: r.module.policy.actor[0].weight.detach().numpy())
        assert np.array_equal(weights[0], weights[1])
        assert np.array_equal(weights[0], before)
        assert not np.array_equal(weights[0], trainer.weights()["actor.0.weight"])


@pytest.mark.ray
def test_a_training_that_ends_does_not_wait_for_its_samples(ray_here: None) -> None:
    """A fragment of minutes is left where it is."""
    trainer = Trainer(replace(TOY, sampling=replace(SAMPLING, steps=300_000)))
    coming = trainer.algorithm.begin()
    time.sleep(0.5)
    begin = time.monotonic()
    trainer.close()
    assert time.monotonic() - begin < 10
    assert isinstance(coming.exception(), CancelledError)


@pytest.mark.parametrize(
    ("minibatch", "here", "anywhere", "shared", "place"),
    [
        (256, True, True, False, (0, 0)),  # a core is faster
        (256, True, True, True, (1, 0)),
        (4096, True, True, True, (0, 1)),
        (4096, False, True, False, (1, 1)),
        (4096, False, False, False, (0, 0)),
        (4096, False, False, True, (1, 0)),
    ],
)
def test_the_learner_takes_a_gpu_where_it_is_faster(
    minibatch: int, here: bool, anywhere: bool, shared: bool, place: tuple[int, int]
) -> None:
    assert learner_place(minibatch, here, anywhere, shared) == place
