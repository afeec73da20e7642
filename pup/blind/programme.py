"""Which recordings a laboratory takes of one robot."""

from dataclasses import replace

import numpy as np

from pup.blind.motions import FEET, GAPS, LIMB, ROUGH_GAPS, Choreographer
from pup.blind.setting import Setting
from pup.blind.world import Plan
from pup.robot import RobotDescription

REPEATED = 0.85  # share of cases with three repeats of one motion
TESTED = 0.6  # share of cases with motions kept for the held-out score
AGAIN = 2  # repeats besides the first

BENCH_LOADS = (0.15, 0.25, 0.3247, 0.45)  # kg
BENCH_ARMS = (0.08, 0.1, 0.13)  # m
BENCH_MOMENT = 0.034  # kg m, largest
BENCH_GAINS = (16.0, 32.0, 48.0)
BENCH_SUPPLIES = (5.0, 6.0, 7.4)  # V
SUPPLIES = (11.1, 12.0, 13.5)  # V
GAINS = (16.0, 32.0, 64.0)
PAYLOADS = (0.0, 0.2, 0.4)  # kg


def programme(
    robot: RobotDescription, ground: bool, given: Setting, rng: np.random.Generator
) -> tuple[Plan, ...]:
    """Draw the plans of a case, in random order, named without meaning.

    Args:
      robot: who is to play.
      ground: whether most of them are on its feet.
      given: what they must and may not have.
      rng: source of all that is random.
    """
    maker = Choreographer(robot, rng, ROUGH_GAPS if given.rough else GAPS)
    train, test = _types(ground, given, rng)
    setups = _setups(robot, ground, given.plain, rng)
    plans = []
    for motion, on_feet, is_test in [*((m, f, False) for m, f in train), *test]:
        plan = maker.feet(motion) if on_feet else maker.limb(motion)
        setup = setups[int(rng.integers(len(setups)))]
        if not on_feet:
            setup = {k: v for k, v in setup.items() if k != "payload"}
        plans.append(replace(plan, test=is_test, setup=setup))
    names = [f"r{n:02d}" for n in rng.permutation(np.arange(1, len(plans) + AGAIN + 1))]
    named = [replace(plan, id=names[n]) for n, plan in enumerate(plans)]
    if rng.uniform() < REPEATED:
        steady = [p for p in named if not p.test and p.motion not in ("fall", "walk", "drop")]
        first = steady[int(rng.integers(len(steady)))]
        named += [maker.again(first, names[len(plans) + n]) for n in range(AGAIN)]
    return tuple(sorted(named, key=lambda plan: plan.id))


def _types(
    ground: bool, given: Setting, rng: np.random.Generator
) -> tuple[list[tuple[str, bool]], list[tuple[str, bool, bool]]]:
    """Motion types with whether they are on the feet: training motions, then tests."""
    limbs = [m for m in LIMB if not (given.powered and m == "drop")]
    order = [str(m) for m in rng.permutation(limbs)]
    tested = rng.uniform() < TESTED
    if not ground:
        train = [(m, False) for m in order[: int(rng.integers(4, 6))]]
        rest = order[len(train) :]
        tests = [(m, False, True) for m in rest[: int(rng.integers(1, 3))]]
        if not tested:  # all that there is goes to the engine
            return [*train, *((m, False) for m in rest[: int(rng.integers(0, 2))])], []
        return train, tests
    train = [(m, True) for m in FEET] + [(m, False) for m in order[: int(rng.integers(1, 3))]]
    train += [("fall", True)] * given.fall + [("walk", True)] * given.walk
    if not tested:
        return train, []
    return train, [(order[3], False, True)] + [("walk", True, True)] * (not given.walk)


def _setups(
    robot: RobotDescription, ground: bool, plain: bool, rng: np.random.Generator
) -> list[dict[str, float]]:
    """The setups that a case's recordings are taken with."""
    knobs = {knob.name: knob.default for knob in robot.knobs}
    if "length" in knobs:
        first = {"mass": float(rng.choice(BENCH_LOADS)), "length": float(rng.choice(BENCH_ARMS))}
        first |= {"kp": 32.0, "vin": 6.0}
        options = {
            "mass": BENCH_LOADS,
            "length": BENCH_ARMS,
            "kp": BENCH_GAINS,
            "vin": BENCH_SUPPLIES,
        }
    else:
        first = {"supply_voltage": 12.0, "p_gain": 32.0}
        options = {"supply_voltage": SUPPLIES, "p_gain": GAINS}
        if ground and "payload" in knobs:
            first["payload"] = 0.0
            options = {"supply_voltage": SUPPLIES, "payload": PAYLOADS}
    if plain:
        return [_within(first)]
    varied = [str(k) for k in rng.permutation(list(options))[: int(rng.integers(1, 3))]]
    drawn = ({**first, k: float(rng.choice(options[k]))} for k in varied for _ in range(2))
    return [_within(setup) for setup in (first, *drawn)]


def _within(setup: dict[str, float]) -> dict[str, float]:
    """The same with no more weight than the servo can lift with ease."""
    if "length" not in setup:
        return setup
    return {**setup, "mass": min(setup["mass"], round(BENCH_MOMENT / setup["length"], 3))}
