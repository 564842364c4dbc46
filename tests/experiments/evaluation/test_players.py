"""Test `evaluate`, `record` and `analyze` on trained agents loaded from checkpoints."""

import json
import os
import shutil
import subprocess
import sys

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.processes import ROOT

from experiments import analyze, evaluate, record
from experiments.analysis.state_dataset import (
    States,
    collect_states,
    encode_states,
    policy_torso_features,
)
from experiments.config.envpool_tasks import envpool
from experiments.evaluation import video
from experiments.evaluation.players import (
    episode_novelty,
    load_players,
    play_episodes,
    render_episode,
)
from experiments.run import main as train
from experiments.system.errors import ConfigError
from sndjax import Rollout
from sndjax.acting import scale_observations, unroll
from sndjax.rollout import push_frame, stack_to_channels

CAR = ["env=MountainCar", "num_envs=8", "rollout_length=32", "ppo.minibatch_size=128"]
CAR += ["algo.minibatch_size=128", "num_seeds=2", "total_steps=1000"]
SEA = ["num_envs=4", "rollout_length=16", "ppo.minibatch_size=32", "algo.minibatch_size=32"]
SEA += ["total_steps=128"]
PIXELS = ["env=MontezumaRevenge", "num_envs=4", "rollout_length=16", "ppo.minibatch_size=64"]
PIXELS += ["algo.minibatch_size=64", "ppo.epochs=1", "total_steps=64"]


def trained(path, *arguments):
    command = [sys.executable, "-m", "experiments.run", *arguments, f"run_dir={path}"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run(command, env=environment, check=True, capture_output=True, timeout=300)
    return path


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("car") / "run", *CAR, "algo=snd_vic")


@pytest.fixture(scope="module")
def pixels(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("pixels") / "run", *PIXELS, "algo=rnd")


