"""What `robot.toml` says of the body and its motions, checked against the MJCF."""

from pup.robot_mjcf import MjcfNames, absent
from pup.robot_parts import (
    NETWORK_WEIGHTS,
    Actuator,
    Gait,
    Harmonics,
    Joint,
    NetworkOptions,
    ParameterSpec,
    Walk,
)
from pup.robot_toml import Table, listed

TIMESTEPS = (1e-5, 0.02)  # s
USUAL_TIMESTEP = 0.002  # s


def read_joints(table: Table, model: MjcfNames) -> tuple[Joint, ...]:
    """Read the joints, in order; they are exactly those of the MJCF."""
    joints: list[Joint] = []
    for entry in table.tables("joint"):
        joint = Joint(
            name=entry.name("name"),
            servo_id=entry.integer("servo_id"),
            group=entry.name("group"),
            lower=entry.number("lower"),
            upper=entry.number("upper"),
            mirror=entry.optional_name("mirror"),
            mirror_sign=entry.number("mirror_sign", 1.0),
        )
        entry.close()
        if joint.name in [other.name for other in joints]:
            raise entry.mistake("name", f"joint {joint.name!r} stands twice; remove one")
        if joint.name not in model.joints:
            raise entry.mistake(
                "name", f"model.xml has no joint {joint.name!r}; it has: {listed(model.joints)}"
            )
        if not joint.lower < joint.upper:
            raise entry.mistake("lower", f"{joint.lower:g} is not below upper = {joint.upper:g}")
        if joint.mirror_sign not in (1.0, -1.0):
            raise entry.mistake("mirror_sign", f"{joint.mirror_sign:g} is neither 1 nor -1")
        if joint.servo_id is not None:
            if not 0 <= joint.servo_id <= 252:
                raise entry.mistake("servo_id", f"{joint.servo_id} is no bus address; use 0 to 252")
            for other in joints:
                if other.servo_id == joint.servo_id:
                    raise entry.mistake(
                        "servo_id",
                        f"{joint.servo_id} is also that of {other.name}; give each servo its own",
                    )
        joints.append(joint)
    if not joints:
        raise table.mistake("joint", "missing; list the joints, in order, as [[joint]] tables")
    missing = [name for name in model.joints if name not in {joint.name for joint in joints}]
    if missing:
        raise table.mistake(
            "joint", f"model.xml also has: {listed(missing)}; list every joint or remove it there"
        )
    _check_mirror(table, joints)
    return tuple(joints)


def _check_mirror(table: Table, joints: list[Joint]) -> None:
    """Refuse a mirror map that is partial, no involution or mixes groups."""
    by_name = {joint.name: joint for joint in joints}
    if all(joint.mirror is None for joint in joints):
        return
    for i, joint in enumerate(joints, 1):
        key = f"joint[{i}].mirror"
        if joint.mirror is None:
            raise table.mistake(
                key, f"{joint.name} has none; give all joints a mirror (itself on the mid-plane)"
            )
        partner = by_name.get(joint.mirror)
        if partner is None:
            raise table.mistake(key, f"there is no joint {joint.mirror!r}")
        if partner.mirror != joint.name:
            raise table.mistake(
                key,
                f"{joint.name} mirrors {partner.name}, which mirrors {partner.mirror}; pair them",
            )
        if partner.mirror_sign != joint.mirror_sign:
            raise table.mistake(
                key, f"{joint.name} and {partner.name} have different mirror_sign; use one for both"
            )
        if partner.group != joint.group:
            raise table.mistake(
                key, f"{joint.name} and {partner.name} are of different groups; put them in one"
            )


def read_groups(table: Table, joints: tuple[Joint, ...]) -> tuple[str, ...]:
    """Read the order of the groups; left out, it is that of their first joints."""
    used = tuple(dict.fromkeys(joint.group for joint in joints))
    groups = table.names("groups")
    if groups and set(groups) != set(used):
        raise table.mistake("groups", f"{listed(groups)} listed, but the joints use {listed(used)}")
    return groups or used


