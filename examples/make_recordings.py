"""Makes the recordings that come with the package, of a virtual Darwin OP2.

    python examples/make_recordings.py

Nine step tests, two stand-ups and two falls are played through the servo bus of virtual robot 0 and
go to pup/robots/darwin_op2/recordings. `pup run` without recordings of one's own identifies this
robot, trains for it, and walks it: what it is like is told nowhere.
"""

from pathlib import Path

import numpy as np

from pup.recording import write_recordings
from pup.robot import RobotDescription
from pup.sysid.excitation import script
from services.experiment.playing import Player, virtual_robot
from services.trials import CHARACTER

RECORDINGS = Path(__file__).parents[1] / "pup/robots/darwin_op2/recordings"

SEED = 2019
KINDS = (
    *("step:0.1", "step:0.3", "step:0.6") * 3,
    *("standup:1.75", "standup:2"),
    *("fall:forward", "fall:left"),
)


def main(folder: Path = RECORDINGS) -> None:
    """Play the scripts and write what was read."""
    robot = RobotDescription.load("darwin_op2")
    motions = script(robot, KINDS, np.random.default_rng(SEED), jitter=True)
    with virtual_robot(robot, CHARACTER, Path("/dev/null")) as doors:
        player = Player(robot, doors, CHARACTER)
        made = [player.play(m, m.id, SEED + i, None) for i, m in enumerate(motions)]
        player.close()
    write_recordings(made, folder)
    size = sum(file.stat().st_size for file in folder.glob("*.parquet"))
    print(f"{len(made)} recordings, {size / 1000:.0f} kB, in {folder}")


if __name__ == "__main__":
    main()
