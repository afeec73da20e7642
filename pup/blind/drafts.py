"""Drawing cases: what is concealed in each, before anything is simulated of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pup.blind.catalogue import CLASS_OF, KINDS, MASKED, available, draw, plausible, unlisted
from pup.blind.kit import Kit
from pup.blind.programme import programme
from pup.blind.reference import readings
from pup.blind.sensors import Noise
from pup.blind.setting import Setting
from pup.blind.world import STEP, Effect, Engine, Nominal, Plan, World, nominal_names, steady
from pup.errors import InputError
from pup.robot import RobotDescription

SPREAD = 0.25  # relative, of the nominal parameters
WIDE_SPREAD = 0.6  # the same where they are far off
SIZES = (0.5, 1.5)  # times typical
NUISANCES, NUISANCE = 2, (0.03, 0.15)  # how many, and times typical
FALLEN = 0.9  # rad of roll or pitch at which a fall's recording ends
TOLD_BY_FALLS = ("imu_delay",)
TOLD_BY_STEPS = ("contact_restitution", "ground_friction")


@dataclass(frozen=True, eq=False)
class Draft:
    """A case in the making.

    Attributes:
      stratum: what it is drawn for; nulls begin with `null:`.
      world: the robot with the effects to be found.
      plans: what is played.
      noise: of its sensors.
      values: its nominal parameters by name.
      nuisance: small other effects.
      verdicts: those that the data allow, where they cannot tell.
      answers: effects that they cannot tell apart.
      room: by how much the effects' size may still grow.
    """

    stratum: str
    world: World
    plans: tuple[Plan, ...]
    noise: Noise
    values: Mapping[str, float]
    nuisance: tuple[Effect, ...] = ()
    verdicts: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    room: float = 1.0

    @property
    def effects(self) -> tuple[Effect, ...]:
        """What is to be found."""
        return self.world.effects

    def full(self) -> World:
        """The robot with its nuisance."""
        return replace(self.world, effects=(*self.world.effects, *self.nuisance))

    def resized(self, factor: float) -> "Draft":
        """The same with `factor` times as much of the effects.

        Raises:
          InputError: no robot has so much or so little of them.
        """
        kit = Kit.of(self.world.robot, any(plan.support == "ground" for plan in self.plans))
        effects = tuple(effect.scaled(factor) for effect in self.effects)
        if not all(plausible(effect, kit) for effect in effects):
            raise InputError("an effect of a size that no robot has")
        world = replace(self.world, effects=effects)
        return replace(self, world=world, room=max(1.0, self.room / factor))


def _values(
    robot: RobotDescription, ground: bool, spread: float, rng: np.random.Generator
) -> dict[str, float]:
    """Nominal parameters away from the description's by up to a relative spread."""
    names = nominal_names(robot, ground)
    known = {spec.name: spec for spec in robot.parameters}
    factors = np.exp(rng.uniform(np.log(1 - spread), np.log(1 + spread), size=len(names)))
    drawn = {n: known[n].nominal * float(f) for n, f in zip(names, factors, strict=True)}
    return {n: float(np.clip(v, *known[n].search)) for n, v in drawn.items()}


def _base(
    robot: RobotDescription,
    stratum: str,
    ground: bool,
    rng: np.random.Generator,
    given: Setting,
) -> Draft:
    """Robot, sensors and plans, without effects."""
    values = _values(robot, ground, WIDE_SPREAD if given.wide else SPREAD, rng)
    nominal, seed = Nominal.of(robot, values), int(rng.integers(2**31))
    world = World(robot, nominal, seed=seed, engine=Engine(step=steady(nominal, STEP)))
    noise = Noise(position=float(rng.uniform(0.001, 0.002)), imu=float(rng.uniform(0.001, 0.003)))
    if given.rough:
        noise = replace(
            noise,
            memory=float(rng.uniform(0.4, 0.85)),
            lost=float(rng.uniform(0.003, 0.02)),
            gaps=float(rng.uniform(0.01, 0.05)),
        )
    plans = tuple(_cut(world, plan) for plan in programme(robot, ground, given, rng))
    return Draft(stratum, world, plans, noise, values)


def _cut(world: World, plan: Plan) -> Plan:
    """A fall up to where the robot is switched off; other plans as they are."""
    if plan.motion != "fall":
        return plan
    tilt = readings(world, [plan])[0][plan.id].tilt
    rows = max(10, int(np.argmax([*(np.abs(tilt).max(axis=1) > FALLEN), True])))
    return replace(plan, time=plan.time[:rows], target=plan.target[:rows])


def draw_null(
    robot: RobotDescription, kind: str, ground: bool, rng: np.random.Generator, given: Setting
) -> Draft:
    """Nothing material is missing."""
    draft = _base(robot, f"null:{kind}", ground, rng, given)
    if kind == "engine":
        return replace(draft, world=replace(draft.world, engine=_engine(robot.floating, rng)))
    if kind == "nuisance":
        return replace(draft, nuisance=_nuisance(Kit.of(robot, ground), (), rng))
    return draft


def _engine(ground: bool, rng: np.random.Generator) -> Engine:
    """Another integrator, step or contact solver than ours."""
    engine = [
        Engine(native=True, integrator="implicitfast", step=0.001),
        Engine(native=True, integrator="implicit", step=0.0005),
        Engine(native=True, integrator="implicitfast", step=0.00025),
        Engine(integrator="rk4", step=0.00025, predicted=False),
        Engine(integrator="euler", step=0.00025, predicted=False),
    ][int(rng.integers(5))]
    if ground:  # smaller steps would take minutes
        return replace(
            engine,
            step=max(engine.step, 0.0005),
            cone=str(rng.choice(["pyramidal", "elliptic"])),
            solver=str(rng.choice(["newton", "cg"])),
            impratio=float(rng.choice([1.0, 5.0])),
            contact_time=float(rng.choice([0.01, 0.02])),
        )
    return engine


