"""What `robot.toml` lets a recording set (knobs) and identification move (parameters)."""

from pup.robot_mjcf import MjcfNames, absent
from pup.robot_parts import Actuator, Edit, Knob, ParameterSpec, Scaling
from pup.robot_toml import Table, listed

BOTH: tuple[Actuator, ...] = ("nn_pd", "pd")
# Kinds of parameters and the actuator models that know them: one per group (`kp/hip`), ...
SIGNED_KINDS = frozenset(("torso_com", "com"))
"""Parameters that may be negative: offsets."""
GROUP_KINDS: dict[str, tuple[Actuator, ...]] = {
    "rho": ("nn_pd",),
    "sigma": ("nn_pd",),
    "kp": ("pd",),
    "kd": ("pd",),
    "tau_max": ("pd",),
    "damping": BOTH,
    "coulomb": BOTH,
}
# ... one for the robot, ...
ROBOT_KINDS: dict[str, tuple[Actuator, ...]] = {
    "torque_limit": ("nn_pd",),
    "armature": ("pd",),
    "torso_com/x": BOTH,
    "torso_com/y": BOTH,
    "torso_com/z": BOTH,
    "ground_friction": BOTH,
    "command_delay": BOTH,
}
# ... or one per body: `mass/<body>` is a factor, `com/<body>/x` (y, z) an offset in m.
REQUIRED: dict[Actuator, tuple[str, ...]] = {
    "pd": ("kp/*", "kd/*", "tau_max/*", "armature"),
    "nn_pd": ("rho/*", "sigma/*", "torque_limit"),
}
# Model fields a knob may edit: what kind of element they belong to and how many components.
# Damping and armature of joints belong to the actuator model.
EDIT_FIELDS: dict[str, tuple[str, int]] = {
    "body_mass": ("body", 1),
    "body_pos": ("body", 3),
    "body_ipos": ("body", 3),
    "body_inertia": ("body", 3),
    "geom_pos": ("geom", 3),
    "geom_size": ("geom", 3),
    "geom_friction": ("geom", 3),
    "site_pos": ("site", 3),
    "jnt_range": ("joint", 2),
    "jnt_stiffness": ("joint", 1),
    "dof_frictionloss": ("joint", 1),
}
SIGNED_FIELDS = frozenset(("body_pos", "body_ipos", "geom_pos", "site_pos", "jnt_range"))
"""Those that may be negative."""


def read_parameters(
    table: Table, groups: tuple[str, ...], torso: str | None, model: MjcfNames
) -> tuple[ParameterSpec, ...]:
    """Read the parameter space.

    A name such as `kp/*` stands for all groups; an exact name after it replaces that one.
    """
    specs: dict[str, ParameterSpec] = {}
    replaceable: set[str] = set()
    for entry in table.tables("parameter"):
        name = entry.text("name")
        kind, _, tail = name.partition("/")
        expand = kind in GROUP_KINDS and tail == "*"
        unit = entry.text("unit")
        nominal = entry.number("nominal")
        search = entry.interval("search")
        actuators = entry.names("actuators")
        entry.close()
        if not search[0] <= nominal <= search[1]:
            raise entry.mistake(
                "nominal", f"{nominal:g} is outside search = [{search[0]:g}, {search[1]:g}]"
            )
        if kind not in SIGNED_KINDS and search[0] < 0:
            raise entry.mistake("search", f"{search[0]:g}: {kind} cannot be negative")
        known = _actuators_of(entry, name, groups, model)
        if kind == "torso_com" and torso is None:
            raise entry.mistake(
                "name", f"{name} needs a torso; name the body at the top of the file"
            )
        users = tuple(actuator for actuator in known if actuator in actuators)
        if not users or len(users) < len(actuators):
            raise entry.mistake(
                "actuators", f"{list(actuators)} given, but {name} is for {listed(known)}"
            )
        for full in [f"{kind}/{group}" for group in groups] if expand else [name]:
            if full in specs and (expand or full not in replaceable):
                raise entry.mistake("name", f"{full} stands twice; remove one")
            specs[full] = ParameterSpec(full, unit, nominal, search, users)
            (replaceable.add if expand else replaceable.discard)(full)
    _check_complete(table, specs, groups)
    return tuple(specs.values())