def read_torso(table: Table, model: MjcfNames) -> str | None:
    """Read the torso; the free joint, if there is one, is its own."""
    torso = table.optional_name("torso")
    if torso is not None and torso not in model.bodies:
        raise table.mistake("torso", absent("body", torso))
    if model.floating is not None and model.floating != torso:
        raise table.mistake(
            "torso", f"the free joint of model.xml belongs to body {model.floating!r}; name it here"
        )
    return torso


def read_imu_site(table: Table, model: MjcfNames) -> str | None:
    """Read the site of the IMU."""
    site = table.optional_name("imu_site")
    if site is not None and site not in model.sites:
        raise table.mistake("imu_site", absent("site", site))
    return site


def read_feet(table: Table, model: MjcfNames) -> tuple[str, ...]:
    """Read the bodies meant to touch the floor."""
    feet = table.names("feet")
    for foot in feet:
        if foot not in model.bodies:
            raise table.mistake("feet", absent("body", foot))
    if feet and "floor" not in model.geoms:
        raise table.mistake("feet", "model.xml has no geom named 'floor'; add one or drop the feet")
    return feet


def read_timestep(table: Table) -> float:
    """Read the physics step, s."""
    timestep = table.number("timestep", USUAL_TIMESTEP)
    low, high = TIMESTEPS
    if not low <= timestep <= high:
        raise table.mistake("timestep", f"{timestep:g} s is outside [{low:g}, {high:g}] s")
    return timestep


def read_poses(table: Table, joints: tuple[Joint, ...]) -> dict[str, tuple[float, ...]]:
    """Read the poses; joints a pose leaves out are at 0."""
    poses = {}
    section = table.table("poses")
    for name in section.left():
        pose = section.table(name)
        values = []
        for joint in joints:
            value = pose.number(joint.name, 0.0)
            if not joint.lower <= value <= joint.upper:
                raise pose.mistake(
                    joint.name,
                    f"{value:g} is outside the joint's limits [{joint.lower:g}, {joint.upper:g}]",
                )
            values.append(value)
        pose.close()
        poses[name] = tuple(values)
    return poses


def read_actuator(table: Table, network: NetworkOptions | None) -> Actuator:
    """Read the torque law to use by default; left out, NN-PD where the robot has a network."""
    if not table.has("actuator"):
        return "pd" if network is None else "nn_pd"
    named = table.text("actuator")
    if named == "pd":
        return "pd"
    if named != "nn_pd":
        raise table.mistake("actuator", f"{named!r} is none; write 'pd' or 'nn_pd'")
    if network is None:
        raise table.mistake("actuator", "'nn_pd' needs a [network]")
    return "nn_pd"


def read_network(table: Table, parameters: tuple[ParameterSpec, ...]) -> NetworkOptions | None:
    """Read the options of the NN-PD actuator."""
    if not table.has("network"):
        if any("nn_pd" in spec.actuators and "pd" not in spec.actuators for spec in parameters):
            raise table.mistake("network", "missing; the nn_pd parameters need its weights")
        return None
    section = table.table("network")
    network = NetworkOptions(
        error_scale=section.number("error_scale"),
        kp_scale=section.number("kp_scale"),
        kd_scale=section.number("kd_scale"),
        passive_damping=section.number("passive_damping"),
        armature=section.number("armature"),
        weights=section.numbers("weights", NETWORK_WEIGHTS),
    )
    section.close()
    for key in ("error_scale", "kp_scale", "kd_scale", "passive_damping", "armature"):
        if getattr(network, key) < 0:
            raise section.mistake(key, "must not be negative")
    return network


