"""The scores of a blind set as a page to read."""

from collections.abc import Mapping
from typing import Any

EITHER = "nuisances that are there counted as true"
ROWS = {
    "detected": "detected",
    "exact_top1": "exact effect, first",
    "exact_top3": "exact effect, first three",
    "class_top1": "class, first",
    "class_top1_or_nuisance": f"class, first, {EITHER}",
    "class_top3": "class, first three",
    "found_or_split": "class first, or in a set that the next recording splits",
    "pairs_both_in_top3": "pairs: both classes in the first three",
    "pairs_one_in_top3": "pairs: one class at least in the first three",
    "place_top1": "place, first (mirror: half; robots of several joints)",
    "place_top1_or_nuisance": f"place, first, {EITHER}",
    "set_covers": "equivalence set holds the truth",
    "set_size": "size of that set",
    "regime_f1": "times at which it acts, F1",
    "parameter_error": "relative error of parameters",
    "parameter_in_ci90": "truth in the 90 % interval",
    "unidentifiable_allowed": "unidentifiable: told so, no sharp name",
    "unlisted_flagged": "outside the list: told so",
    "listed_flagged_unknown": "on the list: told to be outside",
    "ambiguous_with_next_recording": "ambiguous, the truth among them: next recording splits them",
    "undetermined_with_next_recording": "undetermined: next recording proposed",
    "oracle_ratio": "oracle ratio on test motions",
    "calibration": "calibration of the class, these cases",
    "calibration_or_nuisance": f"calibration of the class, these cases, {EITHER}",
    "seconds": "seconds per diagnosis",
}
NULL_ROWS = {
    "false_positives": "false positives",
    "told_none": "told `none`",
    "undetermined": "told `undetermined`",
    "visible_nuisance": "immaterial nuisance clear to a matched filter told (not counted above "
    "where it is told by its name)",
    "material_nuisance": "material nuisance found (not counted above)",
    "missing": "without a diagnosis (not counted above)",
}
CLAIM_ROWS = {
    "calibration": "calibration of the class",
    "calibration_or_nuisance": f"calibration of the class, {EITHER}",
}
LINES = {
    "immaterial": "immaterial, of any stratum",
    "masked_85": "one effect, 85 % absorbed",
    "snr_over_8": "SNR over 8, immaterial ones too",
    "suspended": "suspended",
    "ground": "on the ground",
}
VIEWS = {"effect_seen": "effect", "all_seen": "all"}
FEW = (
    *("detected", "exact_top1", "class_top1", "class_top3", "found_or_split", "place_top1"),
    "set_covers",
)


def markdown(scores: Mapping[str, Any]) -> str:
    """The scores as Markdown."""
    lines = [
        f"# Blind score: {scores['cases']} cases, {scores['missing']} without a diagnosis",
        "",
        f"Commitment {scores['commitment']['key_sha256']}, to engine "
        f"{scores['commitment']['engine_git_sha'] or 'not named'}; "
        f"diagnosed by {_engine(scores.get('engine'))}.",
        *(f"\nWarning: {doubt}" for doubt in scores.get("doubts", ())),
        "",
        "| omissions | value | 95 % |",
        "|---|---|---|",
        *(_row(told, scores["all"][name]) for name, told in ROWS.items()),
        "",
        "| nulls | value | 95 % |",
        "|---|---|---|",
        *(_row(told, scores["nulls"][name]) for name, told in NULL_ROWS.items()),
        "",
        "| all claims, those on nulls, weak and immaterial cases too | value | 95 % |",
        "|---|---|---|",
        *(_row(told, scores[name]) for name, told in CLAIM_ROWS.items()),
        "",
        *few("stratum", scores["per_stratum"] | {LINES[n]: g for n, g in scores["lines"].items()}),
        "",
        *few("robot", scores["per_robot"]),
        "",
        *_refits(scores["refits"]),
        "",
        f"## Failures: {len(scores['failures'])}",
        "",
        "| case | robot | stratum | what | named |",
        "|---|---|---|---|---|",
        *(
            f"| {f['case']} | {f['robot']} | {f['stratum']} | {'; '.join(f['faults'])} "
            f"| {', '.join(f['named'])} |"
            for f in scores["failures"]
        ),
    ]
    return "\n".join(lines) + "\n"


def _refits(refits: Mapping[str, Any]) -> list[str]:
    """Where a diagnosis's nominal model takes the place of the key's refit."""
    lower, compared = refits["lower"], refits["compared"]
    lines = [
        f"## Refits nearer to the truth than the key's: {len(lower)} of {compared} compared",
        "",
        "| case | robot | stratum | counted as | what | SNR, key | SNR, counted "
        "| absorbed, key | absorbed, counted |",
        "|---" * 9 + "|",
    ]
    for case in lower:
        who = " | ".join(str(case[name]) for name in ("case", "robot", "stratum", "counted_as"))
        for view, told in VIEWS.items():
            if seen := case.get(view):
                snr = f"{seen['key_snr']:.1f} | {seen['snr']:.1f}"
                share = f"{seen['key_absorbed']:.2f} | {seen['absorbed']:.2f}"
                lines.append(f"| {who} | {told} | {snr} | {share} |")
    return lines


def _engine(told: Mapping[str, Any] | None) -> str:
    """The engine that diagnosed, where its run is told of."""
    if told is None:
        return "an engine not told of"
    changes = " with changes" if told["dirty"] else ""
    return f"{told['git_sha'] or 'an engine without a commit'}{changes}"


def _row(told: str, value: Mapping[str, Any]) -> str:
    interval = value.get("ci95")
    limits = f"{interval[0]:.3f} to {interval[1]:.3f}" if interval else ""
    return f"| {told} | {cell(value)} | {limits} |"


def cell(value: Mapping[str, Any]) -> str:
    """One score of `score_set` in a few characters."""
    if not value["of"]:
        return "-"
    if "rate" in value:
        return f"{value['rate']:.2f} ({value['hits']}/{value['of']})"
    if "ece" in value:
        chance, brier = f"chance to {value['ece_chance']:.3f}", f"Brier {value['brier']:.3f}"
        return f"ECE {value['ece']:.3f} ({chance}), {brier} ({value['of']})"
    return f"{value['mean']:.3g}, median {value['median']:.3g} ({value['of']})"


def few(what: str, groups: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """A table with a line per group and the main scores.

    Args:
      what: heads the column of groups.
      groups: their scores, those of nulls among them or under `nulls`.
    """
    names = (*FEW, "false_positives")
    titles = [{**ROWS, **NULL_ROWS}[name] for name in names]
    lines = [f"| {what} | {' | '.join(titles)} |", "|---" * (len(names) + 1) + "|"]
    for group, scores in groups.items():
        flat = {**scores.get("nulls", {}), **scores}
        cells = [cell(flat[name]) if name in flat else "-" for name in names]
        lines.append(f"| {group} | {' | '.join(cells)} |")
    return lines
