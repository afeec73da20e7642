"""The command line `pup`: parse, call, print."""

import io
import json
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from pup.errors import InputError
from pup.files import MISTAKES
from services import stopping
from services.arguments import parser
from services.failures import FailedError
from services.verbs import VERBS

DONE, FAILED, REFUSED, STOPPED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb.

    Returns:
      0 done, 2 bad input or usage, 130 stopped by the user, 1 anything else.
    """
    options = parser().parse_args(arguments)
    verb, show = VERBS[options.name], SHOWN[options.name]
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # those of libraries would stand between progress lines
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="surrogateescape")  # a file's name need not be UTF-8
    stopping.begin()
    try:
        shown = verb(options)
    except InputError as error:
        print(f"pup {options.name}: {' '.join(str(error).splitlines())}", file=sys.stderr)
        return REFUSED
    except FailedError as error:
        print(f"pup {options.name}: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt as error:
        told = str(error) or "stopped; the same command resumes"
        print(f"pup {options.name}: {told}", file=sys.stderr)
        return STOPPED
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        print(f"pup {options.name}: {place}{error.strerror or error}", file=sys.stderr)
        return REFUSED if isinstance(error, MISTAKES) and error.filename else FAILED
    if options.json:
        print(json.dumps(shown, allow_nan=False))
    else:
        show(shown)
    return DONE


def _show_bounds(shown: dict[str, Any]) -> None:
    from services.tables import bounds_table

    bounds_table(shown["presysid"], shown["unit"])
    print(f"report: {shown['report']}")


def _show_job(shown: dict[str, Any]) -> None:
    from services.tables import bounds_table, stages_table

    bounds_table(shown["presysid"], shown["unit"])
    stages_table(shown)
    print(f"report: {shown['report']}")


def _show_training(shown: dict[str, Any]) -> None:
    from services.tables import training_table

    training_table(shown)


def _show_transfer(shown: dict[str, Any]) -> None:
    from services.transfer import show

    show(shown)


def _show_cluster(shown: dict[str, Any]) -> None:
    from services.submit import show

    show(shown)


def _show_service(shown: dict[str, Any]) -> None:
    from services.gateway.verb import show

    show(shown)


def _show_replay(shown: dict[str, Any]) -> None:
    from services.tables import replay_table, walk_table

    if "etas" in shown:
        from services.rehearsal import rehearsal_words

        print(rehearsal_words(shown))
    else:
        (walk_table if "policy" in shown else replay_table)(shown)


def _show_blind(shown: dict[str, Any]) -> None:
    from services.blind import show

    show(shown)


def _show_diagnosis(shown: dict[str, Any]) -> None:
    from services.tables import diagnosis_table

    diagnosis_table(shown)


def _show_experiment(shown: dict[str, Any]) -> None:
    from services.tables import experiment_table

    experiment_table(shown)


def _show_life(shown: dict[str, Any]) -> None:
    print(f"{shown['robot']} lived for {shown['time']:.1f} s")


def _show_draft(shown: dict[str, Any]) -> None:
    joints, groups = len(shown["joints"]), ", ".join(shown["groups"])
    print(f"{shown['folder']}: {shown['robot']}, {joints} joints in groups {groups}")
    for note in shown["notes"]:
        print(f"- {note}")


def _show_files(shown: dict[str, Any]) -> None:
    for path in shown["files"]:
        print(path)
    if shown.get("left_out"):
        names = ", ".join(shown["left_out"])
        print(f"not in every recording, or not to its end, so left out: {names}")


def _show_recordings(shown: dict[str, Any]) -> None:
    for path in shown.get("scripts") or shown["recordings"]:
        print(path)


SHOWN = {
    "run": _show_job,
    "describe": _show_draft,
    "import": _show_recordings,
    "export": _show_files,
    "record": _show_recordings,
    "presysid": _show_bounds,
    "train": _show_training,
    "transfer": _show_transfer,
    "submit": _show_cluster,
    "jobs": _show_cluster,
    "serve": _show_service,
    "replay": _show_replay,
    "diagnose": _show_diagnosis,
    "blind": _show_blind,
    "experiment": _show_experiment,
    "virtual-robot": _show_life,
}
"""How the outcome of each verb is shown."""


if __name__ == "__main__":
    sys.exit(main())
