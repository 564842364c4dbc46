import jax
import jax.numpy as jnp
import numpy as np
from helpers.rollouts import KINDS, rollout
from hypothesis import given, settings
from hypothesis import strategies as st

from sndjax import RunningStatistics, distillation_error, make_module
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor
from sndjax.signals.ngu import Kernel, Memory, lifelong_factor
from sndjax.signals.ngu import episodic_rewards as eager_rewards

episodic_rewards = jax.jit(eager_rewards, static_argnums=3)
VECTOR = KINDS[2]
PAPER = Kernel(
    neighbours=10,
    epsilon=1e-4,
    cluster=0.008,
    constant=1e-3,
    max_similarity=8.0,
    distance_decay=0.99,
    full_memory=True,
)
LIFETIME = PAPER._replace(distance_decay=1.0, full_memory=False)  # before there were these options


def empty(envs, capacity, width):
    zero = jnp.zeros(())
    return Memory(jnp.zeros((envs, capacity, width)), jnp.zeros(envs, jnp.int32), zero, zero)


class InNumpy:
    """Compute algorithm 1 of Badia et al. in float64, with lists as memories.

    The moving average of squared distances is a weighted mean over every step's distances, their
    weights written out: decay to the power of the steps since.
    """

    def __init__(self, envs, capacity, kernel):
        self.lists, self.capacity, self.kernel = [[] for _ in range(envs)], capacity, kernel
        self.distances = []  # of each step that had any

    def mean(self):
        decay, last = self.kernel.distance_decay, len(self.distances) - 1
        pairs = [(decay ** (last - t), x) for t, xs in enumerate(self.distances) for x in xs]
        return sum(w * x for w, x in pairs) / (sum(w for w, _ in pairs) or 1)

    def rewards(self, z, made):
        k, first, valid = self.kernel, np.asarray(made.first), np.asarray(made.valid)
        z = np.asarray(z, np.float64)
        out = np.zeros(valid.shape)
        for t in range(len(valid)):
            rows = [n for n in range(valid.shape[1]) if valid[t, n]]
            nearest = {}
            for n in rows:
                if first[t, n]:
                    self.lists[n] = [z[t, n]]
                squares = sorted(((z[t + 1, n] - m) ** 2).sum() for m in self.lists[n])
                nearest[n] = np.array(squares[: k.neighbours])
            if any(len(x) for x in nearest.values()):
                self.distances.append(np.concatenate(list(nearest.values())))
            for n in rows:
                distance = nearest[n] / (self.mean() or 1)
                distance = np.maximum(distance - k.cluster, 0)
                similar = np.sqrt((k.epsilon / (distance + k.epsilon)).sum()) + k.constant
                few = k.full_memory and len(nearest[n]) < k.neighbours
                out[t, n] = 0 if few or similar > k.max_similarity else 1 / similar
                self.lists[n] = [*self.lists[n], z[t + 1, n]][-self.capacity :]
        return out


@settings(deadline=None, max_examples=20)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([3, 64]),
    st.sampled_from([PAPER._replace(neighbours=2), LIFETIME._replace(neighbours=2)]),
)
def test_episodic_rewards_three_rollouts_with_full_memory_equals_algorithm_1(
    seed, capacity, kernel
):
    rng = np.random.default_rng(seed)
    memory, oracle = empty(4, capacity, 3), InNumpy(4, capacity, kernel)
    for part in range(3):
        made = rollout(VECTOR, rng)
        if part == 0:  # episodes begin here, so that every later state has a neighbour
            no = jnp.zeros((8, 4), bool)
            made = made._replace(first=no.at[0].set(True), done=no, valid=~no)
        z = rng.normal(size=(9, 4, 3)).astype(np.float32)
        wanted = oracle.rewards(z, made)
        novelty, memory = episodic_rewards(memory, jnp.asarray(z), made, kernel)
        valid = np.asarray(made.valid)
        np.testing.assert_allclose(np.asarray(novelty)[valid], wanted[valid], rtol=2e-3)


