import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

LEDGER = json.loads((Path(__file__).parent / "compiled_cost.json").read_text())
ALWAYS = ("ppo", "snd_std")  # compiling the others takes too long


@pytest.mark.skipif(LEDGER["jaxlib"] != version("jaxlib"), reason="kept for another jaxlib")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=() if n in ALWAYS else pytest.mark.exhaustive)
        for n in LEDGER["algorithms"]
    ],
)
def test_compiled_cost_of_an_update_equals_the_committed_figures(name):
    """Compare the compiled cost of an update with the stored one.

    After a change write the stored compiled cost with
    `sndjax compiled_cost > tests/experiments/benchmarks/compiled_cost.json`.
    """
    command = [sys.executable, "-m", "experiments.compiled_cost", name]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)["algorithms"][name]
    assert found == pytest.approx(LEDGER["algorithms"][name], rel=0.03)
