"""What the typical sizes of effects scale with, and the places a robot has for them."""

from dataclasses import dataclass

from pup.robot import RobotDescription

MX_STALL = 2.3  # N m, the servo for which most typical sizes are known


@dataclass(frozen=True)
class Kit:
    """What sizes scale with.

    Attributes:
      robot: the robot.
      ground: whether it stands on its feet.
      stall: typical torque limit, N m.
      fast: no-load speed, rad/s.
      kp: typical stiffness, N m/rad.
      draw: A/(N m), by the motor's torque constant.
    """

    robot: RobotDescription
    ground: bool
    stall: float
    fast: float
    kp: float
    draw: float

    @classmethod
    def of(cls, robot: RobotDescription, ground: bool) -> "Kit":
        """Derive it from the description."""
        values = {s.name.partition("/")[0]: s.nominal for s in robot.parameters}
        small = values["tau_max"] < 1.0
        return cls(
            robot,
            ground,
            values["tau_max"],
            12.0 if small else 5.8,
            values["kp"],
            2.0 if small else 0.56,
        )

    @property
    def share(self) -> float:
        """Torque relative to the servo that typical sizes are known of."""
        return self.stall / MX_STALL

    def sites(self, kind: str) -> tuple[str, ...]:
        """Names of all places of a kind."""
        robot = self.robot
        if kind == "joint":
            legs = [
                j.name for j in robot.joints if any(k in j.name for k in ("hip", "knee", "ank"))
            ]
            return tuple(legs) if self.ground else robot.joint_names
        if kind == "group":
            sizes = [sum(j.group == g for j in robot.joints) for g in robot.groups]
            groups = [g for g, n in zip(robot.groups, sizes, strict=True) if n > 1]
            return tuple(g for g in groups if not self.ground or g not in ("arm", "head"))
        return {
            "foot": robot.feet,
            "ground": ("floor",),
            "sensor": ("imu",),
            "bus": ("bus",) if len(robot.joints) > 1 else (),
            "robot": (robot.name,),
        }[kind]
