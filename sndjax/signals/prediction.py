"""Forward prediction: the novelty of a transition is how badly a model foresees its end."""

from functools import partial
from typing import Literal, cast

import chex
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sndjax.networks import Perceptron
from sndjax.rollout import map_steps
from sndjax.statistics import masked_mean
from sndjax.types import Params, Signal, View

Gradient = Literal["symmetric", "detached", "asymmetric"]


def prediction_error(
    predicted: Float[Array, "*rows d"], z_next: Float[Array, "*rows d"]
) -> Float[Array, "*rows"]:
    """The novelty of each transition: tanh of the mean over d of (predicted - z_next)^2.

    Eq. 4.2 and 5.10 write the sum; the published experiments took this.

    >>> prediction_error(jnp.array([[1.0, 0.0]]), jnp.zeros((1, 2))).round(4)
    Array([0.4621], dtype=float32)
    """
    chex.assert_equal_shape([predicted, z_next])
    return jnp.tanh(jnp.mean((predicted - z_next) ** 2, axis=-1))


def prediction_loss(
    predicted: Float[Array, "B d"], z_next: Float[Array, "B d"], valid: Bool[Array, " B"]
) -> Float[Array, ""]:
    """Squared error of the forward model (eq. 5.11), mean over valid rows and d.

    >>> one = jnp.ones((2, 3))
    >>> prediction_loss(one, 3 * one, jnp.array([True, False]))
    Array(4., dtype=float32)
    """
    chex.assert_equal_shape([predicted, z_next])
    return masked_mean(jnp.mean((predicted - z_next) ** 2, axis=-1), valid)


def forward_model(z: Float[Array, "B d"]) -> Perceptron:
    """d + A -> d -> d -> d."""
    return Perceptron((z.shape[-1],) * 3)


def init_forward_model(key: PRNGKeyArray, z: Float[Array, "B d"], num_actions: int) -> Params:
    """The weights of a forward model."""
    return forward_model(z).init(key, jnp.zeros((1, z.shape[-1] + num_actions), z.dtype))


def foresee(
    params: Params, z: Float[Array, "B d"], action: Int[Array, " B"]
) -> Float[Array, "B d"]:
    """The forward model's next features, from features and a one-hot action."""
    num_actions = params["params"]["Dense_0"]["kernel"].shape[0] - z.shape[-1]
    one_hot = jax.nn.one_hot(action, num_actions, dtype=z.dtype)
    return cast(Array, forward_model(z).apply(params, jnp.concatenate([z, one_hot], axis=-1)))


def features_of_all(view: View, frames) -> Float[Array, "T1 N d"]:
    """The features of every frame of a rollout, s_T included."""
    return map_steps(lambda frame: view.encode(frame)[0], frames)


def prediction(*, gradient: Gradient = "symmetric") -> Signal:
    """A forward model of d + A -> d -> d -> d; its error is the novelty of (s_t, a_t, s_t+1).

    s_t+1 is the true one, at an episode's end too.

    Args:
      gradient: of the forward loss into the encoder. `symmetric`: through z_t and z_t+1, as
        the published SP; `detached`: through z_t alone, as ICM; `asymmetric`: none (5.1.4).

    >>> prediction(gradient="asymmetric")  # doctest: +ELLIPSIS
    Signal(init=...)
    """

    def init(key, example, features, num_actions):
        return init_forward_model(key, features.z, num_actions), {}

    def reward(params, state, view, rollout, key):
        z = features_of_all(view, rollout.frames)
        predicted = map_steps(partial(foresee, params), z[:-1], rollout.action)
        return prediction_error(predicted, z[1:]), state

    def loss(params, state, view, features, batch, key):
        z, z_next = features.z, features.z_next
        z = lax.stop_gradient(z) if gradient == "asymmetric" else z
        z_next = z_next if gradient == "symmetric" else lax.stop_gradient(z_next)
        total = prediction_loss(foresee(params, z, batch.action), z_next, batch.valid)
        return total, {"prediction_loss": total}

    return Signal(init, reward, loss, pairs=True)
