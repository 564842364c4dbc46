"""Test `external`: scripts of other projects, adapted to our environments, with their returns.

Tests that need torch run only where it is installed (docs/results/explores.md: how to install it).
"""

import ast
import json
import sys
from types import ModuleType, SimpleNamespace

import gymnasium
import numpy as np
import pytest

from experiments.benchmarks.external import stand_ins as stand_ins
from experiments.benchmarks.external.run_script import FrameShapeRewriter, adapt_script
from experiments.benchmarks.external.stand_ins import EpisodeCountingEnv
from experiments.config.compose import load_config
from experiments.environments.pools import EnvStep, make_pool
from experiments.external import main
from experiments.seed_table import main as explores
from experiments.system.display import ProgressBars
from experiments.system.errors import ConfigError

# A script that uses the same names as CleanRL's script. It pushes the car in the direction of its
# velocity, which reaches the goal in every episode.
SWINGS = """
import sys
import envpool
import numpy as np
from somewhere.else_ import SummaryWriter, Agent

class RNDModel:
    wrong = 1 / 0

if __name__ == "__main__":
    given = dict(zip(sys.argv, sys.argv[1:]))
    SummaryWriter("runs/here").add_scalar("x", 1, 2)
    envs = envpool.make("Atari", num_envs=int(given["--num-envs"]), seed=int(given["--seed"]))
    seen = envs.reset()
    for step in range(int(given["--total-timesteps"]) // len(seen)):
        assert seen[:, 3, :, :].reshape(-1, 1, 84, 84).shape == (len(seen), 1, 1, 2)
        position, velocity = seen[:, 3, 0].T
        seen, reward, done, info = envs.step(np.where(velocity >= 0, 2, 0))
        assert set(reward) <= {0.0, 1.0}
        assert done[reward == 1].all()
        assert (info["reward"] == reward).all() and (info["terminated"] == done).all()
        assert (seen[done, 3, 0, 0] > 0.55).all()  # the goal, as a part of the track's half
    print("not shown")
    envs.close()
"""


def run(code, ours, width=2):
    names = dict(ours)
    exec(adapt_script(code, ours, width), names)
    return names


def test_adapt_script_our_names_replace_definitions_and_imports():
    code = "import math\nfrom os import path as p, sep\nclass A: x = 1\ndef f(): return 1\ny = f()"
    found = run(code, {"f": lambda: 2, "A": 3, "p": 4, "math": 5})
    assert found["y"] == 2
    assert (found["A"], found["p"], found["math"]) == (3, 4, 5)
    assert isinstance(found["sep"], str)


def test_adapt_script_attributes_of_a_class_stay():
    found = run("class A:\n    def f(self): return 1\ndef f(): return 3", {"f": lambda: 2})
    assert (found["A"]().f(), found["f"]()) == (1, 2)


def test_adapt_script_another_script_is_refused():
    with pytest.raises(ConfigError, match="it has no Agent, envpool"):
        adapt_script("import os\nclass B: pass", {"Agent": 1, "envpool": 2, "B": 3}, 2)


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
def test_FrameShapeRewriter_two_sides_of_a_frame_become_one_vector(said, meant):
    assert run(f"x = {said}", {}, width=7)["x"] == meant


def test_FrameShapeRewriter_script_without_frame_sides_is_unchanged():
    code = "for k in range(3):\n    a = k + 84\nb = [x for x in 'abc' if x]"
    assert ast.dump(FrameShapeRewriter(2).visit(ast.parse(code))) == ast.dump(ast.parse(code))


def pools(count, seed=3):
    config = load_config(["env=MountainCar", "algo=rnd"])
    return [make_pool(config.env, [seed], 4) for _ in range(count)]


def test_EpisodeCountingEnv_episodes_equal_those_of_a_plain_loop():
    pool, other = pools(2)
    counted, rng = EpisodeCountingEnv(pool, ProgressBars(), 10_000), np.random.default_rng(0)
    np.testing.assert_array_equal(counted.reset(), other.reset()[0])
    ended = []
    for rows in range(4, 1804, 4):
        action = rng.integers(0, 3, 4)
        step, expected = counted.step(action), other.step(action[None])
        np.testing.assert_array_equal(step.frame, expected.frame[0])
        np.testing.assert_array_equal(step.reward, expected.reward[0])
        ended += [rows] * int(expected.done.sum())
    assert len(ended) == 8  # at most 200 steps per episode, and one step per reset
    assert [rows for rows, _ in counted.ended] == ended
    assert counted.rows == 1800