def _actuators_of(
    entry: Table, name: str, groups: tuple[str, ...], model: MjcfNames
) -> tuple[Actuator, ...]:
    """The actuator models that know a parameter; an unknown parameter is refused."""
    kind, _, tail = name.partition("/")
    if kind in GROUP_KINDS:
        if tail != "*" and tail not in groups:
            raise entry.mistake("name", f"there is no group {tail!r}; groups: {listed(groups)}")
        return GROUP_KINDS[kind]
    if kind in ("mass", "com"):
        body, _, axis = tail.rpartition("/") if kind == "com" else (tail, "", "x")
        if body not in model.bodies:
            raise entry.mistake("name", absent("body", body or tail))
        if axis not in ("x", "y", "z"):
            raise entry.mistake("name", f"{name!r} does not end in /x, /y or /z")
        return BOTH
    if name not in ROBOT_KINDS:
        kinds = [f"{kind}/<group>" for kind in GROUP_KINDS] + [*ROBOT_KINDS]
        raise entry.mistake(
            "name",
            f"unknown parameter {name!r}; known: {listed(kinds)}, mass/<body>, com/<body>/<axis>",
        )
    if name == "ground_friction" and "floor" not in model.geoms:
        raise entry.mistake("name", "ground_friction needs a geom named 'floor' in model.xml")
    return ROBOT_KINDS[name]


def _check_complete(table: Table, specs: dict[str, ParameterSpec], groups: tuple[str, ...]) -> None:
    """Refuse an actuator model that lacks one of its parameters; PD is never left out."""
    for actuator, patterns in REQUIRED.items():
        names = [
            full
            for pattern in patterns
            for full in (
                [pattern.replace("*", group) for group in groups] if "*" in pattern else [pattern]
            )
        ]
        missing = [name for name in names if name not in specs]
        if missing and (actuator == "pd" or len(missing) < len(names)):
            raise table.mistake(
                "parameter", f"the {actuator} actuator also needs: {listed(missing)}; add them"
            )


def read_knobs(
    table: Table, parameters: tuple[ParameterSpec, ...], model: MjcfNames
) -> tuple[Knob, ...]:
    """Read what a recording's setup may set."""
    knobs: list[Knob] = []
    for entry in table.tables("knob"):
        knob = Knob(
            name=entry.name("name"),
            unit=entry.text("unit"),
            default=entry.number("default"),
            lower=entry.number("lower"),
            upper=entry.number("upper"),
            edits=tuple(_edit(edit, model) for edit in entry.tables("edit")),
            scalings=tuple(_scaling(scaling, parameters) for scaling in entry.tables("scaling")),
        )
        entry.close()
        if knob.name in [other.name for other in knobs]:
            raise entry.mistake("name", f"knob {knob.name!r} stands twice; remove one")
        if not knob.lower < knob.upper:
            raise entry.mistake("lower", f"{knob.lower:g} is not below upper = {knob.upper:g}")
        if not knob.lower <= knob.default <= knob.upper:
            raise entry.mistake(
                "default", f"{knob.default:g} is outside [{knob.lower:g}, {knob.upper:g}]"
            )
        if not knob.edits and not knob.scalings:
            raise entry.mistake("", f"knob {knob.name!r} does nothing; add an edit or a scaling")
        for edit in knob.edits:
            least, end = min((edit.scale * e + edit.offset, e) for e in (knob.lower, knob.upper))
            if least < 0 and edit.field not in SIGNED_FIELDS:
                told = f"{edit.field} of {edit.element} would be {least:g} at {knob.name} = {end:g}"
                raise entry.mistake("edit", f"{told}; it cannot be negative")
        knobs.append(knob)
    return tuple(knobs)


def _edit(entry: Table, model: MjcfNames) -> Edit:
    edit = Edit(
        field=entry.text("field"),
        element=entry.name("element"),
        index=entry.integer("index"),
        scale=entry.number("scale", 1.0),
        offset=entry.number("offset", 0.0),
    )
    entry.close()
    if edit.field not in EDIT_FIELDS:
        raise entry.mistake("field", f"{edit.field!r} cannot be edited; use {listed(EDIT_FIELDS)}")
    kind, size = EDIT_FIELDS[edit.field]
    elements = {
        "body": model.bodies,
        "geom": model.geoms,
        "site": model.sites,
        "joint": frozenset(model.joints),
    }[kind]
    if edit.element not in elements:
        raise entry.mistake("element", absent(kind, edit.element))
    if size == 1 and edit.index is not None:
        raise entry.mistake("index", f"{edit.field} is a single number; remove the index")
    if size > 1 and (edit.index is None or not 0 <= edit.index < size):
        raise entry.mistake("index", f"{edit.field} has {size} components; give 0 to {size - 1}")
    return edit


def _scaling(entry: Table, parameters: tuple[ParameterSpec, ...]) -> Scaling:
    scaling = Scaling(entry.text("parameter"), entry.number("reference"))
    entry.close()
    if scaling.reference <= 0:
        raise entry.mistake("reference", f"{scaling.reference:g} is not above 0")
    pattern = scaling.parameter
    prefix = pattern.removesuffix("*") if pattern.endswith("/*") else None
    if not any(
        spec.name == pattern if prefix is None else spec.name.startswith(prefix)
        for spec in parameters
    ):
        raise entry.mistake("parameter", f"the robot has no parameter {pattern!r}")
    return scaling
