"""Plans of experiments, the cells that they mean, and what these depend on."""

import shutil
import time
from dataclasses import replace
from pathlib import Path

import agents
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pup.errors import InputError
from pup.files import read_json, sha256
from pup.locomotion.settings import Direction
from pup.policy.shape import Method
from pup.robot import RobotDescription
from services.arguments import parser
from services.experiment.cells import chosen, graph
from services.experiment.plan import MOST, STAGES, Plan, Walk, meant, read_plan, small, training
from services.experiment.work import Task, landscape
from services.gateway.limits import SEEDS
from services.transfer import read_simulated

DOCUMENTED = Path(__file__).parents[1] / "docs" / "experiment.md"


def test_the_plan_in_the_documentation_is_that_of_the_defaults(tmp_path: Path) -> None:
    text = DOCUMENTED.read_text().split("```toml")[1].split("```")[0]
    file = tmp_path / "plan.toml"
    file.write_text(text)
    assert read_plan(file) == Plan()
    file.write_text("schema = 1\n")
    assert read_plan(file) == Plan()


REFUSED = {
    "schema = 2": "this version reads schema = 1 only",
    "schema = 1\nrobots = 3": "robots: unknown key",
    "schema = 1\nseeds = []": "name each concealed robot once",
    "schema = 1\nseeds = [1, 1]": "name each concealed robot once",
    "schema = 1\nstages = ['walk']": "stage 'walk' is unknown",
    "schema = 1\n[trials]\ntrials = -1": "trials.trials: -1 is below 0",
    "schema = 1\n[trials]\ntrials = 0": "must be 1 or more",
    "schema = 1\n[trials]\nwalks = 3": "trials.walks: unknown key",
    "schema = 1\n[fleet]\ngenerations = 'x'": "expected a whole number",
    "schema = 1\n[train]\nfleet = '--steps x'": "train: argument --steps",
    'schema = 1\n[train]\nfleet = "--steps \'5"': "cannot be read (No closing quotation)",
    "schema = 1\n[train]\nfleet = '--seed 3'": "--seed is the experiment's to say",
    "schema = 1\n[[walk]]\ndirection = 'up'": "'up' is not a valid Direction",
    "schema = 1\n[[walk]]\ndirection = 'forward'\nmethods = ['x']": "'x' is not a valid Method",
    "schema = 1\n[[walk]]\ndirection = 'forward'\nrobots = 0": "needs a method and a robot",
    "schema = 1\nseeds = [1]\n[[walk]]\ndirection = 'forward'\nrobots = 3": "3, but seeds are 1",
    "schema = 1\n[[walk]]\ndirection = 'forward'\n[[walk]]\ndirection = 'forward'": "stands twice",
    "schema = 1\n[diagnosis]\neffects = 0": "diagnosis: effects must be 1 or more",
    "schema = 1\npooled = true": "pooled: needs fixed_network in presysid",
    "schema = 1\nseeds = [1]\npooled = true\n[presysid]\nfixed_network = true": "and two robots",
    "schema = 1\nseeds = [1, 2.5]": "seeds: 2.5 is no whole number",
    "schema = 1\n[presysid]\npopulation = 0": "presysid: population must be 4 or more",
    "schema = 1\n[presysid]\ngenerations = 0": "presysid: generations must be 1 or more",
    "schema = 1\n[fleet]\nsubsets = 0": "fleet: subsets must be 1 or more",
    "schema = 1\n[fleet]\nfraction = 1.5": "fleet: fraction must be above 0, and 1 at most",
    "schema = 1\n[fleet]\nfraction = 0": "fleet: fraction must be above 0, and 1 at most",
    "schema = 1\n[presysid]\nseed = 3": "presysid.seed: is that of the plan",
    "schema = 1\n[fleet]\nseed = 0": "fleet.seed: is that of the plan",
    "schema = 1\n[presysid]\nactuator = 'foo'": "presysid: actuator 'foo' is none of nn_pd, pd",
    "schema = 1\n[fleet]\nas_described = true": "fleet: values that are kept as described",
    "schema = 1\n[presysid]\nfolds = 1": "presysid: 1 in folds would leave nothing to fit",
    "schema = 1\nseed = 3000000000": "seed 3000000000 is too large; seeds must be below 2147",
    "schema = 1\nseeds = [3000000000]": "seed 3000000000 is too large; seeds must be below 2147",
    "schema = 1\n[trials]\nhorizon = 900": "trials: horizon is 900; it must be 600 at most",
    "schema = 1\n[trials]\ntrials = 2000": "trials: trials is 2000; it must be 1000 at most",
    "schema = 1\n[trials]\nprior = 2000": "trials: prior is 2000; it must be 1000 at most",
    "schema = 1\n[trials]\nrepeats = 500": "trials: repeats is 500; it must be 100 at most",
    "schema = 1\n[trials]\nlandscape = 5000": "trials: landscape is 5000; it must be 4096 at most",
    "schema = 1\n[trials]\nhorizon = -1": "trials: horizon, and seconds of diagnosis",
    "schema = 1\n[train]\nfleet = '--see 3'": "unrecognized arguments: --see 3",
    "schema = 1\n[record]\nmotions = []": "a motion and a repeat at least",
    "schema = 1\nwalk = []": "walk: is empty; leave it out for the usual walks",
    "schema = 1\n[[walk]]\nrobots = 3": "plan.toml: walk[1].direction: missing",
    "schema = 1\n[train]\nfleet = '--help'": "train: is no training",
    "seeds": "not a TOML document",
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_a_plan_cannot_say_is_told_in_a_line(
    tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=r"plan\.toml") as told:
        read_plan(file)
    assert REFUSED[text] in str(told.value) and "\n" not in str(told.value)
    assert str(told.value).count(str(file)) == 1 and not capsys.readouterr().out


PLANS = st.builds(
    lambda seeds, walks, stages, control, rollouts: replace(
        small(),
        seeds=tuple(seeds),
        walks=tuple(Walk(d, tuple(m), r) for d, (m, r) in walks.items()),
        stages=tuple(stages),
        control=control,
        diagnosis=replace(small().diagnosis, rollouts=rollouts),
    ),
    st.lists(st.integers(0, 9999), min_size=1, max_size=4, unique=True),
    st.dictionaries(
        st.sampled_from(Direction),
        st.tuples(st.lists(st.sampled_from(Method), min_size=1, unique=True), st.integers(1, 6)),
        min_size=1,
    ),
    st.lists(st.sampled_from(STAGES), unique=True),
    st.booleans(),
    st.integers(0, 2),
)


@settings(max_examples=20)
@given(PLANS)
def test_cells_stand_behind_what_they_need_and_are_no_more_than_wanted(plan: Plan) -> None:
    cells = graph(plan)
    seen: set[str] = set()
    for name, cell in cells.items():
        assert name == cell.name and set(cell.needs.values()) <= seen
        seen.add(name)
    # Every robot that walks somewhere is there, and nobody else.
    for walk in plan.walks:
        for i, seed in enumerate(plan.seeds):
            for method in walk.methods:
                name = f"trials-r{seed}-{walk.direction}-{method}"
                wanted = "trials" in plan.stages and i < walk.robots
                assert not wanted or name in cells
                assert i < walk.robots or name not in cells
    own = [name for name in cells if name.endswith("-own")]
    assert bool(own) <= plan.control
    assert plan.control or not any(name.endswith("-undiagnosed") for name in cells)
    for name in list(cells)[:3]:
        part = chosen(cells, [name])
        assert list(part)[-1] == name and list(part) == [n for n in cells if n in part]
        assert {n for c in part.values() for n in c.needs.values()} <= set(part)


def test_the_default_plan_is_that_of_the_issue() -> None:
    cells = graph(Plan())
    walked = [n for n in cells if n.startswith("trials-")]
    for direction, methods, robots in (("forward", 4, 10), ("backward", 2, 4), ("sideways", 2, 4)):
        arms = {n.split("-", 3)[3] for n in walked if f"-{direction}-" in n}
        searched = methods - 2 if methods == 4 else methods - 1
        # All again where the fleet is diagnosed, priors, the corrected, and both's controls.
        assert len(arms) == 2 * methods + searched + 3
        assert sum(n.endswith(f"-{direction}-pup") for n in walked) == robots
    trained = [n for n in cells if n.startswith("policy-") and not n.startswith("policy-r1")]
    assert len(trained) == 19
    assert cells["presysid-fleet"].needs == {
        f"recordings {s}": f"record-r{s}" for s in Plan().seeds
    }


def test_bounds_of_a_fleet_are_pooled_from_its_robots_fits_where_the_plan_says_so() -> None:
    plan = replace(small(), pooled=True)
    cells = graph(plan)
    assert cells["presysid-fleet"].needs == {f"fit {s}": f"presysid-r{s}" for s in plan.seeds}
    assert cells["policy-forward-pup"].needs == {"bounds": "presysid-fleet"}
    alone = graph(replace(plan, stages=("presysid",)))
    assert {cell.kind for cell in alone.values()} == {"record", "presysid", "pooled"}


def test_a_diagnosed_fleet_is_what_its_corrected_robots_share() -> None:
    cells = graph(replace(small(), stages=("diagnosed",)))
    fleet = "presysid-fleet-diagnosed"
    assert cells[fleet].needs == {f"fit {s}": f"presysid-r{s}-corrected" for s in (1000, 1001)} | {
        f"robot {s}": f"diagnosis-r{s}" for s in (1000, 1001)
    }
    start = {"bounds": fleet, "robot": fleet, "start": "policy-forward-robust"}
    assert cells["policy-forward-robust-diagnosed"].needs == start
    walked = cells["trials-r1001-forward-pup-diagnosed"]
    own = {"bounds": "presysid-r1001-corrected", "robot": "diagnosis-r1001"}
    assert walked.needs == {"policy": "policy-forward-pup-diagnosed"} | own
    assert not {n for n in cells if n.startswith("trials-") and not n.endswith("-diagnosed")}
    # Its control knows of no diagnosis, and is trained on from the same policy for as long.
    known = graph(replace(small(), stages=("undiagnosed",)))
    policy = known["policy-forward-pup-undiagnosed"]
    assert policy.needs == {"bounds": "presysid-fleet", "start": "policy-forward-pup"}
    assert policy.told == cells["policy-forward-pup-diagnosed"].told
    assert {cell.kind for cell in known.values()} == {"record", "presysid", "policy", "trials"}
    alone = graph(replace(small(), seeds=(1000,), stages=("diagnosed",)))
    assert not alone  # one robot shares nothing


def test_landscapes_are_of_the_rate_that_is_walked_at(tmp_path: Path) -> None:
    """A cell is told it, and its file tells it."""
    walks = replace(small(), trials=replace(small().trials, landscape=2, horizon=0.2))
    cell = graph(replace(walks, stages=("prior",)))["landscape-forward-pup"]
    assert cell.told["rate"] == pytest.approx(1 / 0.031)
    robot = RobotDescription.load(cell.given["robot"])
    shutil.copytree(robot.folder / "policies" / "forward", tmp_path / "policy")
    shutil.copy(robot.identified_path, tmp_path / "bounds.json")
    told = landscape(Task(cell, tmp_path, {"policy": tmp_path, "bounds": tmp_path}))
    file = tmp_path / "simulated.json"
    assert told["simulated"] == sha256(file)
    assert read_json(file)["control_rate"] == [cell.told["rate"]] * 2
    assert np.shape(read_simulated(file)["distance"]) == (16, 2)


def test_what_does_not_matter_to_a_cell_is_not_told_it() -> None:
    """Other trials change no recording, fit or policy; another training changes no fit."""
    first = graph(small())
    trials = graph(replace(small(), trials=replace(small().trials, trials=4)))
    changed = {n for n in first if first[n].told != trials[n].told}
    ends = ("-pup", "-up", "-own", "-corrected", "-undiagnosed", "-pup-diagnosed", "-up-diagnosed")
    assert changed == {n for n in first if n.startswith("trials-") and n.endswith(ends)}
    longer = replace(small(), train=replace(small().train, fleet="--steps 2000"))
    changed = {n for n in first if first[n].told != graph(longer)[n].told}
    assert changed == {f"policy-forward-{m}" for m in Method}


def test_policies_that_are_there_are_taken(tmp_path: Path) -> None:
    agents.bundle(tmp_path / "forward" / "pup")
    agents.bundle(tmp_path / "forward" / "robust" / "policy", method=Method.ROBUST)
    cells = graph(small(), tmp_path)
    ready = {n for n, cell in cells.items() if "ready" in cell.told}
    assert ready == {"policy-forward-pup", "policy-forward-robust"}
    assert not any(cells[n].needs for n in ready)
    told = cells["policy-forward-pup"].told
    assert str(tmp_path) not in str(told)  # the same wherever it lies


def test_some_robots_and_some_methods() -> None:
    plan = Plan().of([7, 8, 9], ["pup", "nominal"])
    assert plan.seeds == (7, 8, 9) and all(walk.robots == 3 for walk in plan.walks)
    assert [walk.methods for walk in plan.walks] == [("pup", "nominal"), ("pup",), ("pup",)]
    assert Plan().of(None, None) == Plan()


def test_a_robot_without_a_gait_is_refused() -> None:
    with pytest.raises(InputError, match="needs a gait"):
        graph(replace(small(), robot="servo_bench"))


@pytest.mark.parametrize("told", ["0-1000000000", "1-" + 30 * "9", "0-9999,10000-19999", "3-"])
def test_seeds_are_counted_before_they_are_made(
    told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A request of a job names them too, and is read by the service itself."""
    begun = time.monotonic()
    with pytest.raises(SystemExit):
        parser().parse_args(["experiment", "--small", "--seeds", told, "--out", "x"])
    assert time.monotonic() - begun < 5 and "--seeds" in capsys.readouterr().err


IN_VAIN: dict[str, tuple[dict[str, object], str]] = {
    "unknown": ({"motions": ("step", "jump:2")}, "record: motions: motion 'jump:2': robot"),
    "variant": ({"motions": ("step:9",)}, "record: motions: motion 'step:9': after the colon"),
    "no type": ({"fitted": ("step:0.3",)}, "record: fitted: 'step:0.3' is none of step, "),
    "not played": ({"fitted": ("fall",)}, "record: no motion is of a type in fitted"),
}


@pytest.mark.parametrize("name", IN_VAIN)
def test_motions_that_would_be_looked_for_in_vain_are_refused(name: str) -> None:
    changes, words = IN_VAIN[name]
    with pytest.raises(InputError, match=words):
        graph(replace(small(), record=replace(small().record, **changes)))


def test_what_is_diagnosed_tells_of_what_is_fitted_where_robots_are_corrected() -> None:
    def of(*motions: str) -> Plan:
        return replace(small(), diagnosis=replace(small().diagnosis, motions=motions))

    with pytest.raises(InputError, match="shares no type with fitted of record"):
        graph(of("standup"))
    assert graph(replace(of("standup"), stages=("diagnosis", "trials")))
    with pytest.raises(InputError, match="diagnosis: no motion of record"):
        graph(of("fall"))
    with pytest.raises(InputError, match="diagnosis: motions: 'walk' is none of step"):
        graph(of("walk"))
    recorded = replace(of().record, motions=("hold",))
    assert graph(replace(of(), record=recorded, stages=("diagnosis",)))


def test_more_folds_than_recordings_are_refused() -> None:
    plan = replace(small(), fleet=replace(small().fleet, folds=2))
    assert graph(plan)  # a script of each of two robots
    with pytest.raises(InputError, match="presysid: 2 folds for 1 recordings"):
        graph(replace(small(), presysid=replace(small().presysid, folds=2)))


def test_a_plan_may_ask_for_as_much_as_a_study_of_the_gateway_takes() -> None:
    pytest.importorskip("fastapi")
    from services.gateway.shapes import NewStudy

    named = ("trials", "repeats", "horizon")
    most = replace(small().trials, landscape=MOST["landscape"], **{n: MOST[n] for n in named})
    plan = replace(small(), trials=most, seed=SEEDS - 1)
    told = {name: getattr(most, name) for name in named} | {"seed": plan.seed}
    simulated = {"eta": [[0.0]] * most.landscape, "distance": [[0.0] * most.landscape] * 16}
    study = NewStudy(name="a", robot="b", policy="0" * 64, simulated=simulated, **told)
    assert study.simulated is not None and study.simulated.checked(1)
    for name, value in told.items():
        with pytest.raises(ValueError, match=name):
            NewStudy(name="a", robot="b", policy="0" * 64, **told | {name: value + 1})


def test_the_seed_of_a_plan_reaches_all_that_is_random(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").touch()
    first, other = (graph(replace(small(), seed=seed), real=tmp_path) for seed in (0, 7))
    fits = {name for name, cell in first.items() if cell.kind == "presysid"}
    assert fits >= {"presysid-r1000", "presysid-fleet", "presysid-r1000-corrected", "presysid-real"}
    for name in fits:
        assert first[name].told["fits"]["seed"] == 0 and other[name].told["fits"]["seed"] == 7
    kept = graph(small())["presysid-r1000"].told["fits"]
    assert kept == small().presysid.told()  # folders of seed 0 stay as they are
    assert replace(small(), seed=7).document()["fleet"]["seed"] == 7


def test_words_of_a_training() -> None:
    assert training("--steps 5000 --minibatch 64").minibatch == 64
    with pytest.raises(InputError, match="unrecognized arguments"):
        training("--no-such-thing")


def test_a_training_is_told_by_what_its_words_leave_out_too() -> None:
    """Were a default another one, an experiment's cached policies would not be its own."""
    usual, further = (meant("", further) for further in (False, True))
    assert usual["pattern"] > 0 and usual["steps"] == training("").steps
    assert further["pattern"] == 0
    assert usual["learning"]["sharpen"] > further["learning"]["sharpen"]
    cell = graph(small())["policy-forward-pup"]
    assert cell.told["options"] == meant(small().train.fleet, further=False)


def test_what_goes_on_from_a_gait_searches_for_none() -> None:
    for name in ("further", "diagnosed"):
        with pytest.raises(InputError, match=f"train: {name} goes on from a gait"):
            replace(small(), train=replace(small().train, **{name: "--pattern 5"}))


def test_robots_are_fitted_with_the_torque_law_that_their_policies_know() -> None:
    """Or the fitted parameters have no eta, as is found after the fleet's training."""

    def of(*stages: str) -> Plan:
        return replace(small(), presysid=replace(small().presysid, actuator="pd"), stages=stages)

    for stage in ("trials", "prior", "undiagnosed"):
        with pytest.raises(InputError, match="presysid: actuator 'pd' is another than 'nn_pd' of"):
            graph(of(stage))
    assert graph(of("presysid", "policy", "diagnosis", "diagnosed", "corrected"))
    plan = of("trials")
    assert graph(replace(plan, fleet=replace(plan.fleet, actuator="pd", compare=False)))
    assert graph(replace(plan, pooled=True))
