"""A robot of few lines, as text to be changed."""

from collections.abc import Callable
from pathlib import Path

MODEL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk">
      <freejoint/>
      <geom size="0.1"/>
      <site name="imu"/>
      <body name="left"><joint name="l"/><geom size="0.1"/></body>
      <body name="right"><joint name="r"/><geom size="0.1"/></body>
    </body>
  </worldbody>
  <equality><joint joint1="l" joint2="r" active="false"/></equality>
</mujoco>
"""

ROBOT = """
schema = 1
name = "twin"
torso = "trunk"
imu_site = "imu"
feet = ["left", "right"]
joint = [
  { name = "l", servo_id = 1, group = "leg", lower = -1, upper = 1, mirror = "r", mirror_sign = -1},
  { name = "r", servo_id = 2, group = "leg", lower = -1, upper = 1, mirror = "l", mirror_sign = -1},
]

[poses.open]
l = 0.5

[[knob]]
name = "load"
unit = "kg"
default = 0
lower = 0
upper = 2
edit = [{ field = "body_mass", element = "trunk", offset = 1.0 }]
scaling = [{ parameter = "kp/*", reference = 1.0 }]

[[parameter]]
name = "kp/*"
unit = "N m/rad"
nominal = 2
search = [1, 3]
actuators = ["pd"]

[[parameter]]
name = "kd/leg"
unit = "N m s/rad"
nominal = 0.2
search = [0.1, 0.3]
actuators = ["pd"]

[[parameter]]
name = "tau_max/leg"
unit = "N m"
nominal = 2
search = [1, 3]
actuators = ["pd"]

[[parameter]]
name = "armature"
unit = "kg m2"
nominal = 0.001
search = [0, 0.01]
actuators = ["pd"]

[gait]
period = 0.5

[gait.joints.l]
c0 = 0.1
a = [1.0, 0.0]
b = [0.0, 0.5]
"""


def robot_folder(path: Path, robot: str = ROBOT, model: str = MODEL) -> Path:
    path.mkdir(exist_ok=True)
    (path / "robot.toml").write_text(robot)
    (path / "model.xml").write_text(model)
    return path


def swap(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change