class Scripted:
    """A pool of two environments with given rewards and ends of episodes."""

    rows = (1, 2)

    def __init__(self, rewards, ends):
        self.rewards, self.ends = iter(rewards), iter(ends)

    def reset(self):
        return np.zeros((1, 2, 3))

    def step(self, action):
        reward, done = np.array([next(self.rewards)]), np.array([next(self.ends)])
        return EnvStep(action, reward, reward, done, done, done, ~done, None)


def test_EpisodeCountingEnv_return_is_the_sum_of_rewards():
    rewards = [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]]
    ends = [[False, True], [False, False], [True, True], [True, True]]
    counted = EpisodeCountingEnv(Scripted(rewards, ends), ProgressBars(), 6)
    for _ in range(3):
        counted.step([0, 0])
    assert counted.ended == [(2, 2.0), (6, 9.0), (6, 10.0)]
    counted.running[:] = 100
    counted.reset()
    counted.step([0, 0])
    assert counted.ended[3:] == [(8, 7.0), (8, 8.0)]


def test_EpisodeCountingEnv_summary_leaves_the_warm_up_out():
    both = lambda x: [[x(k), x(k)] for k in range(200)]
    counted = EpisodeCountingEnv(Scripted(both(float), both(lambda k: True)), ProgressBars(), 6)
    for _ in range(200):
        counted.step([0, 0])
    assert counted.summary(3, 300) == {
        "seed": 3,
        "steps": 300,
        "warm_up_steps": 100,
        "episodes": 300,
        "mean_ext_return": np.arange(50, 200).mean(),
        "last100_ext_return": np.arange(150, 200).mean(),
    }


@pytest.fixture
def light(monkeypatch):
    """Replace torch and the old gym by small substitutes."""
    spaces = SimpleNamespace(Discrete=int, Box=lambda *bounds: bounds)
    monkeypatch.setitem(sys.modules, "gym", SimpleNamespace(spaces=spaces))
    names = {"Agent": None, "RNDModel": None}
    monkeypatch.setattr(stand_ins, "cleanrl_networks", lambda width: names)


def test_external_small_script_becomes_a_row_of_the_table(light, tmp_path, capsys):
    script = tmp_path / "swings.py"
    script.write_text(SWINGS)
    out, argv = tmp_path / "peers", list(sys.argv)
    given = [str(script), "seed=4", "steps=16384", f"out={out}", "settings=gamma=0.9"]
    assert main(given) == 0
    assert "not shown" not in capsys.readouterr().out
    assert sys.argv == argv
    (file,) = out.iterdir()
    ((name, figures),) = json.loads(file.read_text()).items()
    assert name == "MountainCar/CleanRL's RND/4,gamma=0.9,steps=16384"
    assert figures["steps"] == 16_384
    assert figures["warm_up_steps"] == 0
    assert figures["episodes"] > 100  # of about 115 steps each, depending on the start
    assert figures["mean_ext_return"] == figures["last100_ext_return"] == 1.0
    assert explores([str(file)]) == 0
    assert "| `CleanRL's RND gamma=0.9 steps=16384` | 1.00 | 1.00 |" in capsys.readouterr().out


def test_external_script_starts_where_our_pool_of_its_seed_does(light, tmp_path, capsys):
    script = tmp_path / "looks.py"
    script.write_text(
        "import envpool\nfrom logs import SummaryWriter, Agent\nclass RNDModel: pass\n"
        "raise OSError(envpool.make('Atari').reset()[:, 3, 0].tolist())"
    )
    seen = []
    for seed in (4, 5):
        assert main([str(script), f"seed={seed}"]) == 2
        seen.append(json.loads(capsys.readouterr().err.removeprefix("sndjax: ")))
        pool = make_pool(load_config(["env=MountainCar", "algo=rnd"]).env, [seed], 32)
        np.testing.assert_array_equal(seen[-1], pool.reset()[0])
    assert seen[0] != seen[1]


