"""What is other between the inputs that a cell was done from and those that it has now."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

TOLD = "told"
"""Of inputs, the settings, as JSON; the others are digests."""


def different(
    before: Mapping[str, str], now: Mapping[str, str], needs: Mapping[str, str]
) -> tuple[str, ...]:
    """Names of what is other: settings, and cells that have found something else.

    Args:
      before: of the journal; empty where the cell was not done, of which nothing is other.
      now: as far as they are known.
      needs: cells whose results are among them, by part; one that is not there may find the same.
    """
    if not before:
        return ()
    names = {name for name in before.keys() | now.keys() if before.get(name) != now.get(name)}
    names -= needs.keys() - now.keys()
    others = {needs.get(name, name) for name in names}
    if TOLD in others:
        settings = set(_settings(_read(before), _read(now)))
        others = others - {TOLD} | settings if settings else others
    return tuple(sorted(others))


def _read(inputs: Mapping[str, str]) -> dict[str, Any]:
    """The settings; none where a damaged journal does not tell them."""
    try:
        told = json.loads(inputs.get(TOLD, "{}"))
    except (TypeError, ValueError):
        return {}
    return told if isinstance(told, dict) else {}


def _settings(before: Mapping[str, Any], now: Mapping[str, Any], place: str = "") -> Iterator[str]:
    """Names of settings that are other, such as `fits.generations`."""
    for key in before.keys() | now.keys():
        values = before.get(key), now.get(key)
        if all(isinstance(value, dict) for value in values):
            yield from _settings(values[0], values[1], f"{place}{key}.")
        elif values[0] != values[1]:
            yield place + key
