"""Policies: their networks, symmetry and losses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pup.policy.shape import Method

torch = pytest.importorskip("torch")

from policies import MIRROR, OBSERVATION, ROBOT, SIZES, observations, policy_of  # noqa: E402

from pup.policy.gradients import differentiated  # noqa: E402
from pup.policy.losses import (  # noqa: E402
    LossWeights,
    Samples,
    TorchMirror,
    advantages,
    losses,
)
from pup.policy.mirror import MirrorMap, unmirrored  # noqa: E402
from pup.policy.network import Normaliser, ProjectedPolicy, draw  # noqa: E402
from pup.policy.shape import PolicyShape  # noqa: E402


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
    seen = torch.from_numpy(observations(50)[0]).float()
    known = torch.randn(50, SIZES[2])

    def values() -> torch.Tensor:
        with torch.no_grad():
            return policy.value(seen, known) * policy.returns.scale + policy.returns.mean

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
        assert policy.value(seen, torch.randn(20, SIZES[2])).shape == (20,)


# --- Symmetry -------------------------------------------------------------------------------------


@settings(max_examples=30)
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
    bins = rng.integers(0, 11, SIZES[3])
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


def test_parameters_are_mirrored_with_the_joints_that_they_are_of() -> None:
    """And what has no mirror image in mu is told."""
    knees = tuple(f"backlash/gap@joint:{side}_knee" for side in "rl")
    alone = (
        *("rho/knee", "torque_limit", "torso_com/x", "torso_com/z", "ground_friction"),
        *("coulomb_friction/torque@group:ankle", "command_delay/time@bus", "imu_delay/time@sensor"),
        *("ground_slope/pitch@ground", "payload/mass@body:body", "clock_skew/share@robot"),
        *("backlash/gap@joint:head_pan", "mass/body", "com/body/x"),
    )
    names = (*knees, *alone)
    mirror = MirrorMap.of(ROBOT, OBSERVATION, names)
    assert mirror.parameters.tolist() == [1, 0, *range(2, len(names))]
    assert unmirrored(ROBOT, names) == ()
    lateral = (
        *("torso_com/y", "ground_slope/roll@ground", "com_offset/y@body:body"),
        *("backlash/gap@joint:l_ank_roll", "payload/mass@body:l_knee_link"),
        *("imu_misalignment/yaw@sensor", "encoder_bias/offset@joint:head_pan"),
        *("ground_compliance/time@foot:l_ank_roll_link", "cogging/sine@group:knee"),
        *("mass/l_knee_link", "com/l_knee_link/x", "com/l_knee_link/y", "com/body/y"),
    )
    assert unmirrored(ROBOT, (*names, *lateral)) == lateral
    assert unmirrored(ROBOT, knees[:1]) == knees[:1]


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
        bins, log = draw(policy(seen, mu), torch.rand(count, SIZES[3]))
    return Samples(
        seen, mu, torch.randn(count, SIZES[2]), bins, log, torch.randn(count), torch.randn(count)
    )


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


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("method", Method)
def test_gradients_written_out_are_those_of_autograd(method: Method, mirrored: bool) -> None:
    """With an entropy and actions on both sides of the clip, in double precision."""
    torch.manual_seed(0)
    policy = policy_of(method).double()
    for normaliser in (policy.observations, policy.returns):
        normaliser.mean += 0.3
        normaliser.variance *= 2.0
    samples = samples_of(policy.float(), 65)
    policy.double()
    samples = Samples(*(x.double() if x.is_floating_point() else x for x in samples))
    samples = samples._replace(log=samples.log + 0.4 * torch.randn(65).double())
    weights = LossWeights(entropy=0.3, mirror=0.7 if mirrored else 0.0, value=0.9)
    mirror = TorchMirror(MIRROR)
    mirror.signs = mirror.signs.double()
    expected = losses(policy, samples, weights, mirror)
    expected.total.backward()
    told, found = differentiated(policy, samples, weights, mirror)
    assert 0.1 < told.clipped < 0.9
    for one, other in zip(told, expected, strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-10, atol=1e-12)
    for gradient, (name, parameter) in zip(found, policy.named_parameters(), strict=True):
        torch.testing.assert_close(gradient, parameter.grad, rtol=1e-9, atol=1e-12, msg=name)


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
