import numpy as np
from helpers.rollouts import episodes
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.storage.episodes import Episode, EpisodeSummary, EpisodeTracker


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 12]))
def test_EpisodeTracker_any_split_of_rows_equals_a_plain_loop(seed, length):
    rng = np.random.default_rng(seed)
    seeds, steps, envs = 2, 12, 3
    parts = [episodes(rng, steps, envs) for _ in range(seeds)]
    valid, done = (np.stack([part[i] for part in parts]) for i in (2, 1))
    shape = (seeds, steps, envs)
    rewards = tuple(rng.integers(-3, 4, shape).astype(np.float32) for _ in range(3))
    room = rng.integers(0, 4, shape).astype(np.uint8)
    for reward in rewards:
        reward[~valid] = np.nan  # values in reset rows must be ignored
    tracker, got = EpisodeTracker([7, 8], envs, rooms=True), [[], []]
    for start in range(0, steps, length):
        rows = slice(start, start + length)
        cut = lambda x: x[:, rows]  # noqa: B023
        ended = tracker.update(
            100 + start * envs, cut(valid), cut(done), tuple(map(cut, rewards)), cut(room)
        )
        for i in range(2):
            got[i] += ended[i]
    for s in range(seeds):
        wanted = []
        for n in range(envs):
            current = []
            for t in range(steps):
                if not valid[s, t, n]:
                    continue
                current.append(t)
                if done[s, t, n]:
                    sums = [sum(float(r[s, k, n]) for k in current) for r in rewards]
                    rooms = len({int(room[s, k, n]) for k in current})
                    step = 100 + (t + 1) * envs
                    wanted.append((t, n, Episode(7 + s, step, len(current), *sums, rooms)))
                    current = []
        assert [episode for _, _, episode in sorted(wanted)] == got[s]


def test_EpisodeSummary_of_a_run_counts_all_episodes_and_the_last_hundred():
    summary = EpisodeSummary()
    assert summary.figures() == {
        "episodes": 0,
        "mean_ext_return": None,
        "max_ext_return": None,
        "max_score": None,
        "last100_ext_return": None,
    }
    returns = np.random.default_rng(0).normal(size=250)
    for value in returns:
        summary.add(Episode(0, 1, 1, value, 10 * value, 0.0))
    figures = summary.figures()
    assert figures["episodes"] == 250
    np.testing.assert_allclose(figures["mean_ext_return"], returns.mean())
    np.testing.assert_allclose(figures["max_ext_return"], returns.max())
    np.testing.assert_allclose(figures["max_score"], 10 * returns.max())
    np.testing.assert_allclose(figures["last100_ext_return"], returns[-100:].mean())
