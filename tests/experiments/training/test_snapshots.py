import cv2
import jax
import numpy as np
from helpers.processes import events

import sndjax
from experiments.storage.tensorboard import TensorBoardWriter
from experiments.training.snapshots import SIDE, SnapshotWriter, most_novel_image, most_rewarded
from sndjax import Rollout


def test_most_rewarded_random_rewards_finds_the_highest_of_each_environment():
    draw = np.random.default_rng(0)
    reward, valid = draw.normal(size=(9, 4)), draw.random((9, 4)) < 0.6
    found = most_rewarded(reward, valid)
    assert sorted(n for _, n in found) == [0, 1, 2, 3]
    for t, n in found:
        assert valid[t, n]
        assert reward[t, n] == max(reward[s, n] for s in range(9) if valid[s, n])
    values = [reward[place] for place in found]
    assert values == sorted(values, reverse=True)
    assert most_rewarded(reward, np.zeros((9, 4), bool)) == []


def rollout_of(frames):
    rows = frames.shape[0] - 1, frames.shape[1]
    no, yes = np.zeros(rows, bool), np.ones(rows, bool)
    return Rollout(frames, np.zeros(rows, np.int32), no, no, yes)


def test_most_novel_image_of_pixels_is_written_to_tensorboard(tmp_path):
    frames = np.zeros((4, 2, 64, 64, 3), np.uint8)
    frames[1, 0, ..., 0] = 200  # red, the most novel
    frames[2, 1, ..., 2] = 100  # blue
    reward = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 3.0]])
    boards = TensorBoardWriter(tmp_path, [4])
    boards.add_snapshot(
        4, 12, most_novel_image(rollout_of(frames), reward), {"eigenvalue_q50": 2.0}
    )
    boards.close()
    *_, event = events(tmp_path / "seed_4")
    figure, image = event.summary.value
    assert (event.step, figure.tag, figure.simple_value) == (12, "eigenvalue_q50", 2.0)
    data = np.frombuffer(image.image.encoded_image_string, np.uint8)
    shown = cv2.imdecode(data, cv2.IMREAD_COLOR)  # blue, green, red
    assert shown.shape == (SIDE, 2 * SIDE, 3)
    assert shown[80, 80].tolist() == [0, 0, 200]
    assert shown[80, 240].tolist() == [100, 0, 0]


def test_SnapshotWriter_feature_percentiles_equal_those_of_the_covariance_eigenvalues():
    module = sndjax.snd_vic(3, sndjax.VECTOR)
    agent = sndjax.AgentSpec(
        sndjax.ActorCritic(sndjax.VECTOR, 3),
        sndjax.Hyperparameters(),
        sndjax.IntrinsicConfig(module),
    )
    frames = np.random.default_rng(1).normal(size=(6, 4, 5)).astype(np.float32)
    state = sndjax.init_train_state(agent, jax.random.key(0), jax.numpy.asarray(frames[0]))
    found = SnapshotWriter(agent).feature_percentiles(state, rollout_of(frames))
    rows = jax.numpy.asarray(frames[:-1].reshape(20, 5))
    z = np.asarray(module.features(state.intrinsic, state.intrinsic_state, rows), np.float64)
    wanted = np.linalg.eigvalsh(19 * np.cov(z.T))[::-1][:20]
    np.testing.assert_allclose(found["eigenvalue_q95"], np.percentile(wanted, 95), rtol=1e-3)


def test_SnapshotWriter_vectors_and_ppo_have_no_image():
    assert most_novel_image(rollout_of(np.zeros((3, 2, 5), np.float32)), np.zeros((2, 2))) is None
    agent = sndjax.AgentSpec(sndjax.ActorCritic(sndjax.VECTOR, 3, 1), sndjax.Hyperparameters())
    assert SnapshotWriter(agent).encode is None
