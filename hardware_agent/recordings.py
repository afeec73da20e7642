"""Recordings of walks: written, told to the gateway, and saved from an agent that was killed."""

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hardware_agent.flight import FlightRecorder
from hardware_agent.rollout import recording_id, recording_of
from hardware_agent.trials import RESTARTED, End
from pup.errors import InputError
from pup.files import sha256
from pup.robot import RobotDescription
from pup.wire import CHUNK, Assign, Body, Finished, Outcome, RecordingChunk

log = logging.getLogger("pup-agent")

Array = NDArray[np.float64]
Kept = tuple[str, str]
"""A recording's id and its file's digest."""


class Recordings:
    """The recordings of an agent.

    Args:
      state: folder of the agent's files.
      robot: whose they are.
      source: `hardware` or `simulation`.
    """

    def __init__(self, state: Path, robot: RobotDescription, source: str) -> None:
        self._folder, self._robot, self._source = state / "recordings", robot, source
        self.flight = FlightRecorder(state / "walk", robot.joint_names)

    def keep(self, assign: Assign, rows: Array, reason: str) -> Kept | None:
        """Write the recording of a walk; None where there was no motion, or it cannot be written.

        Args:
          assign: the trial.
          rows: of its ticks; see `row_names`.
          reason: why it ended.
        """
        if len(rows) < 2:
            return None
        notes = f"eta {list(assign.eta)}; policy {assign.policy}; {reason}"
        joints = self._robot.joint_names
        try:  # a full disk, or rows that a power cut has spoilt: the walk counts all the same
            made = recording_of(assign, rows, joints, self._robot.name, self._source, notes)
            file = self._file(made.id)
            made.write(file)
            return made.id, sha256(file)
        except (OSError, InputError) as error:
            log.error("recording of %s is lost: %s", assign.trial, error)
            return None

    def salvage(self, assign: Assign) -> End:
        """How a trial ended whose agent was killed while it walked."""
        flight = self.flight.left()
        if flight is None or recording_id(flight.assign) != recording_id(assign):
            return End(Outcome.ABORTED, RESTARTED)
        kept = self.keep(assign, flight.rows, RESTARTED)
        if kept is None:
            return End(Outcome.ABORTED, RESTARTED)
        return End(Outcome.ABORTED, RESTARTED, None, float(flight.rows[-1, 0]), *kept)

    def pieces(self, finished: Finished) -> list[Body]:
        """The recording of a trial, as the gateway is told."""
        if finished.recording is None:
            return []
        try:
            data = self._file(finished.recording).read_bytes()
        except OSError as error:  # moved away by hand, say; the walk counts all the same
            log.warning("recording %s cannot be sent: %s", finished.recording, error)
            return []
        parts = [data[i : i + CHUNK] for i in range(0, len(data), CHUNK)]
        return [
            RecordingChunk(finished.recording, n, len(parts), part) for n, part in enumerate(parts)
        ]

    def _file(self, recording: str) -> Path:
        return self._folder / f"{recording}.parquet"
