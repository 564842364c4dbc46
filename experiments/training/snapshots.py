"""Snapshots for TensorBoard: the most novel frames, and the eigenvalues of the features."""

from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import sndjax

from ..storage.tensorboard import TensorBoardWriter
from .agents import make_encode
from .feature_spectrum import COMPARED, PERCENTILES, eigenvalues

STRIP, SIDE = 6, 160  # the most frames side by side, and their height in pixels


def most_rewarded(reward: np.ndarray, valid: np.ndarray) -> list[tuple[int, int]]:
    """Return (t, n) of the highest rewards [T, N], one for each environment, the highest first.

    There are at most `STRIP` of them, and none for an environment without a valid row.

    >>> most_rewarded(np.array([[1.0, 5.0], [2.0, 7.0]]), np.array([[True, True], [True, False]]))
    [(0, 1), (1, 0)]
    """
    seen = np.where(valid, reward, -np.inf)
    best = seen.argmax(0)
    envs = np.argsort(-seen.max(0), kind="stable")[:STRIP]
    return [(int(best[n]), int(n)) for n in envs if np.isfinite(seen[best[n], n])]


def to_rgb(frame: np.ndarray) -> np.ndarray:
    """Return an image as uint8[H, W, 3]; without 3 channels, the last channel in gray."""
    return frame if frame.shape[-1] == 3 else np.repeat(frame[..., -1:], 3, -1)


def join_frames(frames: list[np.ndarray]) -> np.ndarray:
    """Join images side by side, enlarged: uint8[SIDE, *, 3] in OpenCV's channel order (BGR)."""
    wide = []
    for frame in frames:
        size = (round(SIDE * frame.shape[1] / frame.shape[0]), SIDE)
        wide.append(cv2.resize(to_rgb(frame)[..., ::-1], size, interpolation=cv2.INTER_NEAREST))
    return np.concatenate(wide, axis=1)


def most_novel_image(rollout: sndjax.Rollout, reward: np.ndarray) -> np.ndarray | None:
    """Return the most novel frames of a rollout [T, N] as one image; None for vectors.

    Args:
      rollout: the rollout of one seed.
      reward: its intrinsic rewards, [T, N].
    """
    if rollout.frames.dtype != np.uint8:
        return None
    places = most_rewarded(reward, np.asarray(rollout.valid))
    return join_frames([np.asarray(rollout.frames[t, n]) for t, n in places]) if places else None


class SnapshotWriter:
    """The writer of snapshots of all seeds; its compiled encoder is reused."""

    def __init__(self, agent: sndjax.AgentSpec):
        """Prepare the agent's encoder, if its module has one to show."""
        self.agent = agent
        self.encode = make_encode(agent)

    def write(
        self, writer: TensorBoardWriter, seeds: list[int], state: Any, batch: Any, reward: Any
    ) -> None:
        """Write a snapshot of the last rollout of every seed.

        Args:
          writer: the TensorBoard files.
          seeds: the seed of each agent.
          state: the train states, leaves [S, ...].
          batch: the rollout, leaves [S, ...].
          reward: its intrinsic rewards, [S, T, N].
        """
        if self.agent.intrinsic is None:
            return
        read = state._replace(policy=(), policy_optimizer=(), intrinsic_optimizer=(), key=())
        for i, seed in enumerate(seeds):
            own, rollout = jax.tree.map(lambda x, i=i: x[i], (read, batch.rollout))
            step = int(own.iteration) * rollout.action.size
            image = most_novel_image(rollout, reward[i])
            writer.add_snapshot(seed, step, image, self.feature_percentiles(own, rollout))

    def feature_percentiles(
        self, state: sndjax.TrainState, rollout: sndjax.Rollout
    ) -> dict[str, float]:
        """Return percentiles of the features' eigenvalues, from evenly spaced states of a rollout.

        Args:
          state: the state of one seed.
          rollout: its rollout.

        Returns:
          The metrics by name; {} without an encoder or valid rows, or if a feature is not finite.
        """
        if self.encode is None:
            return {}
        rows = np.flatnonzero(np.asarray(rollout.valid))
        if not len(rows):
            return {}
        count = min(COMPARED, rollout.action.size)
        t, n = np.divmod(
            rows[np.linspace(0, len(rows) - 1, count).astype(int)], rollout.action.shape[1]
        )
        z = np.asarray(self.encode(state, jnp.asarray(rollout.frames[t, n]), rollout.action[t, n]))
        if not np.isfinite(z).all():
            return {}
        found = np.percentile(eigenvalues(z), PERCENTILES)
        return {f"eigenvalue_q{p}": float(x) for p, x in zip(PERCENTILES, found, strict=True)}
