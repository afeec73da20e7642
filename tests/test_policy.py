"""Policies: their networks, symmetry, losses, and the bundle a robot runs."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pup.errors import InputError
from pup.policy.bundle import NumpyPolicy, PolicyCard, read_bundle, write_bundle
from pup.policy.mirror import MirrorMap
from pup.policy.rebase import for_bounds
from pup.policy.shape import Method, PolicyShape
from pup.robot import RobotDescription

torch = pytest.importorskip("torch")

from pup.policy.losses import (  # noqa: E402
    LossWeights,
    Samples,
    TorchMirror,
    advantages,
    losses,
)
from pup.policy.network import Normaliser, ProjectedPolicy, draw, expected  # noqa: E402

ROBOT = RobotDescription.load("darwin_op2")
OBSERVATION = (
    *(f"position_before/{name}" for name in ROBOT.joint_names),
    *(f"position/{name}" for name in ROBOT.joint_names),
    *("imu/roll", "imu/pitch", "imu_before/roll", "imu_before/pitch"),
)
PARAMETERS = ("rho/arm", "rho/knee", "torque_limit", "ground_friction")
MIRROR = MirrorMap.of(ROBOT, OBSERVATION, PARAMETERS)
SIZES = len(OBSERVATION), len(PARAMETERS), len(ROBOT.joints)


def policy_of(method: Method = Method.PUP, seed: int = 0) -> ProjectedPolicy:
    """A policy as after some training: with statistics, and actions that are not all alike."""
    torch.manual_seed(seed)
    policy = ProjectedPolicy(PolicyShape.of(method, *SIZES))
    policy.observations.update(torch.randn(500, SIZES[0]) * 0.3 + 0.1)
    policy.learn_returns(torch.randn(500) * 100 + 300)
    with torch.no_grad():
        policy.actor[-1].weight.mul_(200)
    return policy


def card_of(policy: ProjectedPolicy, method: Method = Method.PUP) -> PolicyCard:
    assert ROBOT.gait is not None
    count = policy.shape.eta
    return PolicyCard(
        robot=ROBOT.name,
        joints=ROBOT.joint_names,
        lower=tuple(j.lower for j in ROBOT.joints),
        upper=tuple(j.upper for j in ROBOT.joints),
        method=method,
        direction="forward",
        shape=policy.shape,
        observation=OBSERVATION,
        parameters=PARAMETERS,
        parameter_lower=(0.5,) * 4,
        parameter_upper=(1.5,) * 4,
        eta_lower=(-1.0,) * count,
        eta_upper=(1.0,) * count,
        rates=(25.0, 33.0),
        reach=0.3,
        smoothing=5,
        gait=ROBOT.gait,
        bounds_sha256="0" * 64,
        robot_digest=ROBOT.digest,
        provenance={"seed": 0},
    )


def weights_of(policy: ProjectedPolicy) -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in policy.state_dict().items()}


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    policy = policy_of()
    write_bundle(tmp_path / "policy", card_of(policy), weights_of(policy))
    return tmp_path / "policy"


def observations(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    seen = rng.normal(0.1, 0.4, (count, SIZES[0])).astype(np.float32)
    return seen, rng.uniform(-0.05, 1.05, (count, SIZES[1]))


# --- Networks -------------------------------------------------------------------------------------


def test_normaliser_of_parts_is_that_of_the_whole() -> None:
    """Statistics of batches merge to those of all samples."""
    rng = np.random.default_rng(0)
    parts = [rng.normal(3, 2, (n, 2)).astype(np.float32) for n in (10, 1, 500)]
    normaliser = Normaliser(2)
    for part in parts:
        normaliser.update(torch.from_numpy(part))
    whole = np.concatenate(parts)
    assert normaliser.count == len(whole)
    np.testing.assert_allclose(normaliser.mean, whole.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(normaliser.variance, whole.var(axis=0), rtol=1e-4)


def test_drawn_bins_have_the_probabilities_told() -> None:
    """Frequencies of many draws; the logarithm told is that of the bins drawn."""
    torch.manual_seed(0)
    logits = torch.randn(1, 11, 2)
    bins, log = draw(logits.expand(50_000, -1, -1), torch.rand(50_000, 2))
    chance = torch.softmax(logits[0], dim=0)
    for joint in range(2):
        seen = np.bincount(bins[:, joint].numpy(), minlength=11) / len(bins)
        np.testing.assert_allclose(seen, chance[:, joint], atol=0.01)
    expected = chance[bins[:, 0], 0].log() + chance[bins[:, 1], 1].log()
    np.testing.assert_allclose(log, expected, rtol=1e-4, atol=1e-5)


def test_values_keep_their_meaning_when_returns_are_learnt() -> None:
    """New statistics of returns do not change what the value function says in their units."""
    policy = policy_of()
    seen, mu = (torch.from_numpy(a).float() for a in observations(50))

    def values() -> torch.Tensor:
        with torch.no_grad():
            return policy.value(seen, mu) * policy.returns.scale + policy.returns.mean

    before = values()
    policy.learn_returns(torch.randn(4000) * 5 - 70)
    np.testing.assert_allclose(values(), before, rtol=1e-3, atol=1e-2)


def test_a_sharper_policy_scatters_less_about_the_same_actions() -> None:
    torch.manual_seed(0)
    policy = ProjectedPolicy(PolicyShape.of(Method.PUP, *SIZES))  # a bell about the middle bins
    seen, mu = (torch.from_numpy(a).float() for a in observations(50))

    def spread() -> tuple[torch.Tensor, torch.Tensor]:
        with torch.no_grad():
            chances = torch.softmax(policy(seen, mu), dim=-2)
        bins = torch.arange(chances.shape[-2], dtype=chances.dtype)
        mean = torch.einsum("nbj,b->nj", chances, bins)
        return mean, torch.einsum("nbj,nbj->nj", chances, (bins[:, None] - mean[:, None]) ** 2)

    mean, variance = spread()
    policy.sharpen(1.5)
    sharper = spread()
    np.testing.assert_allclose(sharper[0], mean, atol=0.02)
    np.testing.assert_allclose(sharper[1], variance / 1.5, rtol=0.05)


def test_methods_see_what_they_should() -> None:
    """PUP through eta of three dimensions, UP mu itself, robust and nominal nothing of it."""
    seen, mu = (torch.from_numpy(a).float() for a in observations(20))
    for method, eta in ((Method.PUP, 3), (Method.UP, 4), (Method.ROBUST, 0), (Method.NOMINAL, 0)):
        policy = policy_of(method)
        assert policy.project(mu).shape == (20, eta)
        moved = not torch.equal(policy(seen, mu), policy(seen, 1 - mu))
        assert moved == (eta > 0)
        assert policy.value(seen, mu).shape == (20,)


# --- Symmetry -------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_mirror_is_an_involution(seed: int) -> None:
    """Mirrored twice, everything is as it was."""
    rng = np.random.default_rng(seed)
    seen = rng.normal(size=SIZES[0])
    np.testing.assert_array_equal(
        MIRROR.signs * (MIRROR.signs * seen[MIRROR.entries])[MIRROR.entries], seen
    )
    logits = rng.normal(size=len(MIRROR.logits))
    np.testing.assert_array_equal(logits[MIRROR.logits][MIRROR.logits], logits)
    bins = rng.integers(0, 11, SIZES[2])
    np.testing.assert_array_equal(MIRROR.bins(MIRROR.bins(bins)), bins)


def test_mirror_of_a_pose() -> None:
    """The left knee's bin goes to the right one, reversed; the head's tilt stays, roll turns."""
    names = ROBOT.joint_names
    bins = np.full(len(names), 5)
    bins[names.index("l_knee")], bins[names.index("head_tilt")] = 10, 7
    mirrored = MIRROR.bins(bins)
    assert mirrored[names.index("r_knee")] == 0
    assert mirrored[names.index("l_knee")] == 5
    assert mirrored[names.index("head_tilt")] == 7
    seen = np.arange(float(SIZES[0]))
    told = MIRROR.signs * seen[MIRROR.entries]
    assert told[OBSERVATION.index("position/r_knee")] == -OBSERVATION.index("position/l_knee")
    assert told[-4:].tolist() == [-40.0, 41.0, -42.0, 43.0]


def test_mirrored_bins_are_the_likeliest_of_mirrored_logits() -> None:
    """The maps of bins and of logits are one."""
    rng = np.random.default_rng(2)
    flat = rng.normal(size=(100, len(MIRROR.logits)))
    best = flat.reshape(100, 11, -1).argmax(axis=1)
    mirrored = flat[:, MIRROR.logits].reshape(100, 11, -1).argmax(axis=1)
    np.testing.assert_array_equal(MIRROR.bins(best), mirrored)


def samples_of(policy: ProjectedPolicy, count: int = 64) -> Samples:
    seen, mu = (torch.from_numpy(a).float() for a in observations(count))
    with torch.no_grad():
        bins, log = draw(policy(seen, mu), torch.rand(count, SIZES[2]))
    return Samples(seen, mu, mu, bins, log, torch.randn(count), torch.randn(count))


class Symmetric(ProjectedPolicy):
    """A policy made symmetric: the mean of its logits and the mirrored ones of the mirror image."""

    def forward(self, proprioception, parameters):
        mirror = TorchMirror(MIRROR)
        here = super().forward(proprioception, parameters)
        there = super().forward(mirror.observation(proprioception), parameters)
        return here + mirror.probabilities(there)


def test_mirror_loss_is_zero_for_a_mirrored_policy_only() -> None:
    """And it has a gradient that lowers it elsewhere."""
    weights, mirror = LossWeights(mirror=1.0), TorchMirror(MIRROR)
    policy = policy_of()
    symmetric = Symmetric(policy.shape)
    symmetric.load_state_dict(policy.state_dict())
    assert losses(symmetric, samples_of(symmetric), weights, mirror).mirror < 1e-10
    policy = policy_of()
    samples = samples_of(policy)
    before = losses(policy, samples, weights, mirror).mirror
    assert before > 0.1
    adam = torch.optim.Adam(policy.parameters(), lr=3e-3)
    for _ in range(30):
        adam.zero_grad()
        losses(policy, samples, weights, mirror).mirror.backward()
        adam.step()
    assert losses(policy, samples, weights, mirror).mirror < 0.5 * before


def test_losses_of_the_policy_that_drew() -> None:
    """Its ratio is 1: nothing is clipped, no divergence, the surrogate is the mean advantage."""
    policy = policy_of()
    samples = samples_of(policy)
    told = losses(policy, samples, LossWeights(mirror=0.0), None)
    assert float(told.kl) == pytest.approx(0, abs=1e-5)
    assert float(told.clipped) == 0
    assert told.policy.item() == pytest.approx(-float(samples.advantages.mean()), abs=1e-4)
    assert float(told.mirror) == 0


def test_advantages_by_hand() -> None:
    """An end by the clock is bootstrapped, a fall is not, and nothing flows out of a reset."""
    discount, decay = 0.9, 0.5
    rewards = np.array([[1, 1], [2, 2], [0, 0], [4, 4]], dtype=np.float32)
    values = np.array([[10, 10], [20, 20], [30, 30], [40, 40], [50, 50]], dtype=np.float32)
    end = np.array([False, True, False, False])  # the slot after it is the reset
    no = np.zeros(4, dtype=bool)
    told = advantages(
        rewards, values, np.stack([end, no], 1), np.stack([no, end], 1), discount, decay
    )
    last = 4 + 0.9 * 50 - 40
    fall, clock = 2 - 20, 2 + 0.9 * 30 - 20
    assert told[3].tolist() == pytest.approx([last, last])
    assert told[1].tolist() == pytest.approx([fall, clock])
    first = 1 + 0.9 * 20 - 10
    assert told[0].tolist() == pytest.approx([first + 0.45 * fall, first + 0.45 * clock])


# --- The bundle -----------------------------------------------------------------------------------


@pytest.mark.parametrize("method", list(Method))
def test_numpy_torch_and_onnx_pick_the_same_actions(tmp_path: Path, method: Method) -> None:
    """On 10,000 observations, all joints."""
    runtime = pytest.importorskip("onnxruntime")
    policy = policy_of(method)
    write_bundle(tmp_path, card_of(policy, method), weights_of(policy))
    run = NumpyPolicy.load(tmp_path, ROBOT)
    seen, mu = observations(10_000)
    eta = run.project(mu)
    policy.double()
    with torch.no_grad():
        told = policy.project(torch.from_numpy(mu))
        by_torch = expected(policy.logits(torch.from_numpy(seen).double(), told)).numpy()
    np.testing.assert_allclose(eta, told, atol=1e-12)
    by_numpy = run.act(seen, eta)
    session = runtime.InferenceSession(str(tmp_path / "policy.onnx"))
    fed = {"obs": seen.astype(np.float64), "eta": eta}
    known = {i.name for i in session.get_inputs()}
    by_onnx = session.run(["action"], {k: v for k, v in fed.items() if k in known})[0]
    np.testing.assert_allclose(by_numpy, by_torch, rtol=0, atol=1e-12)
    np.testing.assert_allclose(by_numpy, by_onnx, rtol=0, atol=1e-12)
    assert np.ptp(by_numpy, axis=0).min() > 0.5  # no joint stands still


@pytest.mark.parametrize("method", list(Method))
def test_other_bounds_change_the_scale_and_not_the_policy(method: Method) -> None:
    """The same physical mu gives the same logits and value; the same bounds the same bits."""
    policy = policy_of(method)
    card, rng = card_of(policy, method), np.random.default_rng(3)
    weights = weights_of(policy)
    own = np.array(card.parameter_lower), np.array(card.parameter_upper)
    same = for_bounds(card, weights, *own)
    assert same.keys() == weights.keys()
    assert all(np.array_equal(same[name], weights[name]) for name in weights)
    lower, upper = np.array([0.2, 1.0, 0.7, 0.9]), np.array([1.1, 2.0, 0.8, 0.9])
    width = np.where(upper > lower, upper - lower, 1.0)
    moved = ProjectedPolicy(policy.shape)
    moved.load_state_dict(
        {k: torch.from_numpy(v) for k, v in for_bounds(card, weights, lower, upper).items()}
    )
    mu = rng.uniform(0.6, 1.4, (200, 4))
    seen = torch.from_numpy(observations(200)[0])
    before = torch.from_numpy(((mu - own[0]) / (own[1] - own[0])).astype(np.float32))
    after = torch.from_numpy(((mu - lower) / width).astype(np.float32))
    same_to_the_policy = [lambda p, unit: p(seen, unit), lambda p, unit: p.value(seen, unit)]
    if method is Method.PUP:  # the eta of UP is mu on the scale of the bounds
        same_to_the_policy.append(lambda p, unit: p.project(unit))
    for told in same_to_the_policy:
        torch.testing.assert_close(told(policy, before), told(moved, after), rtol=1e-4, atol=2e-3)


def test_a_bundle_is_read_as_it_was_written(bundle: Path) -> None:
    """Card and weights."""
    policy = policy_of()
    card, weights = read_bundle(bundle, ROBOT)
    assert card == card_of(policy)
    for name, value in weights_of(policy).items():
        np.testing.assert_array_equal(weights[name], value)


def test_a_bundle_runs_without_torch(bundle: Path) -> None:
    """Nor with anything else that a robot's computer lacks."""
    script = (
        "import sys, pathlib, numpy as np\n"
        "from pup.policy.bundle import NumpyPolicy\n"
        f"p = NumpyPolicy.load(pathlib.Path({str(bundle)!r}))\n"
        "assert p.act(np.zeros(44), np.zeros(3)).shape == (20,)\n"
        "print([m for m in ('torch', 'onnx', 'ray', 'mujoco') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


def test_targets(bundle: Path) -> None:
    """Start pose, then the gait moved by the mean of the last actions, within the limits."""
    run = NumpyPolicy.load(bundle)
    gait, middle = ROBOT.gait, np.full((1, 20), 5)
    assert gait is not None
    lower, upper = np.array(run.card.lower), np.array(run.card.upper)
    if gait.start is not None:
        start = np.clip(gait.start, lower, upper)
        np.testing.assert_allclose(run.targets(0.0, middle), start)
    time = gait.blend + 1.25 * gait.period
    still = gait.angles(0.25)
    np.testing.assert_allclose(run.targets(time, middle), np.clip(still, lower, upper))
    pushed = np.full((9, 20), 0)
    pushed[-2:] = 10  # two of the last five
    expected = np.clip(still + 0.3 * (-0.2), lower, upper)
    np.testing.assert_allclose(run.targets(time, pushed), expected)


def refused(folder: Path, *words: str, robot: RobotDescription | None = None) -> None:
    with pytest.raises(InputError) as told:
        read_bundle(folder, robot)
    for word in words:
        assert word in str(told.value)


def test_changed_bundles_are_refused(bundle: Path) -> None:
    """Whatever file of it was changed or is missing."""
    for name in ("weights.npz", "policy.onnx"):
        content = (bundle / name).read_bytes()
        (bundle / name).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        refused(bundle, name, "does not match policy.json")
        (bundle / name).unlink()
        refused(bundle, name, "cannot be read")
        (bundle / name).write_bytes(content)
    card = json.loads((bundle / "policy.json").read_text())
    (bundle / "policy.json").write_text(json.dumps(card | {"reach": 1.0}))
    refused(bundle, "policy.json", "was changed")
    (bundle / "policy.json").write_text(json.dumps(card | {"schema": 2}))
    refused(bundle, "policy.json", "schema 1")
    (bundle / "policy.json").write_text("[]")
    refused(bundle, "policy.json", "not a policy")
    (bundle / "policy.json").unlink()
    refused(bundle, "policy.json", "cannot be read")


def test_a_bundle_of_another_robot_is_refused(bundle: Path) -> None:
    """By its joints too."""
    refused(bundle, "'darwin_op2'", "'servo_bench'", robot=RobotDescription.load("servo_bench"))
    refused(bundle, "20 joints", robot=replace(ROBOT, joints=ROBOT.joints[::-1]))


def test_targets_are_those_of_the_task(bundle: Path) -> None:
    """What a robot is sent is what was trained: reference, reach, smoothing and limits."""
    from pup.locomotion.sampling import ParameterSampler
    from pup.locomotion.settings import TaskSettings
    from pup.locomotion.task import WalkingTask
    from pup.sysid.result import read_bounds

    run, rng = NumpyPolicy.load(bundle), np.random.default_rng(3)
    sampler = ParameterSampler(read_bounds(ROBOT.identified_path, ROBOT))
    task = WalkingTask(ROBOT, sampler, TaskSettings(), 2, rng, 1)
    task.reset()
    sent: list[np.ndarray] = []
    move = task._simulations.step
    task._simulations.step = lambda target, live: sent.append(target[0]) or move(target, live)
    bins, time = rng.integers(0, 11, (12, 20)), 0.0
    for i in range(len(bins)):
        told = task.step(np.stack([bins[i], bins[i]]))
        np.testing.assert_allclose(sent[-1], run.targets(time, bins[: i + 1]), atol=1e-9)
        time = float(told.time[0])
