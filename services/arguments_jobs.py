"""What can be written behind `pup submit` and `pup jobs`."""

import argparse

from services.options import number, out, service


def submit(verb: argparse.ArgumentParser) -> None:
    """Fill in `pup submit`."""
    service(verb)
    job = verb.add_argument_group("the job, on the service's Ray cluster")
    job.add_argument(
        "--cpus",
        type=number(0.01, 4096.0, float),
        metavar="X",
        help="cores that are reserved for its own process, beside what it asks of Ray (1)",
    )
    job.add_argument(
        "--gpus", type=number(0.0, 64.0, float), metavar="X", help="GPUs, likewise (0)"
    )
    job.add_argument(
        "--retries",
        type=number(0, 100),
        metavar="N",
        help="attempts after the first one, which resume (3)",
    )
    job.add_argument(
        "--key", metavar="TEXT", help="any text of your own: the same key is the same job"
    )
    job.add_argument(
        "--wait", action="store_true", help="until it has ended, with its log on standard error"
    )
    job.add_argument("verb", metavar="VERB", help="such as presysid, train, replay or diagnose")
    job.add_argument(
        "arguments",
        nargs=argparse.REMAINDER,
        metavar="...",
        help="what stands behind the verb, but --out and --address; paths are relative to the "
        "shared storage",
    )


def jobs(verb: argparse.ArgumentParser) -> None:
    """Fill in `pup jobs`."""
    actions = verb.add_subparsers(title="actions", required=True, dest="action", metavar="ACTION")
    for name, told in (
        ("list", "all jobs, newest first"),
        ("status", "one job and its attempts"),
        ("logs", "what it said"),
        ("cancel", "call it off, and wait until its processes have ended"),
        ("retry", "attempt it again, after it ended without a result; it resumes"),
        ("fetch", "its artefacts"),
    ):
        action = actions.add_parser(name, help=told, description=f"{told[0].upper()}{told[1:]}.")
        if name != "list":
            action.add_argument("job", metavar="JOB", help="id of the job")
        if name == "logs":
            action.add_argument("--follow", action="store_true", help="until the job has ended")
        if name == "fetch":
            action.add_argument("names", nargs="*", default=[], metavar="NAME", help="default: all")
            out(action, "the artefacts")
        service(action)
        action.add_argument(
            "--json",
            action="store_true",
            default=argparse.SUPPRESS,
            help="print one JSON object last on standard output",
        )