def test_rlexplore_adapter_step_returns_frames_and_two_kinds_of_end(monkeypatch):
    reward = ModuleType("rllte.xplore.reward")
    reward.RND = lambda **given: given
    for name in ("rllte", "rllte.xplore"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, "rllte.xplore.reward", reward)
    monkeypatch.setattr(stand_ins, "rlexplore_networks", lambda width: {"Agent": None})
    pool, other = pools(2)
    counted = EpisodeCountingEnv(pool, ProgressBars(), 10_000)
    ours = stand_ins.rlexplore_adapter(counted, {"rnd.beta": 0.5, "gamma": 0.9}, 3)
    assert ours["RE3"](device="cpu") == {"beta": 0.5, "device": "cpu"}
    envs = ours["gym"].vector.SyncVectorEnv([ours["make_env"]("Atari", 0, False, "x")])
    assert isinstance(envs, gymnasium.vector.VectorEnv)
    assert (envs.num_envs, envs.single_action_space.n) == (4, 3)
    assert envs.single_observation_space.shape == (2,)
    seen, _ = envs.reset(seed=1)
    np.testing.assert_array_equal(seen, other.reset()[0])
    ends = {"goal": 0, "limit": 0}
    for _ in range(400):  # two cars swing to the goal, two are not pushed
        action = np.where(seen[:, 1] >= 0, 2, 0)
        action[2:] = 1
        seen, reward, terminated, truncated, _ = envs.step(action)
        expected = other.step(action[None])
        np.testing.assert_array_equal(seen, expected.frame[0])
        np.testing.assert_array_equal(reward, expected.reward[0])
        assert not (terminated & truncated).any()
        np.testing.assert_array_equal(terminated, reward == 1)
        np.testing.assert_array_equal(terminated | truncated, expected.done[0])
        ends["goal"] += int(terminated[:2].sum())
        ends["limit"] += int(truncated[2:].sum())
    assert ends["goal"] >= 4
    assert ends["limit"] == 2  # the next is at step 401, because of the reset


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "give one script"),
        (["nowhere.py"], "nowhere.py"),
        (["a.py", "peer=other"], "peer"),
        (["a.py", "settings=gamma"], "write name=value"),
        (["a.py", "settings=rnd.beta=1"], "rnd.beta is not a setting of peer=cleanrl"),
        (["a.py", "settings=seed=3"], "seed is not a setting"),
        (["a.py"], "it has no Agent, RNDModel, SummaryWriter, envpool"),
    ],
)
def test_external_bad_input_is_refused_with_reason(
    arguments, said, light, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.py").write_text("")
    assert main([*arguments, "seed=0"]) == 2
    assert said in capsys.readouterr().err


ENVS = SimpleNamespace(single_action_space=SimpleNamespace(n=3))


def test_cleanrl_networks_stack_reads_the_newest_frame():
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    made = stand_ins.cleanrl_networks(2)
    agent, rnd = made["Agent"](ENVS), made["RNDModel"](4, 3)
    x = torch.randn(5, 4, 1, 2)
    older = x.clone()
    older[:, :3] = 0
    action, log_prob, entropy, external, intrinsic = agent.get_action_and_value(x)
    assert action.shape == log_prob.shape == entropy.shape == (5,)
    assert external.shape == intrinsic.shape == (5, 1)
    for value, again in zip((external, intrinsic), agent.get_value(older), strict=True):
        torch.testing.assert_close(value, again)
    assert (agent.get_value(-x)[0] - external).abs().min() > 0
    predicted, target = rnd(x[:, 3:])
    assert predicted.shape == target.shape == (5, 64)
    ((predicted - target) ** 2).mean().backward()
    assert all(p.grad is None for p in rnd.target.parameters())
    assert all(p.grad.abs().sum() > 0 for p in rnd.predictor.parameters())


def test_rlexplore_networks_policy_has_heads_on_its_torso():
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    agent = stand_ins.rlexplore_networks(2)["Agent"](ENVS)
    x = torch.randn(5, 2)
    action, log_prob, entropy, value = agent.get_action_and_value(x)
    assert action.shape == log_prob.shape == entropy.shape == (5,)
    torch.testing.assert_close(value, agent.get_value(x))
    torch.testing.assert_close(value, agent.critic(agent.torso(x)))
    assert agent.critic.weight.norm().item() == pytest.approx(1.0)
    assert agent.actor.weight.norm(dim=1).tolist() == pytest.approx([0.01] * 3)
