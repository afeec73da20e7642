"""How a robot's IMU sits and how late it tells: fitted beside the model.

Equation 1 compares the torso's tilt. An IMU that is mounted a few degrees askew, or whose filter
tells angles of a while ago, makes a torso lean that does not; a fit that takes it at its word moves
the torso's centre of mass instead.
"""

from pup.physics.parameters import ParameterSpace
from pup.physics.terms import Place, split_column, term_space

EFFECTS = ("imu_misalignment", "imu_delay")


def with_imu(space: ParameterSpace) -> ParameterSpace:
    """A robot's parameters with those of its IMU, but for effects that it is described with."""
    for effect in EFFECTS:
        more = term_space(effect, Place("sensor"))
        if not set(more.names) <= set(space.names):
            space = space.plus(more)
    return space


def imu_names(space: ParameterSpace) -> tuple[str, ...]:
    """The parameters of an IMU among others."""
    columns = ((name, split_column(name)) for name in space.names)
    return tuple(name for name, told in columns if told is not None and told[0] in EFFECTS)
