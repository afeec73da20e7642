"""What pages read of the documents that jobs write (docs/presysid.md and docs/diagnosis.md)."""

from abc import ABC, abstractmethod
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from pup.diagnosis.laws import NAMELESS

SURE = 0.7
"""What is less probable is told as the likeliest of several."""
Text = Annotated[str, Field(max_length=500)]
Prose = Annotated[str, Field(max_length=20_000)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=0, le=10**15)]
Numbers = Annotated[list[float | None], Field(max_length=500_000)]
Range = tuple[FiniteFloat, FiniteFloat]


class Document(BaseModel, ABC):
    """A document; what is not shown of it is not looked at."""

    model_config = ConfigDict(allow_inf_nan=False, frozen=True)

    version: Literal[1] = Field(alias="schema")
    robot: Text

    @property
    @abstractmethod
    def summary(self) -> str:
        """What it comes to, in a line."""


class BoundedParameter(BaseModel):
    """A parameter: physical values in its unit."""

    name: Text
    unit: Text
    nominal: FiniteFloat
    lower: FiniteFloat
    upper: FiniteFloat
    search: Range
    identified: bool = True


class Torque(BaseModel):
    """The torque law of the bounds."""

    kind: Text


class Losses(BaseModel):
    """Equation 1 and root mean square errors (rad, or m where joints slide)."""

    train: dict[Text, FiniteFloat]
    held_out: dict[Text, FiniteFloat] | None = None


class SubsetValues(BaseModel):
    """What a subset of the recordings says of the parameters that it can see."""

    recordings: Annotated[list[Text], Field(max_length=10_000)]
    parameters: dict[Text, FiniteFloat]


class BoundsDocument(Document):
    """`bounds.json`."""

    actuator: Torque
    parameters: Annotated[list[BoundedParameter], Field(max_length=500)]
    loss: Losses
    subsets: Annotated[list[SubsetValues], Field(max_length=1000)] = []

    @property
    def identified(self) -> int:
        """How many parameters the recordings determine."""
        return sum(p.identified for p in self.parameters)

    @property
    def summary(self) -> str:
        """How much is known."""
        return f"{self.identified} of {len(self.parameters)} parameters identified"


class Curve(BaseModel):
    """A row for each iteration; nothing where no episode ended."""

    steps: Annotated[list[Count], Field(min_length=1, max_length=500_000)]
    returns: Numbers = Field(alias="return")
    distance: Numbers
    time: Numbers

    @model_validator(mode="after")
    def _alike(self) -> "Curve":
        if len({len(self.steps), len(self.returns), len(self.distance), len(self.time)}) > 1:
            raise ValueError("columns of different lengths")
        return self


class Wanted(BaseModel):
    """What a training was told."""

    steps: Count


class Origin(BaseModel):
    """Where a training's document comes from."""

    options: Wanted


class TrainingDocument(Document):
    """`training.json`."""

    method: Text
    direction: Text
    done: bool
    steps: Count
    seconds: FiniteFloat
    curve: Curve
    provenance: Origin

    @property
    def summary(self) -> str:
        """How far it is."""
        done, wanted = self.steps / 1e6, self.provenance.options.steps / 1e6
        return f"{self.method}, {self.direction}: {done:.3g} of {wanted:.3g} M steps"


class WherePlace(BaseModel):
    """A place by the contract's kinds."""

    kind: Text
    names: Annotated[list[Text], Field(max_length=200)]

    def __str__(self) -> str:
        """In words, with the names of the MJCF."""
        return f"{self.kind} {', '.join(self.names)}"


class Claim(BaseModel):
    """An effect at a place, and how probable it is."""

    effect: Text
    place: WherePlace
    probability: Share

    @property
    def name(self) -> str:
        """Of the effect, in words."""
        return self.effect.replace("_", " ")


class FoundEffect(Claim):
    """A finding, with what explains the data as well."""

    equivalents: Annotated[list[Claim], Field(max_length=200)] = []


class Floor(BaseModel):
    """The noise of readings."""

    rms: FiniteFloat
    source: Text


class LeftOut(BaseModel):
    """Errors on motions left out of the fit, rad."""

    rmse_before: FiniteFloat
    rmse_after: FiniteFloat


class Ask(BaseModel):
    """The recording that would tell more."""

    motion: Text
    reason: Prose


class DiagnosisDocument(Document):
    """`diagnosis.json`."""

    verdict: Literal["mismatch", "none", "undetermined"]
    reason: Prose = ""
    noise_floor: Floor
    findings: Annotated[list[FoundEffect], Field(max_length=1000)]
    held_out: LeftOut | None = None
    next_recording: Ask | None = None

    @property
    def summary(self) -> str:
        """The verdict."""
        if self.verdict == "undetermined":
            return "These recordings cannot tell whether anything is missing."
        if self.verdict == "none":
            floor = 1000 * self.noise_floor.rms
            return f"Nothing material is missing beyond a noise of {floor:.2g} mrad."
        named = [f for f in self.findings if f.effect != NAMELESS]
        known = list(dict.fromkeys(f.name for f in named))
        if not named:
            return "Something is missing that no known effect explains."
        if len(named) == 1:
            told = f"{named[0].name} at {named[0].place}"
        elif len(known) > 3:
            told = f"{len(known)} effects"
        else:
            told = " and ".join(filter(None, (", ".join(known[:-1]), known[-1])))
        beyond = ", and more that has no name" if len(named) < len(self.findings) else ""
        sure = all(f.probability >= SURE for f in named)
        likely = all(f.probability + sum(e.probability for e in f.equivalents) > 0.5 for f in named)
        begin = "The" if sure else "Most likely the" if likely else "Perhaps the"
        return f"{begin} simulator lacks {told}{beyond}."
