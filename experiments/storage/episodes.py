"""Finished episodes: their lengths, returns and rooms, and a summary of each seed."""

from collections import deque
from typing import Any, NamedTuple

import numpy as np


class Episode(NamedTuple):
    """One finished episode, a line of `episodes.csv`."""

    seed: int
    step: int  # rows that the seed had collected when it ended
    length: int  # transitions
    ext_return: float  # summed training reward
    score: float  # summed game score
    int_return: float  # summed intrinsic reward
    rooms: int | None = None  # distinct rooms seen, in Montezuma's Revenge


class EpisodeTracker:
    """The running sums of every environment's current episode."""

    def __init__(self, seeds: list[int], num_envs: int, rooms: bool):
        """Set all sums to zero.

        Args:
          seeds: the seed of each agent.
          num_envs: the number of environments of each seed.
          rooms: whether rooms are counted.
        """
        self.seeds = seeds
        shape = (len(seeds), num_envs)
        self.length = np.zeros(shape, np.int64)
        self.sums = np.zeros((3, *shape))  # float64: external, score, intrinsic
        self.rooms = np.zeros((*shape, 256), bool) if rooms else None

    def update(
        self,
        start: int,
        valid: Any,
        game_over: Any,
        rewards: tuple[Any, Any, Any],
        room: np.ndarray | None,
    ) -> list[list[Episode]]:
        """Add a rollout and return the episodes that ended in it, a list per seed in time order.

        Args:
          start: the number of rows that each seed had collected before.
          valid: False at reset rows, bool [S, T, N].
          game_over: whether the game ended with the row, bool [S, T, N]. A game of several lives
            is one episode here, also where each life is one for the agent.
          rewards: external, score and intrinsic, [S, T, N]; values at reset rows are ignored.
          room: the room of each row, uint8 [S, T, N], or None.
        """
        ended: list[list[Episode]] = [[] for _ in self.seeds]
        envs = valid.shape[2]
        stacked = np.where(valid, np.stack(rewards).astype(np.float64), 0)
        begun = np.zeros(self.length.shape, int)  # the first row of each current episode

        def add_rows(s: int, n: int, end: int | None) -> None:
            part = slice(begun[s, n], end)
            self.length[s, n] += valid[s, part, n].sum()
            self.sums[:, s, n] += stacked[:, s, part, n].sum(1)
            if self.rooms is not None and room is not None:
                self.rooms[s, n, room[s, part, n][valid[s, part, n]]] = True

        for t, s, n in np.argwhere((game_over & valid).transpose(1, 0, 2)).tolist():
            add_rows(s, n, t + 1)
            external, score, intrinsic = self.sums[:, s, n].tolist()
            ended[s].append(
                Episode(
                    seed=self.seeds[s],
                    step=start + (t + 1) * envs,
                    length=int(self.length[s, n]),
                    ext_return=external,
                    score=score,
                    int_return=intrinsic,
                    rooms=None if self.rooms is None else int(self.rooms[s, n].sum()),
                )
            )
            self.length[s, n], self.sums[:, s, n], begun[s, n] = 0, 0, t + 1
            if self.rooms is not None:
                self.rooms[s, n] = False
        whole = (begun == 0) & (self.rooms is None)  # no end here: all of these at once
        self.length += np.where(whole, valid.sum(1), 0)
        self.sums += np.where(whole, stacked.sum(2), 0)
        for s, n in np.argwhere(~whole).tolist():
            add_rows(s, n, None)
        return ended

    def arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the running sums, for a checkpoint."""
        found = {"length": self.length.copy(), "sums": self.sums.copy()}
        return found if self.rooms is None else found | {"rooms": self.rooms.copy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Set the running sums to those of `arrays`."""
        self.length, self.sums = np.array(arrays["length"]), np.array(arrays["sums"])
        if self.rooms is not None:
            self.rooms = np.array(arrays["rooms"])


class EpisodeSummary:
    """Statistics over all training episodes of one seed (Tables 5.6-5.8)."""

    def __init__(self) -> None:
        self.episodes = 0
        self.total = 0.0
        self.best = -np.inf
        self.score = -np.inf
        self.last: deque[float] = deque(maxlen=100)

    def add(self, episode: Episode) -> None:
        """Add a finished episode."""
        self.episodes += 1
        self.total += episode.ext_return
        self.best = max(self.best, episode.ext_return)
        self.score = max(self.score, episode.score)
        self.last.append(episode.ext_return)

    @property
    def last100(self) -> float | None:
        """Return the mean return of the last 100 episodes, or None before the first."""
        return float(np.mean(self.last)) if self.last else None

    def figures(self) -> dict[str, float | int | None]:
        """Return the statistics by name.

        The mean return is over all episodes, the maxima are of the return and of the score, and
        the last-100 return is the mean of the last hundred.
        """
        some = self.episodes > 0
        return {
            "episodes": self.episodes,
            "mean_ext_return": self.total / self.episodes if some else None,
            "max_ext_return": self.best if some else None,
            "max_score": self.score if some else None,
            "last100_ext_return": self.last100,
        }
