"""The state of all lanes and the servos that drive them, kick by kick."""

from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from pup.blind import control, losses, unlisted
from pup.blind.mechanism import Mechanism
from pup.blind.parts import Moment, Part, Stage, hooks
from pup.blind.world import Array, Nominal, Plan, World, spanned

SAGS = 12  # rounds of the search for the pose at rest
CLEAR = 0.0005  # m above the floor to be put down from


class Scene:
    """Servos on a mechanism; arrays of shape (n_parameter_sets, n_plans, n_joints).

    Args:
      world: the concealed robot.
      plans: what is played.
      nominals: parameter sets.
      mechanism: one lane per pair of them.
    """

    def __init__(
        self,
        world: World,
        plans: Sequence[Plan],
        nominals: Sequence[Nominal],
        mechanism: Mechanism,
    ) -> None:
        self.world, self.plans, self.mechanism = world, plans, mechanism
        self.batch = mechanism.batch
        self.joints, self.dofs = spanned(mechanism.qpos), spanned(mechanism.dofs)
        self.shape = (len(nominals), len(plans), len(world.robot.joints))
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.qacc, self.force = self.batch.bind("qacc"), self.batch.bind("qfrc_applied")
        self.kp, self.kd, self.tau_max = gains(world, plans, nominals)
        rotor = np.array(self.batch.expand("dof_armature"))[:, mechanism.dofs]
        setups = [world.robot.setup(plan.setup) for plan in plans]
        volts = [setup.get("vin", setup.get("supply_voltage", 1.0)) for setup in setups]
        stage = Stage(
            shape=self.shape,
            step=world.engine.step,
            plans=plans,
            kp=self.kp,
            tau_max=self.tau_max,
            rotor=rotor.reshape(self.shape),
            supply=np.array(volts)[None, :, None],
            seed=world.seed,
        )
        parts = _parts(world, stage)
        self.sense, self.command, self.resist, self.hold = (
            hooks(parts, name) for name in ("sense", "command", "resist", "hold")
        )
        self.encoders = _encoders(world)
        self.motor = np.zeros(self.shape)
        self.nothing = np.zeros(self.shape)
        self.lead = world.engine.step / 2 if world.engine.predicted else 0.0
        if self.hold:
            self.grips = self.batch.expand("dof_frictionloss")
        if world.engine.native:
            self._install()
        for effect in world.effects:
            if effect.name == "external_force":
                body = mechanism.model.body(effect.place.names[0]).id
                push = effect.size * np.array([effect.shape[axis] for axis in "xyz"])
                self.batch.bind("xfrc_applied")[:, body, :3] = push

    def place(self, ground: bool) -> None:
        """Set every lane to rest in its first pose, sagged under its own weight or on its feet."""
        targets = np.stack([plan.target[0] for plan in self.plans] * self.shape[0])
        self.qpos[:, self.mechanism.qpos] = targets
        if ground:
            self.qpos[:, :7] = [_on_feet(self.world, self.mechanism, pose) for pose in targets]
            return
        bias = self.batch.bind("qfrc_bias")
        for _ in range(SAGS):
            self.batch.forward()
            weight = bias[:, self.mechanism.dofs].reshape(self.shape)
            sag = np.clip(weight, -self.tau_max, self.tau_max) / self.kp
            self.qpos[:, self.mechanism.qpos] = targets - sag.reshape(targets.shape)

    def sensed(self) -> Array:
        """What the encoders see."""
        position: Array = self.qpos[:, self.joints].copy()
        for joint, second, behind in self.mechanism.series:
            if behind:
                position[:, joint] += self.qpos[:, second]
        position = position.reshape(self.shape)
        for encoder in self.encoders:
            encoder(position)
        return position

    def kick(self, time: float, target: Array, power: Array, sensed: Array) -> None:
        """Set the torques of the next step.

        Args:
          time: s since the recording began.
          target: shape (n_plans, n_joints), rad.
          power: shape (n_plans, 1), 0 to 1.
          sensed: what the encoders see now.
        """
        dofs = self.dofs
        acceleration = self.qacc[:, dofs].reshape(self.shape)
        speed = self.qvel[:, dofs].reshape(self.shape) + self.lead * acceleration
        now = Moment(
            time=time,
            position=self.qpos[:, self.joints].reshape(self.shape) if self.resist else sensed,
            speed=speed,
            acceleration=acceleration,
            error=target - sensed,
            duty=self.nothing,
            loss=self.kd.copy() if self.command else self.kd,
            low=-self.tau_max,
            high=self.tau_max.copy() if self.command else self.tau_max,
            drive=self.motor,
            passive=self.nothing,
            grip=self.nothing,
        )
        for hook in self.sense:
            hook(now)
        now.duty = self.kp * now.error
        for hook in self.command:
            hook(now)
        torque = np.minimum(np.maximum(now.duty - now.loss * speed, now.low), now.high) * power
        self.motor = now.drive = torque
        if self.resist:
            now.passive = np.zeros(self.shape)
            for hook in self.resist:
                hook(now)
            torque = torque + now.passive
        if self.hold:
            now.grip = np.zeros(self.shape)
            for hook in self.hold:
                hook(now)
            self.grips[:, dofs] = now.grip.reshape(len(self.qpos), -1)
        self.force[:, dofs] = torque.reshape(len(self.qpos), -1)

    def native(self, time: float, target: Array, power: Array, sensed: Array) -> None:
        """The same by MuJoCo's own servos."""
        lanes = len(self.qpos)
        self.ctrl[:] = np.broadcast_to(target, self.shape).reshape(lanes, -1)
        most = (self.tau_max * power).reshape(lanes, -1)
        self.ranges[..., 0], self.ranges[..., 1] = -most, most

    def _install(self) -> None:
        lanes = len(self.qpos)
        kp, kd = self.kp.reshape(lanes, -1), self.kd.reshape(lanes, -1)
        self.batch.expand("actuator_gainprm")[..., 0] = kp
        bias = self.batch.expand("actuator_biasprm")
        bias[..., 1], bias[..., 2] = -kp, -kd
        self.batch.expand("actuator_forcelimited")[:] = 1
        self.ranges, self.ctrl = self.batch.expand("actuator_forcerange"), self.batch.bind("ctrl")


