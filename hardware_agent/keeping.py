"""What a servo keeps while nobody tells it anything: what of it is put right, and what is left."""

from dataclasses import dataclass

from hardware_agent.line import Line
from hardware_agent.port import BusError
from hardware_agent.registers import POSITION
from pup.errors import InputError

MODEL = (0, 2)
"""Where every servo and board has its model number."""


@dataclass(frozen=True)
class Kept:
    """What a servo holds itself to, and the agent leaves as it is.

    Attributes:
      limits: least and largest goal, ticks; beyond them it stays where it is.
      power: largest duty, in the units of the power limit; it refuses more or, with Protocol 1.0,
        begins with it when current comes.
    """

    limits: tuple[int, int]
    power: int


def check_model(line: Line, name: int, model: int | None) -> None:
    """Refuse a servo that is none of those that the agent drives.

    Args:
      line: to the servo, open and owned.
      name: the servo's id.
      model: what it says it is.

    Raises:
      InputError: it is of another model, or an adapter echoes.
    """
    own, port = line.registers, line.settings.port
    if own.protocol == 1 and model == int.from_bytes(bytes(MODEL), "little"):
        # With Protocol 1.0 a question that comes back passes for an answer: address and length.
        raise InputError(
            f"{port}: what is sent to servo {name} comes back as its answer; switch "
            "the adapter's echo off, or use one that has none"
        )
    if model != own.model:
        raise InputError(
            f"{port}: servo {name} is of model {model}, not an MX-28 with Protocol "
            f"{own.protocol}.0 (model {own.model}); see [bus] protocol"
        )


def put_right(line: Line, name: int) -> list[str]:
    """Put right what a limp servo has kept, and is not told whenever it shall hold.

    Args:
      line: to the servo, open and owned.
      name: the servo's id.

    Returns:
      What was changed, in words.

    Raises:
      BusError: it does not take a setting.
    """
    own, where = line.registers, f"{line.settings.port}: servo {name}"
    changed = []
    for told, span, wanted in (
        ("return delay", own.return_delay, 0),
        ("status return level", own.status_level, 2),
        ("goal acceleration", own.acceleration, 0),
    ):
        known = line.register(name, span)
        absent = known is None and span == own.acceleration
        if known != wanted and not absent:
            line.put(name, span, wanted)
            if line.register(name, span) != wanted:
                raise BusError(f"{where} keeps {told} {known}")
            changed.append(f"servo {name}: {told} {known} made {wanted}")
    return changed


def kept(line: Line, name: int) -> Kept:
    """What a servo holds itself to.

    Args:
      line: to the servo, open and owned.
      name: the servo's id.

    Raises:
      BusError: it does not tell.
      InputError: it takes no angles.
    """
    own, where = line.registers, f"{line.settings.port}: servo {name}"
    mode = POSITION if own.mode is None else line.sure(name, own.mode)
    least, largest = (line.sure(name, span) for span in own.limits)
    if mode != POSITION:
        raise InputError(
            f"{where} is in operating mode {mode} and takes no angles; set mode {POSITION}, "
            "position control, with ROBOTIS' tools"
        )
    if least >= largest:  # both 0 are wheel mode, both 4095 several turns
        raise InputError(
            f"{where} takes no angles, as its angle limits are {least} and {largest}; set "
            "joint mode, such as limits 0 and 4095, with ROBOTIS' tools"
        )
    return Kept((least, largest), line.sure(name, own.own_power))