def test_episodic_rewards_ten_equal_neighbours_is_one_over_root_of_ten():
    """Compare with the closed form: at distance 0 every kernel is 1."""
    no = jnp.zeros((20, 1), bool)
    made = rollout(VECTOR, np.random.default_rng(0))
    made = made._replace(first=no.at[0].set(True), done=no, valid=~no)
    novelty, _ = episodic_rewards(empty(1, 32, 2), jnp.ones((21, 1, 2)), made, PAPER)
    wanted = [1 / (np.sqrt(min(k, 10)) + 1e-3) for k in range(1, 21)]
    np.testing.assert_allclose(novelty[:, 0], [0] * 9 + wanted[9:], rtol=1e-5)
    novelty, _ = episodic_rewards(empty(1, 32, 2), jnp.ones((21, 1, 2)), made, LIFETIME)
    np.testing.assert_allclose(novelty[:, 0], wanted, rtol=1e-5)
    similar = LIFETIME._replace(max_similarity=2.0)  # above this similarity the reward is 0
    novelty, _ = episodic_rewards(empty(1, 32, 2), jnp.ones((21, 1, 2)), made, similar)
    assert np.all(novelty[4:, 0] == 0)
    assert np.all(novelty[:3, 0] > 0)


def test_episodic_rewards_d_m_follows_an_encoder_whose_scale_shrinks():
    """After the features shrink to a tenth, the rewards are soon those of before."""
    rng = np.random.default_rng(0)
    no = jnp.zeros((200, 4), bool)
    made = rollout(VECTOR, rng)
    made = made._replace(first=no.at[0].set(True), done=no, valid=~no)
    later = {}
    for name, kernel in (("moving", PAPER), ("lifetime", PAPER._replace(distance_decay=1.0))):
        memory, before = empty(4, 64, 3), None
        for scale in (1.0, *6 * [0.1]):
            z = jnp.asarray(scale * rng.normal(size=(201, 4, 3)), jnp.float32)
            novelty, memory = episodic_rewards(memory, z, made, kernel)
            median = float(jnp.median(novelty[50:]))
            before = before or median
        later[name] = median / before
    assert 0.8 < later["moving"] < 1.25
    assert later["lifetime"] < 0.5  # everything looks the same to it


def test_lifelong_factor_low_or_high_error_is_clipped_to_one_and_maximum():
    moments = RunningStatistics(jnp.array(9.0), jnp.array(2.0), jnp.array(36.0))  # std 2
    got = lifelong_factor(jnp.array([[0.0, 2.0, 4.0, 100.0]]), moments)
    np.testing.assert_allclose(got, [[1, 1, 2, 5]], rtol=1e-6)


def test_ngu_reward_is_product_of_episodic_reward_and_lifelong_factor():
    no = jnp.zeros((8, 4), bool)
    made = rollout(VECTOR, np.random.default_rng(0))
    made = made._replace(first=no.at[0].set(True), done=no, valid=(~no).at[3, 1].set(False))
    kernel = PAPER._replace(neighbours=2)
    module = make_module(
        "vicreg", "ngu", VECTOR.actions, VECTOR.size, signal_options={"neighbours": 2}
    )
    params, state = jax.jit(module.init)(jax.random.key(0), made.frames[0])
    reward, after = jax.jit(module.reward)(params, state, made, jax.random.key(1))
    encoder, learned = make_encoder_and_predictor(
        OBJECTIVES["vicreg"], VECTOR.size, "elu", "asymmetric"
    )
    frames = made.frames.reshape(36, -1)
    z, _ = encoder.apply(params.encoder, frames)
    copy, _ = learned.apply(params.signal, frames)
    error = np.asarray(distillation_error(copy, z), np.float64).reshape(9, 4)[1:]
    valid = np.asarray(made.valid)
    factor = np.clip(1 + (error - error[valid].mean()) / error[valid].std(), 1, 5)
    episodic = InNumpy(4, 1024, kernel).rewards(np.asarray(z).reshape(9, 4, 16), made)
    np.testing.assert_allclose(np.asarray(reward)[valid], (episodic * factor)[valid], rtol=5e-3)
    assert int(after.signal.errors.samples) == valid.sum()
