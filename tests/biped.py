"""The smallest robot that walks: a box on two legs of one joint each, made for tests."""

from pathlib import Path

import numpy as np

from pup.physics.parameters import robot_space
from pup.robot import RobotDescription
from pup.sysid.result import FittedBounds

LEG = """
    <body name="{side}_leg" pos="0 {y} -0.03">
      <joint name="{side}_hip" axis="0 1 0" range="-1 1"/>
      <inertial mass="0.2" pos="0 0 -0.05" diaginertia="1e-3 1e-3 1e-3"/>
      <geom name="{side}_foot" type="box" size="0.06 0.03 0.01" pos="0 0 -0.1"
        contype="0" conaffinity="1"/>
    </body>"""
MODEL = """
<mujoco model="biped">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.05" priority="1" contype="1" conaffinity="0"/>
    <body name="body" pos="0 0 0.14">
      <freejoint name="root"/>
      <inertial mass="1" pos="0 0 0" diaginertia="4e-3 4e-3 4e-3"/>
      <geom name="torso" type="box" size="0.04 0.05 0.03" contype="0" conaffinity="1"/>
      {legs}
    </body>
  </worldbody>
</mujoco>
"""
TOML = """
schema = 1
name = "biped"
torso = "body"
feet = ["l_leg", "r_leg"]
timestep = 0.004
joint = [
  { name = "l_hip", servo_id = 1, group = "hip", lower = -0.8, upper = 0.8 },
  { name = "r_hip", servo_id = 2, group = "hip", lower = -0.8, upper = 0.8 },
]
[poses.stand]
[gait]
period = 0.5
start = "stand"
[gait.joints.l_hip]
c0 = 0.0
a = [0.1]
b = [0.0]
[[parameter]]
name = "kp/*"
unit = "N m/rad"
nominal = 10.0
search = [1.0, 30.0]
actuators = ["pd"]
[[parameter]]
name = "kd/*"
unit = "N m s/rad"
nominal = 0.3
search = [0.05, 1.0]
actuators = ["pd"]
[[parameter]]
name = "tau_max/*"
unit = "N m"
nominal = 2.0
search = [0.5, 5.0]
actuators = ["pd"]
[[parameter]]
name = "armature"
unit = "kg m2"
nominal = 0.001
search = [0.0001, 0.01]
actuators = ["pd"]
[[parameter]]
name = "ground_friction"
unit = "1"
nominal = 0.7
search = [0.1, 1.5]
actuators = ["pd"]
"""


def biped(folder: Path) -> RobotDescription:
    """The robot, written to a folder."""
    legs = LEG.format(side="l", y=0.05) + LEG.format(side="r", y=-0.05)
    (folder / "model.xml").write_text(MODEL.format(legs=legs))
    (folder / "robot.toml").write_text(TOML)
    return RobotDescription.load(str(folder))


def biped_bounds(robot: RobotDescription) -> FittedBounds:
    """Bounds of a stiffness, the torque limit and the floor's friction."""
    return FittedBounds(
        actuator="pd",
        space=robot_space(robot, "pd"),
        names=("kp/hip", "tau_max/hip", "ground_friction"),
        lower=np.array([8.0, 1.5, 0.5]),
        upper=np.array([12.0, 2.5, 0.9]),
    )
