"""The bundle a robot runs."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pup.errors import InputError
from pup.files import write_json
from pup.policy.bundle import NumpyPolicy, PolicyCard, _digest, read_bundle, write_bundle
from pup.policy.rebase import for_bounds
from pup.policy.shape import Method
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected

torch = pytest.importorskip("torch")

from policies import COURSE, ROBOT, card_of, observations, policy_of, weights_of  # noqa: E402

from pup.policy.network import ProjectedPolicy, expected  # noqa: E402

EXAMPLES = Path(__file__).parents[1] / "examples" / "policies"


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    policy = policy_of()
    write_bundle(tmp_path / "policy", card_of(policy), weights_of(policy))
    return tmp_path / "policy"


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
    same = for_bounds(card, weights, card.parameters, *own, COURSE)
    assert same.keys() == weights.keys()
    assert all(np.array_equal(same[name], weights[name]) for name in weights)
    lower, upper = np.array([0.2, 1.0, 0.7, 0.9]), np.array([1.1, 2.0, 0.8, 0.9])
    width = np.where(upper > lower, upper - lower, 1.0)
    moved = ProjectedPolicy(policy.shape)
    other = for_bounds(card, weights, card.parameters, lower, upper, COURSE)
    moved.load_state_dict({k: torch.from_numpy(v) for k, v in other.items()})
    mu = rng.uniform(0.6, 1.4, (200, 4))
    seen = torch.from_numpy(observations(200)[0])
    before = torch.from_numpy(((mu - own[0]) / (own[1] - own[0])).astype(np.float32))
    after = torch.from_numpy(((mu - lower) / width).astype(np.float32))
    same_to_the_policy = [lambda p, unit: p(seen, unit), lambda p, unit: p.value(seen, known(unit))]
    if method is Method.PUP:  # the eta of UP is mu on the scale of the bounds
        same_to_the_policy.append(lambda p, unit: p.project(unit))
    for told in same_to_the_policy:
        torch.testing.assert_close(told(policy, before), told(moved, after), rtol=1e-4, atol=2e-3)


@pytest.mark.parametrize("method", list(Method))
def test_other_parameters_are_seen_later_and_lost_ones_no_more(method: Method) -> None:
    """What both know counts as before, a lost one as its middle, a new one not at all."""
    policy = policy_of(method)
    card, rng = card_of(policy, method), np.random.default_rng(3)
    first, lost, *rest = card.parameters
    names = (*rest, "new", first)
    own = {n: (a, b) for n, a, b in zip(*_bounds(card), strict=True)} | {"new": (3.0, 5.0)}
    lower, upper = np.array([own[name] for name in names]).T
    moved = ProjectedPolicy(policy.shape)
    other = for_bounds(card, weights_of(policy), names, lower, upper, COURSE)
    moved.load_state_dict({k: torch.from_numpy(v) for k, v in other.items()})
    unit = rng.uniform(0, 1, (200, 4)).astype(np.float32)
    unit[:, 1] = 0.5
    after = np.column_stack([unit[:, 2:], rng.uniform(0, 1, 200), unit[:, 0]]).astype(np.float32)
    seen = torch.from_numpy(observations(200)[0])
    before, after = torch.from_numpy(unit), torch.from_numpy(after)
    for told in (lambda p, u: p(seen, u), lambda p, u: p.value(seen, known(u))):
        torch.testing.assert_close(told(policy, before), told(moved, after), rtol=1e-4, atol=2e-3)
    assert lost not in names


def known(unit: torch.Tensor) -> torch.Tensor:
    """What a value function sees besides: a course, and mu about 0."""
    course = torch.linspace(-1, 1, len(unit))[:, None].repeat(1, COURSE)
    return torch.cat([course, 2 * unit - 1], dim=1)


def test_a_value_function_that_saw_no_course_goes_on_with_one() -> None:
    """It tells the same values until it has learnt what the course means."""
    shape = replace(policy_of().shape, privileged=4)
    old = ProjectedPolicy(shape)
    card = replace(card_of(policy_of()), shape=shape)
    own = np.array(card.parameter_lower), np.array(card.parameter_upper)
    told = for_bounds(card, weights_of(old), card.parameters, *own, COURSE)
    new = ProjectedPolicy(policy_of().shape)
    new.load_state_dict({k: torch.from_numpy(v) for k, v in told.items()})
    seen, mu = (torch.from_numpy(a).float() for a in observations(50))
    before, after = old.value(seen, 2 * mu - 1), new.value(seen, known(mu))
    torch.testing.assert_close(before, after, rtol=1e-5, atol=1e-5)


def _bounds(card: PolicyCard) -> tuple[tuple[str, ...], tuple[float, ...], tuple[float, ...]]:
    return card.parameters, card.parameter_lower, card.parameter_upper


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


@pytest.mark.parametrize("part", ["rates", "sha256", "policy.onnx"])
@pytest.mark.parametrize("more", [{}, {"clock": 1}, {"method": "sac"}])
def test_a_bundle_of_another_pup_is_refused(
    bundle: Path, part: str, more: dict[str, object]
) -> None:
    """Its card is whole, but tells less, more or something else."""
    card = json.loads((bundle / "policy.json").read_text())
    del card["digest"]
    del (card if part in card else card["sha256"])[part]
    write_json(bundle / "policy.json", card | more | {"digest": _digest(card | more)})
    refused(bundle, "policy.json", "another version")


def test_a_bundle_of_another_robot_is_refused(bundle: Path) -> None:
    """By its joints too."""
    refused(bundle, "'darwin_op2'", "'servo_bench'", robot=RobotDescription.load("servo_bench"))
    refused(bundle, "20 joints", robot=replace(ROBOT, joints=ROBOT.joints[::-1]))


def moved(robot: RobotDescription, count: int) -> RobotDescription:
    """With other limits of its first joints."""
    first = (replace(joint, upper=joint.upper - 0.1) for joint in robot.joints[:count])
    return replace(robot, joints=(*first, *robot.joints[count:]))


GAIT = ROBOT.gait
assert GAIT is not None
OTHER = {
    "a limit": (moved(ROBOT, 1), "other limits of l_sho_pitch; "),
    "many limits": (moved(ROBOT, 5), "limits of l_el and more; "),
    "an offset": (
        replace(ROBOT, gait=replace(GAIT, imu_pitch_offset=0.0)),
        "other gait.imu_pitch_offset; ",
    ),
    "both": (
        moved(replace(ROBOT, gait=replace(GAIT, period=0.5)), 1),
        "other limits of l_sho_pitch, gait.period; ",
    ),
    "no gait": (replace(ROBOT, gait=None), "other gait.period, gait.joints, "),
}


@pytest.mark.parametrize("name", OTHER)
def test_a_policy_runs_no_robot_that_was_described_otherwise(bundle: Path, name: str) -> None:
    """It may be trained further for one."""
    robot, words = OTHER[name]
    with pytest.raises(InputError, match=r"policy\.json: trained on .* --start") as told:
        NumpyPolicy.load(bundle, robot)
    assert words in str(told.value)
    assert read_bundle(bundle, robot)


def test_a_policy_runs_a_robot_that_was_corrected(bundle: Path, tmp_path: Path) -> None:
    """By a diagnosis, which writes other parameters and terms."""
    term = TermSpec("backlash", "joint", "l_knee", {"gap": 0.02})
    nominal = {ROBOT.parameters[0].name: ROBOT.parameters[0].nominal * 1.1}
    robot = write_corrected(ROBOT, tmp_path / "corrected", nominal, (term,))
    assert robot.digest != ROBOT.digest and robot.terms
    assert NumpyPolicy.load(bundle, robot).card == NumpyPolicy.load(bundle, ROBOT).card


def test_the_policies_that_come_with_pup_run_their_robots() -> None:
    shipped = [*ROBOT.folder.glob("policies/*"), *EXAMPLES.glob("*/*/")]
    assert len([NumpyPolicy.load(folder, ROBOT) for folder in shipped]) == 11


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
