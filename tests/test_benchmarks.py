"""Benchmarks are run by hand: what they import of pup must still be there."""

import importlib
import pkgutil

import pytest

import benchmarks

NAMES = [module.name for module in pkgutil.walk_packages(benchmarks.__path__, "benchmarks.")]
EXTRA = ("benchmarks.least_squares", "benchmarks.sysid_rivals")
"""They end at once without what the extra `bench` installs."""


@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_can_be_imported(name: str) -> None:
    try:
        importlib.import_module(name)
    except (ImportError, AttributeError, SystemExit):
        if name not in EXTRA:
            raise
        pytest.skip("pip install -c constraints.txt -e '.[bench]'")
