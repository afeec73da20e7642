"""How many simulations a diagnosis saves: refits of every effect at every place, beside it.

`python -m benchmarks.exhaustive --robot darwin_leg RECORDINGS --diagnosis out/diagnosis.json`
refits the nominal model with some effects of the library, drawn at random, each as the rival
`exhaustive_bic` does it, and tells from these what all of them would take: once, which finds one
effect, and as often as it takes to find what the diagnosis named and to see that there is no more.
A refit beside effects that are known has more parameters, so that the latter is the least.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.rivals.case import Case
from benchmarks.rivals.refits import TOGETHER, refitted
from pup.diagnosis.hypotheses import hypotheses
from pup.recording import load_recordings
from pup.robot import RobotDescription

SURE = 1.645
"""Standard errors of a 90 % interval."""


@dataclass(frozen=True)
class Cost:
    """What exhaustive refits take.

    Attributes:
      effects: to be refitted: at every place, in every shape.
      nominal: candidates simulated until the nominal fit is done.
      each: candidates of a refit, in the mean of some that are refitted in step, (n_steps,).
    """

    effects: int
    nominal: int
    each: np.ndarray

    def whole(self, rounds: int = 1) -> tuple[float, float]:
        """Candidates of all refits, some times, and half the width of a 90 % interval."""
        few = max(1 - TOGETHER * len(self.each) / self.effects, 0.0)  # drawn without putting back
        error = float(np.sqrt(few * self.each.var(ddof=1) / len(self.each)))
        refits = rounds * self.effects
        return self.nominal + refits * float(self.each.mean()), SURE * refits * error


def cost(case: Case, steps: int, seed: int) -> Cost:
    """Refit some effects, as many in step as the rival does.

    Args:
      case: with its nominal fit.
      steps: how many times.
      seed: of the draw.
    """
    every, nominal = hypotheses(case.measured), case.replays.count
    order = np.random.default_rng(seed).permutation(len(every))
    steps = min(steps, len(every) // TOGETHER)
    each = []
    for step, drawn in enumerate(order[: steps * TOGETHER].reshape(steps, -1), 1):
        before = case.replays.simulated
        refitted(case, case.nominal.fit, [every[i] for i in sorted(drawn)])
        taken = (case.replays.simulated - before) / len(case.measured.recordings)
        each.append(taken / TOGETHER)
        print(f"{step * TOGETHER} of {len(every)} refitted: {each[-1]:.0f} candidates each")
    return Cost(len(every), nominal, np.array(each))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--robot", required=True)
    parser.add_argument("--diagnosis", type=Path, required=True, help="its diagnosis.json")
    parser.add_argument("--steps", type=int, default=4, help=f"times that {TOGETHER} are refitted")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    robot = RobotDescription.load(asked.robot)
    document = json.loads(asked.diagnosis.read_text())
    own = document["simulations"]
    named = sum(finding["effect"] != "unknown" for finding in document["findings"])
    told = cost(Case.of(robot, load_recordings(asked.recordings, robot)), asked.steps, asked.seed)
    print(
        f"{told.effects} effects, {told.each.mean():.0f} candidates each; the nominal fit took "
        f"{told.nominal}, the whole diagnosis {own:,} and named {named}"
    )
    for what, rounds in (("one effect", 1), ("as many, and no more", named + 1)):
        whole, reach = told.whole(rounds)
        print(
            f"for {what}: {whole:,.0f} (± {reach:,.0f}), {whole / own:.1f} times as many "
            f"(90 %: {(whole - reach) / own:.1f} or more)"
        )


if __name__ == "__main__":
    main()
