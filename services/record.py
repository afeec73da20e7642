"""`pup record`: motions of a virtual robot, or scripts for a robot to play itself."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from pup.errors import InputError
from pup.files import read_json
from pup.robot import RobotDescription
from services.options import knobs


def virtual(options: argparse.Namespace, robot: RobotDescription, out: Path) -> dict[str, Any]:
    """Record a virtual robot.

    Raises:
      InputError: the robot cannot play a motion, or the folder holds other recordings.
    """
    from pup.sysid.virtual import SensorNoise, record

    setup = knobs(options.setup)
    robot.setup(setup)  # refuses knobs that it has not
    made = record(
        robot,
        options.motions,
        out,
        options.seed,
        actuator=options.actuator or robot.actuator,
        noise=SensorNoise(0.0, 0.0, 0.0, 0.0) if options.noiseless else SensorNoise(),
        repeats=options.repeats,
        truth=options.truth,
        setup=setup,
    )
    return {"recordings": [str(out / f"{r.id}.parquet") for r in made]}


def scripted(options: argparse.Namespace, robot: RobotDescription, out: Path) -> dict[str, Any]:
    """Write scripts; one that is there already stays where it would be the same.

    Raises:
      InputError: the robot cannot play a motion, an option is a virtual robot's, or the folder
        holds other files or other scripts.
    """
    from pup.sysid.scripts import scripts

    virtual_only = ("actuator", "noiseless", "truth", "setup")
    given = [f"--{name}" for name in virtual_only if getattr(options, name)]
    given += ["--repeats"] if options.repeats != 1 else []
    if given:
        more = "; `pup-agent play` has one of its own" * (given[0] in ("--repeats", "--setup"))
        raise InputError(f"{given[0]} is for --virtual alone{more}")
    made = scripts(robot, options.motions, np.random.default_rng(options.seed))
    files = {out / f"{script.id}.json": script for script in made}
    if others := sorted(set(out.glob("*.json")) - files.keys()):
        raise InputError(f"{out}: holds other files ({others[0].name}); use an empty folder")
    for file, script in files.items():
        if file.exists() and read_json(file) != script.document():
            raise InputError(f"{file}: is another script, or of another seed; use an empty folder")
    for file, script in files.items():
        script.write(file)
    return {"scripts": [str(file) for file in files]}