def read_gait(
    table: Table,
    joints: tuple[Joint, ...],
    poses: dict[str, tuple[float, ...]],
    feet: tuple[str, ...],
    model: MjcfNames,
) -> Gait | None:
    """Read the reference motion; joints it leaves out stay at 0."""
    if not table.has("gait"):
        return None
    section = table.table("gait")
    gait = Gait(
        period=section.number("period"),
        joints=_series(section.table("joints"), joints),
        start=_start(section, poses),
        start_pitch=section.number("start_pitch") if section.has("start_pitch") else None,
        blend=section.number("blend", Gait.blend),
        tilt_limit=section.number("tilt_limit", Gait.tilt_limit),
        drift_limit=section.number("drift_limit", Gait.drift_limit),
        ground_bodies=section.names("ground_bodies") or feet,
        imu_pitch_offset=section.number("imu_pitch_offset", Gait.imu_pitch_offset),
    )
    section.close()
    if gait.period <= 0:
        raise section.mistake("period", f"{gait.period:g} s is not above 0")
    if gait.blend < 0:
        raise section.mistake("blend", f"{gait.blend:g} s is negative")
    for key in ("tilt_limit", "drift_limit"):
        if getattr(gait, key) <= 0:
            raise section.mistake(key, f"{getattr(gait, key):g} is not above 0")
    for body in gait.ground_bodies:
        if body not in model.bodies:
            raise section.mistake("ground_bodies", absent("body", body))
    return gait


def read_walk(table: Table) -> Walk:
    """Read what of the walking task goes by the robot's size; what is left out is as the OP2's."""
    section, default = table.table("walk"), Walk()
    slowest, fastest = section.numbers("control_rate", 2, default.control_rate)
    substeps = section.integer("substeps")
    walk = Walk(
        control_rate=(slowest, fastest),
        substeps=default.substeps if substeps is None else substeps,
        effort=section.number("effort", default.effort),
        work=section.number("work", default.work),
    )
    section.close()
    if not 0 < slowest <= fastest:
        raise section.mistake(
            "control_rate",
            f"[{slowest:g}, {fastest:g}] Hz; write [slowest, fastest], both above 0",
        )
    if walk.substeps < 1:
        raise section.mistake("substeps", f"{walk.substeps} is less than 1")
    for key in ("effort", "work"):
        if getattr(walk, key) < 0:
            raise section.mistake(key, f"{getattr(walk, key):g} is negative")
    _check_substeps(section, walk)
    return walk


def _check_substeps(section: Table, walk: Walk) -> None:
    """Refuse sub-steps that no robot's physics may have."""
    low, high = TIMESTEPS
    slowest, fastest = walk.control_rate
    for step in (1 / slowest / walk.substeps, 1 / fastest / walk.substeps):
        if not low <= step <= high:
            raise section.mistake(
                "substeps",
                f"{walk.substeps} a control step take {step:g} s each, outside "
                f"[{low:g}, {high:g}] s",
            )


def _start(section: Table, poses: dict[str, tuple[float, ...]]) -> tuple[float, ...] | None:
    """The pose a gait is taken up from."""
    if not section.has("start"):
        return None
    name = section.text("start")
    if name not in poses:
        known = listed(poses) or "none"
        raise section.mistake("start", f"there is no pose {name!r}; poses: {known}")
    return poses[name]


def _series(entries: Table, joints: tuple[Joint, ...]) -> dict[str, Harmonics]:
    series = {}
    for joint in joints:
        if not entries.has(joint.name):
            series[joint.name] = Harmonics(0.0, (), ())
            continue
        entry = entries.table(joint.name)
        harmonics = Harmonics(entry.number("c0"), entry.numbers("a"), entry.numbers("b"))
        entry.close()
        if len(harmonics.a) != len(harmonics.b):
            raise entry.mistake("b", f"{len(harmonics.b)} numbers, but a has {len(harmonics.a)}")
        series[joint.name] = harmonics
    for name in entries.left():
        raise entries.mistake(name, "there is no such joint; remove it or correct the name")
    return series
