"""Messages between a robot's agent and the gateway: msgpack with a version, read strictly.

An envelope is the map {"v", "type", "id", "time", "body"}. A newer program may add fields: what is
unknown is ignored; another version is refused. Nothing is unpickled. Delivery is at least once and
in any order, so what moves a robot carries (trial, attempt, fence) and is handled once by whoever
receives it:

- the gateway stores a trial before it sends it, the agent writes down what it does before it does
  it, and resends `Finished` until it is acknowledged;
- `fence` grows whenever the gateway hands a trial out anew; an older one is refused;
- a motion that was interrupted is told as aborted and never repeated by itself: another `attempt`
  is an operator's decision.
"""

import time
import uuid
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, get_args

from pup.wire_values import SIZE_LIMIT as SIZE_LIMIT
from pup.wire_values import WireError as WireError
from pup.wire_values import pack, plain, read, unpack

VERSION = 1
CHUNK = 2**18  # bytes of a recording in one message
FASTEST = 5.0  # m/s
NAME = "[A-Za-z0-9][A-Za-z0-9_.-]{0,62}"  # pattern of names of studies, agents and tokens


class AgentState(StrEnum):
    """What an agent's robot is doing.

    Attributes:
      DISABLED: the servos' torque is off.
      ENABLED: the robot holds its pose.
      ARMED: a trial is about to start.
      RUNNING: a trial moves the robot, or a script that is recorded.
      STOPPED: somebody stopped it; the servos' torque is off until it is enabled anew.
      FAULT: a rule of safety stopped it; likewise.
    """

    DISABLED = "disabled"
    ENABLED = "enabled"
    ARMED = "armed"
    RUNNING = "running"
    STOPPED = "stopped"
    FAULT = "fault"


class Outcome(StrEnum):
    """How a trial ended.

    Attributes:
      SUCCEEDED: the rollout ran until the robot fell or the time was over; its distance counts.
      ABORTED: it was not run to its end, for a reason that says nothing of eta; no data point.
      INFEASIBLE: eta makes the policy command what no robot can do.
    """

    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    INFEASIBLE = "infeasible"


class Progress(StrEnum):
    """How far an agent's journal has a trial; its outcomes are those of `Outcome`."""

    ACCEPTED = "accepted"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    INFEASIBLE = "infeasible"


def farthest(horizon: float, walked: float | None = None) -> float:
    """Distance beyond which a measurement is a mistake, in centimetres say, m.

    Args:
      horizon: longest walk, s.
      walked: how long this one was, s; a robot that falls lands up to a second's way ahead.
    """
    return FASTEST * (horizon if walked is None else min(horizon, walked + 1))


@dataclass(frozen=True)
class Policy:
    """A policy bundle on the robot.

    Attributes:
      name: of its folder.
      sha256: digest of its `policy.json`, which holds those of the other files.
    """

    name: str
    sha256: str


@dataclass(frozen=True)
class JournalEntry:
    """A trial that the agent knows of and the gateway has not acknowledged the end of."""

    trial: str
    attempt: int
    fence: int
    state: Progress


@dataclass(frozen=True)
class Hello:
    """Agent to gateway, at each connection.

    Attributes:
      agent: name of the agent, for people; who it is, its CURVE key tells.
      robot: name of the robot description.
      version: of the agent's program.
      policies: that it can run.
      journal: unfinished business.
    """

    agent: str
    robot: str
    version: str
    policies: tuple[Policy, ...] = ()
    journal: tuple[JournalEntry, ...] = ()


@dataclass(frozen=True)
class Heartbeat:
    """Every second, both ways; the gateway's is empty.

    Attributes:
      agent: name of the agent.
      state: of its robot.
      health: what `pup-agent health` tells; numbers, texts, lists and maps of them.
      trial: that it is at.
    """

    agent: str | None = None
    state: AgentState | None = None
    health: dict[str, Any] = field(default_factory=dict)
    trial: str | None = None


@dataclass(frozen=True)
class Accepted:
    """Agent to gateway: the trial is in the journal."""

    trial: str
    attempt: int
    fence: int


@dataclass(frozen=True)
class Armed:
    """Agent to gateway: whoever stands at the robot let the trial start."""

    trial: str
    attempt: int
    fence: int


@dataclass(frozen=True)
class Running:
    """Agent to gateway: the robot moves."""

    trial: str
    attempt: int
    fence: int