def test_play_episodes_greedy_repeated_gives_the_same_episodes(car):
    _, player = load_players(car)
    assert player.seed == 1
    first, again = (play_episodes(player, 3, greedy=True, seed=5) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert {len(episode.action) for episode in first} == {200}  # MountainCar's limit
    assert all(episode.reward.sum() == 0 for episode in first)
    assert all(episode.score.sum() == -200 for episode in first)


def test_play_episodes_greedy_takes_action_with_largest_logit(car):
    player = load_players(car)[0]
    (episode,) = play_episodes(player, 1, greedy=True)
    logits, value = player.agent.network.apply(
        player.state.policy, jnp.asarray(episode.frames[:-1])
    )
    np.testing.assert_array_equal(episode.action, jnp.argmax(logits, -1))
    np.testing.assert_allclose(episode.value, value, rtol=1e-4, atol=1e-5)


def test_play_episodes_recurrent_policy_remembers_the_episode(tmp_path):
    task = ["env=envpool", "env.id=CartPole-v1", "algo=rnd", "network.memory=gru"]
    more = ["network.activation=tanh", "ppo.learning_rate=3e-3"]
    run = trained(tmp_path / "run", *task, *CAR[1:], *more)
    player = load_players(run)[0]
    (episode,) = play_episodes(player, 1, greedy=True)
    steps, network = len(episode.action), player.agent.network
    frames = jnp.asarray(episode.frames[:-1])
    seen = scale_observations(player.agent, frames, player.state.observations)
    first = jnp.arange(steps)[:, None] == 0
    start = network.initial_memory(1)
    logits, value, _ = unroll(network, player.state.policy, seen, start, first)
    np.testing.assert_array_equal(np.argmax(logits, axis=-1), episode.action)
    np.testing.assert_allclose(value, episode.value, rtol=1e-4, atol=1e-5)
    forgetful, _ = network.apply(player.state.policy, seen)
    assert np.abs(logits - forgetful).max() > 0.01


def test_episode_novelty_equals_the_reward_of_the_module(car):
    player = load_players(car)[0]
    (episode,) = play_episodes(player, 1)
    steps = len(episode.action)
    edge = np.arange(steps)[:, None]
    rollout = Rollout(
        jnp.asarray(episode.frames[:, None]),
        jnp.asarray(episode.action[:, None]),
        jnp.asarray(edge == 0),
        jnp.asarray(edge == steps - 1),
        jnp.ones((steps, 1), bool),
    )
    module, state = player.agent.intrinsic.module, player.state
    wanted, _ = module.reward(state.intrinsic, state.intrinsic_state, rollout, jax.random.key(0))
    np.testing.assert_allclose(episode_novelty(player, episode), wanted[:, 0], rtol=1e-4)


def test_render_episode_draws_every_frame_and_refuses_changed_frames(car):
    player = load_players(car)[0]
    episode = play_episodes(player, 2, seed=3)[1]
    drawn = list(render_episode(player, episode))
    assert len(drawn) == len(episode.frames)
    assert drawn[0].shape == (400, 600, 3)
    other = episode._replace(frames=episode.frames + 1)
    with pytest.raises(ConfigError, match="differs"):
        list(render_episode(player, other))


def test_evaluate_finished_run_prints_metrics_and_json(car, capsys):
    assert evaluate.main([str(car), "episodes=3"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [line["seed"] for line in found["seeds"]] == [0, 1]
    for seed, line in enumerate(found["seeds"]):
        scores = [e.score.sum() for e in play_episodes(load_players(car)[seed], 3)]
        assert line["score"]["mean"] == pytest.approx(np.mean(scores))
        low, high = line["score"]["interval"]
        assert min(scores) <= low <= high <= max(scores)


def test_record_finished_run_writes_video_and_contact_sheet(pixels, tmp_path):
    run = [str(pixels), "episodes=2", "steps=30", f"out={tmp_path}"]
    assert record.main(run) == 0
    (film,), (sheet,) = tmp_path.glob("*.mp4"), tmp_path.glob("*.png")
    reader = cv2.VideoCapture(str(film))
    frames = []
    while True:
        there, frame = reader.read()
        if not there:
            break
        frames.append(frame)
    assert len(frames) == 30
    assert frames[0].shape[0] == video.HEIGHT
    # The red mark of the current step moves to the right.
    redness = [f[:, -video.SIDE :].astype(int) @ [0, -1, 1] for f in (frames[2], frames[-2])]
    left, right = (red.sum(0).argmax() for red in redness)
    assert left < right - 100
    assert cv2.imread(str(sheet)) is not None


def test_policy_torso_features_recorded_states_use_the_stacks_of_acting(pixels):
    (player,) = load_players(pixels)
    draw = np.random.default_rng(0)
    frames = draw.integers(0, 256, (7, 96, 96, 1), np.uint8)
    age = np.array([0, 1, 2, 3, 4, 0, 1])
    found = policy_torso_features(player, States(frames, np.zeros(7, np.int32), age, None))
    window = jnp.zeros((4, 1, 96, 96, 1), jnp.uint8)
    for t in range(7):
        window = push_frame(window, jnp.asarray(frames[t][None]), jnp.array([age[t] == 0]), True)
        _, kept = player.agent.network.apply(
            player.state.policy, stack_to_channels(window), capture_intermediates=True
        )
        wanted = kept["intermediates"]["Dense_0"]["__call__"][0][0]
        np.testing.assert_allclose(found[t], wanted, rtol=2e-3, atol=1e-4)


def test_collect_states_pairs_stay_inside_one_episode(car):
    player = load_players(car)[0]
    states = collect_states(player, 450, seed=0)
    assert len(states.frames) == 450
    assert states.room is None
    assert np.flatnonzero(~states.follows).tolist() == [199, 399]
    z = encode_states(player, states)
    (episode, *_) = play_episodes(player, 4)
    np.testing.assert_array_equal(states.frames[:200], episode.frames[:200])
    module, state = player.agent.intrinsic.module, player.state
    some = jnp.asarray(episode.frames[:5])
    wanted = module.features(state.intrinsic, state.intrinsic_state, some)
    np.testing.assert_allclose(z[:5], wanted, rtol=1e-4, atol=1e-5)


def test_analyze_committed_trajectory_writes_tables_and_pictures(pixels, tmp_path, capsys):
    out = tmp_path / "out"
    given = [str(pixels), "trajectory=true", "states=120", f"out={out}"]
    assert analyze.main(given) == 0, capsys.readouterr().err
    names = {path.name for path in out.iterdir()}
    for name in ("distances", "tsne", "eigenvalues"):
        assert {f"{name}.png", f"{name}.svg"} <= names
    rows = (out / "geometry.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows[1:]] == ['"RND', '"RND', '"RND']
    assert "1.93 ± 1.15" in rows[-1]  # Table 5.9


def test_play_episodes_other_environment_seeds_give_other_episodes(pixels):
    (player,) = load_players(pixels)
    first, second = (play_episodes(player, 1, seed=seed, keep=False)[0] for seed in (0, 1))
    assert len(first.frames) == 1
    assert first.action[:50].tolist() != second.action[:50].tolist()


def test_load_players_module_named_by_a_stored_file_is_refused(car, tmp_path):
    bonus = tmp_path / "bonus.py"
    bonus.write_text("open('ran', 'w')\n")
    run = tmp_path / "run"
    shutil.copytree(car, run)
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("module: null", f"module: {bonus}:make"))
    with pytest.raises(ConfigError, match="for safety repeat"):
        load_players(run)


def test_load_players_damaged_checkpoint_is_named_and_the_previous_used(car, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(car, run)
    newest = max((run / "checkpoints").iterdir(), key=lambda path: int(path.name))
    (newest / "arrays.npz").write_bytes(b"")
    assert load_players(run)[0].iteration < int(newest.name)
    assert "cannot be used" in capsys.readouterr().out


@pytest.mark.parametrize("command", [analyze, evaluate, record])
def test_analyze_evaluate_record_bad_input_exits_with_status_2(
    command, car, pixels, tmp_path, capsys
):
    assert command.main([str(tmp_path)]) == 2
    assert "there is no run" in capsys.readouterr().err
    assert command.main([str(car), "nothing=1"]) == 2
    assert command.main([str(car), str(pixels)]) == 2
    err = capsys.readouterr().err
    assert ("different environments" in err) or ("one run directory" in err)
    empty = tmp_path / "empty"
    empty.mkdir()
    for name in ("config.yaml", "metrics.jsonl", "episodes.csv"):
        (empty / name).write_bytes((car / name).read_bytes())
    assert command.main([str(empty)]) == 2
    assert "there is no checkpoint" in capsys.readouterr().err


def test_play_episodes_of_a_run_on_lives_are_whole_games(tmp_path):
    """Repeat the actions in envpool, without episodic lives: the game ends at the same step."""
    task = ["env=envpool", "env.id=Breakout-v5", "env.options.episodic_life=true"]
    small = ["algo=ppo", "network=small", "num_envs=4", "rollout_length=16", "total_steps=64"]
    path = tmp_path / "run"
    (player,) = load_players(trained(path, *task, *small, "ppo.minibatch_size=64"))
    episodes = play_episodes(player, 2, seed=3, max_steps=1000)
    options = dict(player.config.env.options)
    assert options.pop("episodic_life") is False
    for episode in episodes:
        seed = [episode.stream]
        game = envpool.make("Breakout-v5", env_type="gymnasium", num_envs=1, seed=seed, **options)
        game.reset()
        for action in episode.executed[:-1]:
            _, _, terminated, truncated, _ = game.step(np.array([action], np.int32))
            assert not terminated[0]
            assert not truncated[0]
        _, _, terminated, _, info = game.step(episode.executed[-1:].astype(np.int32))
        assert terminated[0]
        assert info["lives"][0] == 0


def test_record_of_an_environment_in_jax_draws_every_state(tmp_path):
    pytest.importorskip("gymnax")
    path = tmp_path / "run"
    sea = ["env=gymnax", "env.id=DeepSea-bsuite", "env.options.size=6", "algo=rnd", *SEA]
    assert train([*sea, f"run_dir={path}"]) == 0
    (player,) = load_players(path)
    for episode in play_episodes(player, 3):
        assert len(episode.action) == 6
        pictures = list(render_episode(player, episode))
        assert len(pictures) == 7
        for k, picture in enumerate(pictures):
            assert picture.shape == (318, 318, 3)  # 6 cells of 53 pixels
            lit = (picture.max(-1) > 0).reshape(6, 53, 6, 53).all((1, 3))
            assert lit.sum() == (k < 6)  # behind the last row there is nothing
            if k < 6:
                assert lit[k].any()