def _nuisance(kit: Kit, besides: Sequence[Effect], rng: np.random.Generator) -> tuple[Effect, ...]:
    """Small other effects, of other classes than those of the case."""
    taken = {CLASS_OF.get(effect.name) for effect in besides}
    names = [n for n in available(kit) if CLASS_OF[n] not in taken and n != "joint_stop"]
    chosen: list[Effect] = []
    for name in rng.permutation(names):
        if CLASS_OF[name] not in {CLASS_OF[e.name] for e in chosen}:
            chosen.append(draw(str(name), kit, rng).scaled(float(rng.uniform(*NUISANCE))))
        if len(chosen) == NUISANCES:
            break
    return tuple(chosen)


def draw_case(
    robot: RobotDescription, stratum: str, ground: bool, rng: np.random.Generator, given: Setting
) -> Draft:
    """Something is missing."""
    kit = Kit.of(robot, ground)
    if stratum == "unidentifiable":
        return _unidentifiable(kit, rng, given)
    names = _candidates(kit, stratum, rng, given)
    if stratum == "unlisted":
        effects = [draw(str(rng.choice(unlisted())), kit, rng)]
    else:
        first, second = (str(n) for n in rng.choice(names, size=2, replace=False))
        effects = [draw(first, kit, rng)]
        if stratum == "pair":
            if CLASS_OF[first] == CLASS_OF[second]:
                raise InputError("a pair of one class")
            effects.append(draw(second, kit, rng))
    factor = float(rng.uniform(*SIZES))
    effects = [e.scaled(factor) for e in effects]
    draft = _base(robot, stratum, ground, rng, given)
    if not all(_told(draft, e) for e in effects):
        raise InputError("a weight that one load cannot tell")
    effects = [_stopped(draft, e) for e in effects]
    nuisance = _nuisance(kit, effects, rng) if rng.uniform() < 0.5 else ()
    world = replace(draft.world, effects=tuple(effects))
    return replace(draft, world=world, nuisance=nuisance, room=SIZES[1] / factor)


def _candidates(kit: Kit, stratum: str, rng: np.random.Generator, given: Setting) -> list[str]:
    """Effects that a stratum is drawn from; on the ground mostly those that only show there."""
    silent = (*TOLD_BY_FALLS * (not given.fall), *TOLD_BY_STEPS * (not given.walk))
    names = [name for name in available(kit) if name not in silent]
    local = kit.ground and rng.uniform() < 0.6  # drawn for all strata: seeds keep their meaning
    if stratum == "masked":  # none of these is of the ground or of a body
        return [n for n in names if n in MASKED]
    if local:
        names = [n for n in names if KINDS[n].where == "ground" or "body" in KINDS[n].places]
    if stratum in ("below_noise", "weak"):
        names = [n for n in names if n != "joint_stop"]
    return names


def _told(draft: Draft, effect: Effect) -> bool:
    """Whether the recordings may tell it from nominal parameters.

    On a single joint more weight is the same as less of all that the servo does, but where known
    loads differ: see `_unidentifiable`.
    """
    if effect.name != "payload" or len(draft.world.robot.joints) > 1:
        return True
    return len({plan.setup["mass"] for plan in draft.plans if not plan.test}) > 1


def _stopped(draft: Draft, effect: Effect) -> Effect:
    """Put a stop within the joint's way, which only the motion itself can tell."""
    if effect.name != "joint_stop":
        return effect
    joint = draft.world.joints_at(effect.place)[0]
    seen = readings(draft.world, draft.plans)[0]
    way = np.concatenate([s.position[:, joint] for s in seen.values()])
    share, side = effect.shape["quantile"], effect.shape["side"]
    return replace(effect, size=float(np.quantile(way, share if side > 0 else 1 - share)))


def _unidentifiable(kit: Kit, rng: np.random.Generator, given: Setting) -> Draft:
    """Effects that the recordings cannot tell apart, or cannot tell from nominal parameters."""
    robot = kit.robot
    alone = len(robot.joints) == 1
    forms = ["mass", "bias"] * (alone and given.plain) + ["delay"] * given.powered
    form = str(rng.choice(forms or ["delay"]))
    # Torque that is switched off at once tells a late command from a late reading.
    given = replace(given, powered=given.powered or form == "delay")
    draft = _base(robot, "unidentifiable", False, rng, given)
    kit, factor = Kit.of(robot, False), float(rng.uniform(*SIZES))
    verdicts: tuple[str, ...] = ("mismatch", "undetermined")
    answers: tuple[str, ...]
    if form == "mass":
        effect = draw("payload", kit, rng).scaled(factor)
        verdicts, answers = ("none", "undetermined"), ("payload",)
    elif form == "bias":
        answers = ("com_offset", "encoder_bias")
        effect = draw(str(rng.choice(answers)), kit, rng).scaled(factor)
    else:
        answers = ("command_delay", "measurement_delay")
        places = ("joint",) if alone else ("bus",)
        effect = draw(str(rng.choice(answers)), kit, rng, places).scaled(factor)
        effect = replace(effect, shape={"jitter": 0.0, "lost": 0.0}, form="together")
    world = replace(draft.world, effects=(effect,))
    return replace(draft, world=world, verdicts=verdicts, answers=answers)
