"""The bodies of a concealed robot: MuJoCo's model with the parts that the nominal one lacks.

Play and elasticity are joints in series: the driven joint carries the rotor, a second joint on the
same body carries what the gear or the link gives way.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from mujoco.batch import Batch

from pup.blind.world import Effect, Engine, Indices, Nominal, Plan, World
from pup.errors import InputError

FLOOR = "floor"
GRAVITY = 9.81  # m/s2
TEETH = (0.002, 1.0)  # s and damping ratio of gear teeth that meet
HARD = (0.98, 0.995, 0.001, 0.5, 2.0)  # teeth hardly give way: play that is nil is none
STICKY = (0.99, 0.9995, 0.001, 0.5, 2.0)  # dry friction hardly creeps
FIRM = (0.002, 1.0)
BETWEEN = 0.1  # of the rotor's inertia, what lies between parts in series
LEAST = 0.05  # of friction or damping that is left of a contact
ON_GROUND = ("ground_compliance", "ground_slope", "ground_friction", "contact_restitution")
INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
SOLVERS = {
    "newton": mujoco.mjtSolver.mjSOL_NEWTON,
    "cg": mujoco.mjtSolver.mjSOL_CG,
    "pgs": mujoco.mjtSolver.mjSOL_PGS,
}
CONES = {
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
}


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A batch of simulations, one lane per pair of parameters and plan.

    Attributes:
      batch: the lanes.
      model: their common model.
      qpos: where the driven joints stand in qpos, in the robot's order.
      dofs: where they stand in qvel.
      series: per driven joint with a second one: its order, the second's qpos, and whether the
        encoder sits behind the second.
    """

    batch: Batch
    model: mujoco.MjModel
    qpos: Indices
    dofs: Indices
    series: tuple[tuple[int, int, bool], ...] = field(default=())


def build(
    world: World, support: str, plans: Sequence[Plan], nominals: Sequence[Nominal]
) -> Mechanism:
    """Make the lanes: all plans under the first parameters, then all under the next, ...

    Raises:
      InputError: MuJoCo refuses the model.
    """
    robot = world.robot
    spec = mujoco.MjSpec.from_file(str(robot.model_path))
    if support != "ground":
        for joint in [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]:
            spec.delete(joint)
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    _integrate(spec, world.engine)
    for name in robot.joint_names:
        spec.joint(name).armature = nominals[0].armature
    for effect in world.effects:
        _equip(world, spec, effect, support)
    if world.engine.native:
        for name in robot.joint_names:
            spec.add_actuator(
                name=name,
                target=name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            )
    try:
        model = spec.compile()
    except ValueError as error:
        told = " ".join(str(error).split())
        raise InputError(f"{robot.model_path}: MuJoCo refuses it: {told}") from error
    ids = [model.joint(name).id for name in robot.joint_names]
    batch = Batch(model, len(plans) * len(nominals), nthread=1)
    mechanism = Mechanism(
        batch,
        model,
        np.array(model.jnt_qposadr[ids], dtype=np.int64),
        np.array(model.jnt_dofadr[ids], dtype=np.int64),
        tuple(_series(world, model)),
    )
    _adjust(world, mechanism, plans, nominals)
    return mechanism


def _integrate(spec: mujoco.MjSpec, engine: Engine) -> None:
    spec.option.timestep = engine.step
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # what breaks down must show
    spec.option.integrator = INTEGRATORS[engine.integrator]
    spec.option.solver = SOLVERS[engine.solver]
    spec.option.cone = CONES[engine.cone]
    spec.option.impratio = engine.impratio
    for geom in spec.geoms:
        if geom.name == FLOOR:
            geom.solref = (engine.contact_time, 1.0)


