"""A training on a cluster whose GPU others have."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from toy_task import ToyTask

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

import ray

from pup.policy.shape import Method, PolicyShape
from workers.cluster import connected
from workers.learner import Learning
from workers.ppo import GPU_MINIBATCH, Setup, Trainer
from workers.rollouts import Sampling

SAMPLING = Sampling(ToyTask, simulations=32, steps=32, seed=0, threads=1)
SETUP = Setup(PolicyShape.of(Method.PUP, 2, 2, 2, 2), SAMPLING, Learning(minibatch=GPU_MINIBATCH))


@pytest.fixture
def ray_with_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A Ray that believes in a GPU."""
    monkeypatch.setenv("RAY_OVERRIDE_RESOURCES", '{"GPU": 1}')
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    with connected(cores=2):
        yield


@ray.remote(num_cpus=0, num_gpus=1)
class Other:
    """Has the GPU."""

    def there(self) -> bool:
        return True


@pytest.mark.ray
def test_a_gpu_that_others_have_is_not_waited_for(
    ray_with_gpu: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """The learner takes a processor and says so in a line; with usual minibatches it says none."""
    other = Other.remote()
    assert ray.get(other.there.remote())
    for minibatch, lines in ((GPU_MINIBATCH, 1), (256, 0)):
        learning = replace(SETUP.learning, minibatch=minibatch)
        with closing(Trainer(replace(SETUP, learning=learning))) as trainer:
            assert trainer.iterate().steps == 1024
        told = [line for line in capsys.readouterr().err.splitlines() if "GPU" in line]
        assert len(told) == lines