def gains(
    world: World, plans: Sequence[Plan], nominals: Sequence[Nominal]
) -> tuple[Array, Array, Array]:
    """Stiffness, damping and torque limit of every lane, with the plans' setups."""
    found = []
    for kind in ("kp", "kd", "tau_max"):
        own = np.stack([getattr(nominal, kind) for nominal in nominals])[:, None, :]
        scale = []
        for plan in plans:
            values = world.robot.setup(plan.setup)
            factors = [
                values[knob.name] / scaling.reference
                for knob in world.robot.knobs
                for scaling in knob.scalings
                if scaling.parameter == f"{kind}/*"
            ]
            scale.append(np.prod(factors))
        found.append(own * np.array(scale)[None, :, None])
    kp, kd, tau_max = found
    return kp, kd, tau_max


def _parts(world: World, stage: Stage) -> list[Part]:
    """The servos' parts, in the order in which they act."""
    known = {**losses.PARTS, **control.PARTS}
    order = list(known)
    effects = sorted(
        world.effects, key=lambda e: order.index(e.name) if e.name in known else len(order)
    )
    made = []
    for effect in effects:
        kind = known.get(effect.name) or unlisted.FORMS.get(effect.form)
        if kind is not None:
            made.append(kind(effect, world.joints_at(effect.place), stage))
    return made


def _encoders(world: World) -> list[Callable[[Array], None]]:
    """What changes the angles that encoders tell, in place."""

    def biased(joints: list[int], size: float) -> Callable[[Array], None]:
        def encoder(position: Array) -> None:
            position[..., joints] += size

        return encoder

    def eccentric(joints: list[int], size: float, phase: float) -> Callable[[Array], None]:
        def encoder(position: Array) -> None:
            position[..., joints] += size * np.sin(position[..., joints] + phase)

        return encoder

    found = []
    for effect in world.effects:
        joints = world.joints_at(effect.place)
        if effect.name == "encoder_bias":
            found.append(biased(joints, effect.size))
        elif effect.name == "encoder_eccentricity":
            found.append(eccentric(joints, effect.size, effect.shape["phase"]))
    return found


def _on_feet(world: World, mechanism: Mechanism, pose: Array) -> Array:
    """Where the torso is when the feet stand flat on a level floor, shape (7,)."""
    model, robot = mechanism.model, world.robot
    data = mujoco.MjData(model)
    data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    data.qpos[mechanism.qpos] = pose
    mujoco.mj_kinematics(model, data)
    feet = [model.body(foot).id for foot in robot.feet]
    up = np.mean([data.xmat[foot].reshape(3, 3)[:, 2] for foot in feet], axis=0)
    # The turn about a level axis that brings the soles' normal upright.
    axis = np.array([up[1], -up[0], 0.0])
    angle = np.arctan2(np.linalg.norm(axis), up[2])
    quaternion = np.zeros(4)
    norm = np.linalg.norm(axis)
    mujoco.mju_axisAngle2Quat(quaternion, axis / norm if norm > 0 else axis, angle)
    data.qpos[3:7] = quaternion
    mujoco.mj_kinematics(model, data)
    lowest = min(
        float(
            data.geom_xpos[g, 2] - np.abs(data.geom_xmat[g].reshape(3, 3)[2]) @ model.geom_size[g]
        )
        for g in range(model.ngeom)
        if model.geom_bodyid[g] in feet and model.geom_contype[g]
    )
    data.qpos[2] = CLEAR - lowest
    return np.array(data.qpos[:7])