def _equip(world: World, spec: mujoco.MjSpec, effect: Effect, support: str) -> None:
    """Put one effect's parts into the model, where it has some."""
    joints = [world.robot.joint_names[i] for i in world.joints_at(effect.place)]
    if effect.name == "backlash":
        for name in joints:
            play = _second(spec, spec.joint(name), effect)
            play.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            play.range = (-effect.size, effect.size)
            play.solref_limit, play.solimp_limit = TEETH, HARD
            play.damping = (effect.shape["drag"], 0, 0)
    elif effect.name == "joint_compliance":
        for name in joints:
            spring = _second(spec, spec.joint(name), effect)
            _stiffen(spring, effect)
    elif effect.name == "structural_flex":
        for name in effect.place.names:
            axis = tuple(effect.shape[a] for a in "xyz")
            driven = next((j for j in spec.joints if j.parent.name == name), None)
            spring = spec.body(name).add_joint(
                name=f"{name}:bends", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis
            )
            spring.pos = driven.pos if driven else (0, 0, effect.shape.get("root", 0.0))
            _stiffen(spring, effect)
    elif effect.name == "joint_stop":
        for name in joints:
            joint = spec.joint(name)
            low, high = joint.range
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            joint.range = (low, effect.size) if effect.shape["side"] > 0 else (effect.size, high)
            joint.solref_limit = (effect.shape["give"], 0.7)
    elif support == "ground" and effect.name in ON_GROUND:
        _lay_ground(world, spec, effect)


def _second(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, effect: Effect) -> mujoco.MjsJoint:
    """A joint of the same axis in series; one may have play and give way, too.

    It has an inertia of its own: with nothing between two of them their equations are singular.
    """
    return joint.parent.add_joint(
        name=f"{joint.name}:{effect.name}",
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=tuple(joint.axis),
        pos=tuple(joint.pos),
        armature=BETWEEN * joint.armature,
        frictionloss=0.0,
    )


def _stiffen(spring: mujoco.MjsJoint, effect: Effect) -> None:
    """A material's losses grow with its stiffness, which also keeps the stiffest spring stable."""
    spring.stiffness = (effect.size, 0, 0)
    spring.damping = (effect.shape["loss"] * effect.size, 0, 0)


def _lay_ground(world: World, spec: mujoco.MjSpec, effect: Effect) -> None:
    """Ground effects: of the whole floor, or of one foot's sole, which then has the say."""
    floor = spec.geom(FLOOR)
    if effect.name == "ground_slope":
        heading = effect.shape["heading"]
        half = effect.size / 2
        floor.quat = (
            np.cos(half),
            np.sin(half) * np.cos(heading),
            np.sin(half) * np.sin(heading),
            0.0,
        )
        return
    touched = [floor]
    if effect.place.kind == "foot":
        touched = []
        for foot in effect.place.names:
            for geom in spec.body(foot).geoms:
                if geom.contype or geom.conaffinity:
                    geom.priority = floor.priority + 1
                    geom.friction, geom.solref = floor.friction, floor.solref
                    geom.solimp, geom.condim = floor.solimp, floor.condim
                    touched.append(geom)
    for geom in touched:
        if effect.name == "ground_compliance":
            _soften(geom, effect, world.engine)
        elif effect.name == "contact_restitution":
            own, share = world.engine.contact_time, min(effect.size, 1.0)
            time = own + share * (effect.shape["time"] - own)
            geom.solref = (time, max(1.0 - effect.size, LEAST))


def _soften(geom: mujoco.MjsGeom, effect: Effect, engine: Engine) -> None:
    """Let a mass at rest on this contact sag by so much more than on the nominal one.

    At rest it sags by (1 - impedance) g (time constant x damping ratio)^2.
    """
    least, most = geom.solimp[:2]
    own = (1.0 - most) * GRAVITY * engine.contact_time**2
    share = effect.size / (effect.size + own)  # how far from the nominal contact
    give = effect.shape["impedance"]
    least, most = least + share * (give - least), most + share * (give - most)
    damping = 1.0 + share * (effect.shape["damping"] - 1.0)
    time = np.sqrt((own + effect.size) / ((1.0 - most) * GRAVITY)) / damping
    geom.solref = (time, damping)
    geom.solimp = (least, most, *geom.solimp[2:])


