"""The scores of a diagnosis and of its rivals on the same cases, as a page to read."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pup.blind.table import CLAIM_ROWS, NULL_ROWS, ROWS, cell, few

COSTS = {
    "gain": "held-out error less by, median",
    "simulations": "candidates simulated, median",
    "processor": "processor [s], median",
    "fewer": "candidates for one of the diagnosis, median",
}


def costs(
    documents: Mapping[str, Mapping[str, Any]],
    diagnosed: Mapping[str, Mapping[str, Any]],
    missing: Sequence[str],
) -> dict[str, float | None]:
    """What a method costs and what its model gains.

    Args:
      documents: of the method, by case.
      diagnosed: the diagnosis's own.
      missing: cases in which something is missing; gains are of these.

    Returns:
      Medians over cases: `gain`, the share by which refits predict motions left out better than the
      nominal model (0 where a method has no model), `simulations`, seconds of the `processor`, and
      how many candidates were simulated for each of the diagnosis; None where nothing is told.
    """
    pairs = [(documents[case], diagnosed[case]) for case in documents if case in diagnosed]
    return {
        "gain": _median([_gain(documents[case]) for case in missing if case in documents]),
        "simulations": _median([d["simulations"] for d in documents.values()]),
        "processor": _median(
            [d["processor_seconds"] for d in documents.values() if "processor_seconds" in d]
        ),
        "fewer": _median([a["simulations"] / max(b["simulations"], 1) for a, b in pairs]),
    }


def page(cases: Sequence[str], methods: Mapping[str, Mapping[str, Any]]) -> str:
    """All scores as Markdown.

    Args:
      cases: their ids.
      methods: scores of each, with its `costs`.
    """
    flat = {name: told["all"] | {"nulls": told["nulls"]} for name, told in methods.items()}
    titles = " | ".join(methods)
    lines = [
        f"# The diagnosis and its rivals on the same {len(cases)} cases",
        "",
        *few("method", flat),
        "",
        f"| method | {' | '.join(COSTS.values())} |",
        "|---" * (len(COSTS) + 1) + "|",
        *(
            f"| {name} | {' | '.join(_told(told['costs'][c]) for c in COSTS)} |"
            for name, told in methods.items()
        ),
        "",
    ]
    for what, rows, group in (
        ("omissions", ROWS, "all"),
        ("nulls", NULL_ROWS, "nulls"),
        ("all claims", CLAIM_ROWS, None),
    ):
        lines += [f"| {what} | {titles} |", "|---" * (len(methods) + 1) + "|"]
        for name, told in rows.items():
            cells = [cell((s[group] if group else s)[name]) for s in methods.values()]
            lines.append(f"| {told} | {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


def _gain(document: Mapping[str, Any]) -> float:
    held = document.get("held_out")
    return 1 - held["rmse_after"] / held["rmse_before"] if held else 0.0


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _told(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
