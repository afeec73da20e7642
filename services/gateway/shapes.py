"""What requests and answers look like, for checks and for OpenAPI."""

from typing import Annotated, Any, Self

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    model_validator,
)

from pup.errors import InputError
from pup.transfer.study import FAILURES, Gate, StudyState
from pup.transfer.study import StudySettings as Defaults
from pup.transfer.trial import Purpose, TrialState
from services.gateway.limits import ETAS, HORIZON, REPEATS, SEEDS, TRIALS
from services.gateway.names import WHOLE
from services.gateway.records import Row


def _whole(told: Any) -> Any:
    """A number without a fraction is whole, as JSON Schema has it, however it is written."""
    return int(told) if isinstance(told, float) and told.is_integer() else told


WITHOUT_FRACTION = BeforeValidator(_whole)
Number = Annotated[FiniteFloat, Field(ge=-1e6, le=1e6)]
Eta = Annotated[list[Number], Field(min_length=1, max_length=16)]
Name = Annotated[str, Field(pattern=WHOLE)]
ROLLOUTS = 2**16


class Strict(BaseModel):
    """A request: what it does not know, it refuses, and texts for numbers too."""

    model_config = ConfigDict(extra="forbid", strict=True)


class SimulatedRollouts(Strict):
    """Distances of the policy in simulation, a row for each mu, a column for each eta."""

    eta: Annotated[list[Eta], Field(min_length=2, max_length=ETAS)]
    distance: Annotated[
        list[Annotated[list[Number], Field(min_length=2, max_length=ETAS)]],
        Field(min_length=1, max_length=4096),
    ]

    def checked(self, n_eta: int) -> Row:
        """The rollouts, if they are tables that fit.

        Raises:
          InputError: they are not.
        """
        widths = {len(eta) for eta in self.eta} | {n_eta}
        lengths = {len(row) for row in self.distance} | {len(self.eta)}
        if len(widths) > 1 or len(lengths) > 1:
            raise InputError(
                f"simulated: each eta needs {n_eta} numbers, each row {len(self.eta)} distances"
            )
        if np.size(self.distance) > ROLLOUTS:
            raise InputError(f"simulated: more than {ROLLOUTS} rollouts")
        return {"eta": self.eta, "distance": self.distance}


class NewStudy(Strict):
    """A study to make; see the defaults of what is left out."""

    name: Name
    robot: Annotated[str, Field(min_length=1, max_length=256)]
    policy: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256 of policy.json.")]
    lower: Eta = list(Defaults.lower)
    upper: Eta = list(Defaults.upper)
    trials: Annotated[int, Field(ge=1, le=TRIALS), WITHOUT_FRACTION] = Defaults.trials
    initial: Annotated[
        Annotated[int, Field(ge=1, le=TRIALS), WITHOUT_FRACTION] | None,
        Field(description=f"At most trials. Null or left out: {Defaults.initial}, or all of them."),
    ] = None
    least_gain: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = Defaults.least_gain
    repeats: Annotated[int, Field(ge=0, le=REPEATS), WITHOUT_FRACTION] = Defaults.repeats
    compare: Annotated[list[Eta], Field(max_length=16)] = []
    horizon: Annotated[float, Field(gt=0, le=HORIZON, allow_inf_nan=False)] = Defaults.horizon
    lease: Annotated[float, Field(ge=1, le=86400, allow_inf_nan=False)] = Defaults.lease
    failures: Annotated[
        Annotated[int, Field(ge=1, le=1000), WITHOUT_FRACTION] | None,
        Field(description="Null or left out: 1 for the operator's gate, 3 for the automatic one."),
    ] = None
    gate: Annotated[Gate, Field(strict=False)] = Defaults.gate
    agent: Name | None = None
    warm_start: bool = Defaults.warm_start
    seed: Annotated[int, Field(ge=0, lt=SEEDS), WITHOUT_FRACTION] = Defaults.seed
    simulated: SimulatedRollouts | None = None

    @model_validator(mode="after")
    def _filled(self) -> Self:
        """What goes by the gate or the trials, where it is not told."""
        if self.failures is None:
            self.failures = FAILURES[self.gate]
        if self.initial is None:
            self.initial = min(Defaults.initial, self.trials)
        return self


class Retry(Strict):
    """An attempt to make."""

    attempt: Annotated[int, Field(ge=1, le=10**6), WITHOUT_FRACTION]


class Reason(Strict):
    """Why, in words."""

    reason: Annotated[str, Field(min_length=1, max_length=500, pattern=r"^[^\x00]+$")]


def reason_in(body: bytes) -> str:
    """The reason in a body that may be anything: nothing is refused for want of one."""
    try:
        return Reason.model_validate_json(body).reason
    except ValidationError:
        return "no reason given"


def reason_or_none() -> dict[str, Any]:
    """How OpenAPI tells of such a body."""
    told = {"application/json": {"schema": Reason.model_json_schema()}}
    return {"requestBody": {"required": False, "content": told}}


class StudyShape(BaseModel):
    """A study."""

    name: str
    state: StudyState
    reason: str
    chosen: list[float] | None
    walks: int
    trials: int
    farthest: float | None
    open: int | None
    settings: dict[str, Any]
    waits_for: str = ""


class StudyList(BaseModel):
    """A page of studies; `next` goes on where it is given as `after`."""

    studies: list[StudyShape]
    next: str | None


class TrialShape(BaseModel):
    """A trial."""

    id: str
    number: int
    eta: list[float]
    purpose: Purpose
    state: TrialState
    attempt: int
    agent: str | None
    released: bool
    distance: float | None
    time: float | None
    reason: str
    recording: str | None
    digest: str | None


class TrialList(BaseModel):
    """A page of trials."""

    trials: list[TrialShape]
    next: int | None


class Posterior(BaseModel):
    """The Gaussian process of a study."""

    walks: int
    best: dict[str, Any] | None
    slices: list[dict[str, Any]]


class EventList(BaseModel):
    """A page of what happened."""

    events: list[dict[str, Any]]
    next: int | None


class AgentList(BaseModel):
    """The agents."""

    agents: list[dict[str, Any]]