def _series(world: World, model: mujoco.MjModel) -> list[tuple[int, int, bool]]:
    found = []
    for effect in world.effects:
        if effect.name in ("backlash", "joint_compliance"):
            for i in world.joints_at(effect.place):
                second = model.joint(f"{world.robot.joint_names[i]}:{effect.name}")
                found.append((i, int(second.qposadr[0]), effect.shape["side"] > 0))
    return found


def _adjust(
    world: World, mechanism: Mechanism, plans: Sequence[Plan], nominals: Sequence[Nominal]
) -> None:
    """Set what differs from lane to lane, then what the effects add to it."""
    batch, model, robot = mechanism.batch, mechanism.model, world.robot
    lanes = [(nominal, plan) for nominal in nominals for plan in plans]
    masses, centres = batch.expand("body_mass"), batch.expand("body_ipos")
    rotors, friction = batch.expand("dof_armature"), batch.expand("geom_friction")
    floors = [g for g in range(model.ngeom) if model.geom(g).name == FLOOR]
    for lane, (nominal, plan) in enumerate(lanes):
        values = robot.setup(plan.setup)
        for knob in robot.knobs:
            for edit in knob.edits:
                element = {
                    "body": model.body,
                    "geom": model.geom,
                    "site": model.site,
                    "jnt_": model.joint,
                    "dof_": model.joint,
                }[edit.field[:4]](edit.element)
                row = element.dofadr[0] if edit.field.startswith("dof_") else element.id
                at = (lane, row) if edit.index is None else (lane, row, edit.index)
                batch.expand(edit.field)[at] = edit.scale * values[knob.name] + edit.offset
        rotors[lane, mechanism.dofs] = nominal.armature
        friction[lane, floors, 0] = nominal.friction
    for effect in world.effects:
        bodies = [model.body(n).id for n in effect.place.names if effect.place.kind == "body"]
        if effect.name == "payload":
            masses[:, bodies] += effect.size
        elif effect.name == "com_offset":
            centres[:, bodies] += effect.size * np.array([effect.shape[a] for a in "xyz"])
        elif effect.name == "structural_flex":
            _root(batch, model, bodies)
        elif effect.name == "armature":
            rotors[:, mechanism.dofs[world.joints_at(effect.place)]] += effect.size
        elif effect.name in ("ground_friction", "ground_compliance", "contact_restitution"):
            soles = [
                g
                for g in range(model.ngeom)
                if model.body(model.geom_bodyid[g]).name in effect.place.names
            ]
            share = max(1.0 - effect.size, LEAST) if effect.name == "ground_friction" else 1.0
            if effect.place.kind == "foot" and floors:
                friction[:, soles, :1] = share * friction[:, floors, :1]
            elif effect.name == "ground_friction":
                friction[:, floors, 0] *= share
    batch.expand("dof_solref")[:] = FIRM
    batch.expand("dof_solimp")[:] = STICKY
    batch.set_const()


def _root(batch: Batch, model: mujoco.MjModel, bodies: Sequence[int]) -> None:
    """Leave the roots of bending bodies where their parents carry them.

    A knob that moves a body's frame would take the root along, which is told in that frame. A body
    with a driven joint bends there, and the knob moves both.
    """
    places, roots = batch.expand("body_pos"), batch.expand("jnt_pos")
    turn = np.empty(9)
    for body in bodies:
        if model.body_jntnum[body] == 1:  # nothing but what bends
            mujoco.mju_quat2Mat(turn, model.body_quat[body])
            moved = places[:, body] - model.body_pos[body]
            roots[:, model.body_jntadr[body]] -= moved @ turn.reshape(3, 3)