@dataclass(frozen=True)
class Sample:
    """Agent to gateway during a rollout; may get lost, the highest number counts.

    Attributes:
      trial: of the rollout, as `attempt` and `fence`.
      number: counts the samples of the attempt.
      time: since the start of the walk, s.
      distance: so far, m; None where it is measured at the end only.
    """

    trial: str
    attempt: int
    fence: int
    number: int
    time: float
    distance: float | None = None


@dataclass(frozen=True)
class Finished:
    """Agent to gateway: how the trial ended; resent unchanged until it is acknowledged.

    Attributes:
      trial: that ended, as `attempt` and `fence`.
      state: how.
      distance: m; None where none was measured.
      time: until the fall or the end, s; None where the robot did not move.
      reason: in words, for people.
      recording: id of the recording, if there is one.
      digest: SHA-256 of its file.
    """

    trial: str
    attempt: int
    fence: int
    state: Outcome
    distance: float | None = None
    time: float | None = None
    reason: str = ""
    recording: str | None = None
    digest: str | None = None


@dataclass(frozen=True)
class RecordingChunk:
    """Agent to gateway: a piece of a recording's Parquet file.

    Attributes:
      recording: id.
      number: of the piece, from 0.
      of: pieces in all.
      data: at most CHUNK bytes.
    """

    recording: str
    number: int
    of: int
    data: bytes


@dataclass(frozen=True)
class Assign:
    """Gateway to agent: a trial to run once.

    Attributes:
      study: that it belongs to.
      trial: its id.
      attempt: counts an operator's decisions to run it, from 1.
      fence: counts how often the gateway handed it out.
      policy: digest of the bundle, see `Policy`.
      eta: what the policy is conditioned on.
      horizon: longest walk, s.
      repeat_of: id of the first recording with this eta, when this is a repeat.
    """

    study: str
    trial: str
    attempt: int
    fence: int
    policy: str
    eta: tuple[float, ...]
    horizon: float
    repeat_of: str | None = None


@dataclass(frozen=True)
class Cancel:
    """Gateway to agent: do not start the trial, or stop it; it is then told as aborted."""

    trial: str
    attempt: int
    fence: int


@dataclass(frozen=True)
class Acknowledge:
    """Gateway to agent: a message is stored and need not be sent again.

    Attributes:
      of: its id.
      trial: that it told of, as `attempt` and `fence`; None where it was no trial.
    """

    of: str
    trial: str | None = None
    attempt: int | None = None
    fence: int | None = None


@dataclass(frozen=True)
class Stop:
    """Gateway to agent: the emergency stop of somebody who is not at the robot."""

    reason: str


Body = (
    Hello
    | Heartbeat
    | Accepted
    | Armed
    | Running
    | Sample
    | Finished
    | RecordingChunk
    | Assign
    | Cancel
    | Acknowledge
    | Stop
)
BODIES: dict[str, type[Any]] = {body.__name__: body for body in get_args(Body)}


@dataclass(frozen=True)
class Message:
    """A body in its envelope.

    Attributes:
      body: what is told.
      id: unique.
      time: when it was made, s since 1970.
    """

    body: Body
    id: str = field(default_factory=lambda: uuid.uuid4().hex)
    time: float = field(default_factory=time.time)


def encode(message: Message) -> bytes:
    """The message as bytes.

    Raises:
      WireError: `decode` would refuse it.
    """
    kind = type(message.body)
    body = plain(message.body)
    read(kind, body, kind.__name__)
    envelope = {"v": VERSION, "type": kind.__name__, "id": message.id, "time": message.time}
    return pack(envelope | {"body": body})


def decode(data: bytes) -> Message:
    """The message in some bytes, whoever sent them.

    Raises:
      WireError: they are too many, no message, of another version, or a value is not allowed.
    """
    told = unpack(data)
    if not isinstance(told, dict) or type(told.get("v")) is not int:
        raise WireError("no envelope with a version")
    if told["v"] != VERSION:
        raise WireError(f"version {told['v']}; this program speaks {VERSION}")
    kind = BODIES.get(told["type"]) if isinstance(told.get("type"), str) else None
    if kind is None:
        raise WireError(f"type {str(told.get('type'))[:40]!r} is not one of {', '.join(BODIES)}")
    return Message(
        body=read(kind, told.get("body"), kind.__name__),
        id=read(str, told.get("id"), "id"),
        time=read(float, told.get("time"), "time"),
    )


def without_mark(trial: str) -> str:
    """What people call a trial that is named on the wire: `study/7` of `study/7.9f3a12c4`."""
    study, slash, number = trial.rpartition("/")
    return f"{study}{slash}{number.partition('.')[0]}" if slash else trial
