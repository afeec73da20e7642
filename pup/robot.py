"""What a robot is: a folder with `robot.toml` and `model.xml`, read strictly."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import sha256
from pup.robot_mjcf import check_path, read_mjcf
from pup.robot_parts import (
    Actuator,
    Edit,
    Gait,
    Harmonics,
    Joint,
    Knob,
    NetworkOptions,
    ParameterSpec,
    Scaling,
    TermSpec,
    Walk,
)
from pup.robot_reader import (
    read_actuator,
    read_feet,
    read_gait,
    read_groups,
    read_imu_site,
    read_joints,
    read_network,
    read_poses,
    read_timestep,
    read_torso,
    read_walk,
)
from pup.robot_space import read_knobs, read_parameters
from pup.robot_terms import read_terms
from pup.robot_toml import Table, read_text

__all__ = [
    "Actuator",
    "Edit",
    "Gait",
    "Harmonics",
    "Joint",
    "Knob",
    "NetworkOptions",
    "ParameterSpec",
    "RobotDescription",
    "Scaling",
    "TermSpec",
    "Walk",
    "built_in_robots",
]

BUILT_IN = Path(__file__).parent / "robots"
ROBOT_LIMIT = 2**20  # bytes


@dataclass(frozen=True)
class RobotDescription:
    """A robot, as its folder describes it.

    Attributes:
      name: what recordings call it.
      folder: where `robot.toml` and `model.xml` stand.
      joints: in the order of every joint vector.
      groups: in the order of parameter names.
      torso: the body whose motion counts; None for a bench.
      imu_site: the site whose orientation the IMU reports; None without an IMU.
      feet: the bodies meant to touch the floor.
      floating: whether the base is free in the MJCF.
      poses: named joint vectors, rad.
      knobs: what a recording's setup may set.
      parameters: the parameter space, in order.
      terms: what the physics has beside the nominal model.
      gait: the reference motion, if any.
      walk: what of the walking task goes by its size.
      network: options of the NN-PD actuator; None where it is not offered.
      actuator: the torque law to use when none is asked for.
      timestep: physics step, s.
      digest: SHA-256 over robot.toml, model.xml, its includes and its assets.
    """

    name: str
    folder: Path
    joints: tuple[Joint, ...]
    groups: tuple[str, ...]
    torso: str | None
    imu_site: str | None
    feet: tuple[str, ...]
    floating: bool
    poses: dict[str, tuple[float, ...]]
    knobs: tuple[Knob, ...]
    parameters: tuple[ParameterSpec, ...]
    terms: tuple[TermSpec, ...]
    gait: Gait | None
    walk: Walk
    network: NetworkOptions | None
    actuator: Actuator
    timestep: float
    digest: str

    @classmethod
    def load(cls, source: str | Path) -> "RobotDescription":
        """Load a built-in robot by name, or a robot from its folder.

        Raises:
          InputError: no such robot, or a mistake in its files.
        """
        folder = _folder(source)
        check_path(folder)
        file = folder / "robot.toml"
        text = read_text(file, ROBOT_LIMIT)
        table = Table.read(text, file)
        model = read_mjcf(folder / "model.xml")
        if table.integer("schema") != 1:
            raise table.mistake("schema", "not 1; this version reads schema = 1 only")
        joints = read_joints(table, model)
        groups = read_groups(table, joints)
        torso = read_torso(table, model)
        feet = read_feet(table, model)
        imu_site = read_imu_site(table, model)
        parameters = read_parameters(table, groups, torso, model)
        network = read_network(table, parameters)
        poses = read_poses(table, joints)
        robot = cls(
            name=table.name("name"),
            folder=folder.absolute(),
            joints=joints,
            groups=groups,
            torso=torso,
            imu_site=imu_site,
            feet=feet,
            floating=model.floating is not None,
            poses=poses,
            knobs=read_knobs(table, parameters, model),
            parameters=parameters,
            terms=read_terms(table, joints, groups, feet, imu_site, model),
            gait=read_gait(table, joints, poses, feet, model),
            walk=read_walk(table),
            network=network,
            actuator=read_actuator(table, network),
            timestep=read_timestep(table),
            digest=_digest((text, *model.texts), folder, sorted(model.assets)),
        )
        table.close()
        return robot

    def __hash__(self) -> int:
        """Robots read from the same text may share what is derived from them."""
        return hash((self.folder, self.digest))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in order."""
        return tuple(joint.name for joint in self.joints)

    @property
    def limits(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least and largest angles of the joints, each (n_joints,), rad (m for a slide)."""
        lower = np.array([joint.lower for joint in self.joints])
        return lower, np.array([joint.upper for joint in self.joints])

    @property
    def group_index(self) -> NDArray[np.intp]:
        """Position in `groups` of each joint's group, shape (n_joints,)."""
        return np.array([self.groups.index(joint.group) for joint in self.joints], dtype=np.intp)

    @property
    def model_path(self) -> Path:
        """The MJCF file."""
        return self.folder / "model.xml"

    @property
    def identified_path(self) -> Path:
        """Where the fits of real recordings stand; the file need not exist."""
        return self.folder / "identified.json"

    @property
    def mirrored(self) -> bool:
        """Whether the robot has a left-right mirror map."""
        return all(joint.mirror is not None for joint in self.joints)

    def mirror(self) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """The left-right mirror map: `mirrored = sign * q[..., permutation]`.

        Returns:
          permutation and sign, both of shape (n_joints,).

        Raises:
          InputError: the robot has no mirror map.
        """
        index = {name: i for i, name in enumerate(self.joint_names)}
        partners = [joint.mirror for joint in self.joints if joint.mirror is not None]
        if not self.mirrored:
            raise InputError(
                f"{self.folder / 'robot.toml'}: robot {self.name!r} has no mirror map; "
                "give every joint a mirror and a mirror_sign"
            )
        permutation = np.array([index[partner] for partner in partners], dtype=np.intp)
        return permutation, np.array([joint.mirror_sign for joint in self.joints])

    def setup(self, setup: Mapping[str, float]) -> dict[str, float]:
        """All knobs of the robot, set as in a recording's setup and at their defaults elsewhere.

        Raises:
          InputError: a knob the robot does not have, or a value outside its limits.
        """
        values = {knob.name: knob.default for knob in self.knobs}
        for name in setup:
            if name not in values:
                known = ", ".join(values) or "none"
                raise InputError(
                    f"setup: {name!r} is no knob of robot {self.name!r} (knobs: {known}); "
                    "correct the recording's setup or add the knob to robot.toml"
                )
        for knob in self.knobs:
            value = float(setup.get(knob.name, knob.default))
            if not knob.lower <= value <= knob.upper:
                raise InputError(
                    f"setup: {knob.name} = {value:g} {knob.unit} is outside "
                    f"[{knob.lower:g}, {knob.upper:g}] of robot {self.name!r}; "
                    "correct the recording's setup or the knob's limits in robot.toml"
                )
            values[knob.name] = value
        return values


def built_in_robots() -> tuple[str, ...]:
    """Names of the robots that come with the package."""
    return tuple(sorted(path.parent.name for path in BUILT_IN.glob("*/robot.toml")))


def _digest(texts: Sequence[str], folder: Path, assets: Sequence[Path]) -> str:
    """SHA-256 over the texts and the assets that a robot is made of."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(hashlib.sha256(text.encode()).digest())
    for asset in assets:
        digest.update(f"{asset.as_posix()} {sha256(folder / asset)}".encode())
    return digest.hexdigest()


def _folder(source: str | Path) -> Path:
    """The folder of a built-in name or of a path."""
    folder = Path(source)
    if source in built_in_robots():
        known = BUILT_IN / source
        if (folder / "robot.toml").is_file() and folder.resolve() != known.resolve():
            raise InputError(
                f"{source}: is a built-in robot, and a folder here; write ./{source} for the "
                "folder, or give it another name"
            )
        return known
    if not (folder / "robot.toml").is_file():
        raise InputError(
            f"{source}: neither a built-in robot ({', '.join(built_in_robots())}) "
            "nor a folder with a robot.toml"
        )
    return folder
