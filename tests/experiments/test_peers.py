"""Other people's script on our task: adapted, and its returns counted."""

import ast
import json

import numpy as np
import pytest

from experiments import stand_ins
from experiments.config import load
from experiments.environments import Step, make_pool
from experiments.explores import main as explores
from experiments.peers import Adapted, adapted, main
from experiments.progress import Bars
from experiments.stand_ins import Counted

# Not anybody's: a random agent that asks for what CleanRL's script asks for.
RANDOM = """
from dataclasses import dataclass
import sys
import envpool
import numpy as np
from somewhere.else_ import SummaryWriter, Agent

class RNDModel:
    wrong = 1 / 0

if __name__ == "__main__":
    given = dict(zip(sys.argv, sys.argv[1:]))
    SummaryWriter("runs/here").add_scalar("x", 1, 2)
    np.random.seed(int(given["--seed"]))
    envs = envpool.make("Atari", num_envs=int(given["--num-envs"]))
    seen = envs.reset()
    assert seen[:, 3, :, :].reshape(-1, 1, 84, 84).shape == (len(seen), 1, 1, Agent.width)
    for _ in range(int(given["--total-timesteps"]) // len(seen)):
        seen, reward, done, info = envs.step(np.random.randint(0, 3, len(seen)))
        assert (info["terminated"] == done).all()
    print("not shown")
    envs.close()
"""


def run(code, ours, width=2):
    names = dict(ours)
    exec(adapted(code, ours, width), names)
    return names


def test_names_of_ours_win_over_definitions_and_imports():
    code = "import math\nfrom os import path as p, sep\nclass A: x = 1\ndef f(): return 1\ny = f()"
    found = run(code, {"f": lambda: 2, "A": 3, "p": 4, "math": 5})
    assert found["y"] == 2
    assert (found["A"], found["p"], found["math"]) == (3, 4, 5)
    assert isinstance(found["sep"], str)


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("[84, 84]", [1, 7]),
        ("(3, 84, 84)", (3, 1, 7)),
        ("list(range(80, 84))", [80, 81, 82, 83]),
        ("max(84, 84)", 7),
        ("84", 84),
    ],
)
def test_two_sides_of_a_frame_are_one_vector(said, meant):
    assert run(f"x = {said}", {}, width=7)["x"] == meant


def test_the_adapted_script_is_else_the_same():
    code = "for k in range(3):\n    a = k + 84\nb = [x for x in 'abc' if x]"
    assert ast.dump(Adapted({"other": 1}, 2).visit(ast.parse(code))) == ast.dump(ast.parse(code))


def test_episodes_are_counted_as_a_loop_counts_them():
    config = load(["env=MountainCar", "algo=rnd"])
    pool, other = (make_pool(config.env, [3], 4) for _ in range(2))
    counted, rng = Counted(pool, Bars(), 10_000), np.random.default_rng(0)
    np.testing.assert_array_equal(counted.reset(), other.reset()[0])
    returns, running = [], np.zeros(4)
    for _ in range(450):
        action = rng.integers(0, 3, 4)
        step, expected = counted.step(action), other.step(action[None])
        np.testing.assert_array_equal(step.frame, expected.frame[0])
        for k in range(4):
            running[k] += expected.reward[0, k]
            if expected.done[0, k]:
                returns.append(running[k])
                running[k] = 0
    assert len(returns) == 8  # 200 steps at most, and a step for each reset
    assert counted.returns == returns
    assert counted.summary(3, 1.0)["steps"] == 1800


def test_a_return_is_the_sum_of_an_episodes_rewards():
    class Pool:
        rows = (1, 2)
        rewards = iter([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
        ends = iter([[False, True], [False, False], [True, True]])

        def step(self, action):
            reward, done = np.array([next(self.rewards)]), np.array([next(self.ends)])
            return Step(action, reward, reward, done, done, ~done, None)

    counted = Counted(Pool(), Bars(), 6)
    for _ in range(3):
        counted.step([0, 0])
    assert counted.returns == [2.0, 9.0, 10.0]


def test_a_script_becomes_a_row_of_the_table(tmp_path, monkeypatch, capsys):
    class Agent:
        width = 2

    class gym:
        class spaces:
            Discrete = staticmethod(int)
            Box = staticmethod(lambda *args: args)

    monkeypatch.setitem(__import__("sys").modules, "gym", gym)
    monkeypatch.setattr(stand_ins, "networks", lambda *args: {"Agent": Agent, "RNDModel": Agent})
    script = tmp_path / "random_agent.py"
    script.write_text(RANDOM)
    out = tmp_path / "peers"
    assert main([str(script), "seed=4", "steps=16000", f"out={out}", "settings=gamma=0.9"]) == 0
    assert "not shown" not in capsys.readouterr().out
    (file,) = out.iterdir()
    ((name, figures),) = json.loads(file.read_text()).items()
    assert name == "MountainCar/CleanRL's RND/4,gamma=0.9"
    assert figures["steps"] == 16_000
    assert figures["episodes"] == 64  # 32 environments, two episodes of 200 steps each
    assert explores([str(file)]) == 0
    assert "| `CleanRL's RND gamma=0.9` | 0.00 | 0 of 1 | 0.00 |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "give one script"),
        (["nowhere.py"], "nowhere.py"),
        (["a.py", "peer=other"], "peer"),
        (["a.py", "settings=gamma"], "write name=value"),
    ],
)
def test_what_cannot_run_is_refused_in_a_line(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.py").write_text("")
    assert main([*arguments, "seed=0"]) == 2
    assert said in capsys.readouterr().err
