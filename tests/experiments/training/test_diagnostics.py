import math

import numpy as np
import pytest

from experiments.training.diagnostics import WINDOW, HealthMonitor
from experiments.training.nonfinite import nonfinite_terms
from sndjax import Experience, Rollout


def batch(reward, valid):
    rollout = Rollout(*[None] * 4, valid=np.array(valid))
    return Experience(rollout, None, np.array(reward, np.float32), None, None, None)


def test_nonfinite_terms_are_named_in_order_with_their_seed():
    made = batch([[[1.0, math.nan]], [[math.inf, 1.0]]], [[[True, False]], [[True, True]]])
    metrics = {
        "a_term": [0.0, math.nan],
        "grad_norm": [0.0, math.nan],
        "module_loss": [0.0, math.nan],
        "int_reward_mean": [0.1, math.nan],
        "policy_loss": [-math.inf, math.nan],
        "state_finite": [True, False],
    }
    assert nonfinite_terms([4, 5], made.reward, made.rollout.valid, metrics) == [
        "seed 4: policy_loss is -inf",
        "seed 5: ext_reward is inf",
        "seed 5: int_reward_mean is nan",
        "seed 5: policy_loss is nan",
        "seed 5: grad_norm is nan",
        "seed 5: a_term is nan",
        "seed 5: module_loss is nan",
        "seed 5: state is nan",
    ]


GOOD = {"feature_spread": 0.1, "int_reward_clipped": 0.2, "entropy": 2.0}


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("feature_spread", 1e-6, "the encoder has collapsed"),
        ("int_reward_clipped", 0.6, "smaller algo.eta"),
        ("entropy", 0.01, "the policy is dead"),
    ],
)
def test_HealthMonitor_bad_value_that_lasts_is_warned_of_once(name, value, words):
    signs = HealthMonitor(num_actions=18)
    line = lambda **more: GOOD | {"seed": 3} | more
    said = [signs.update(line(**{name: value})) for _ in range(WINDOW - 1)]
    assert not any(said)
    (warning,) = signs.update(line(**{name: value}))
    assert words in warning
    assert "seed 3" in warning
    assert "thesis" in warning
    assert not any(signs.update(line(**{name: value})) for _ in range(30))


def test_HealthMonitor_good_or_missing_values_give_no_warning():
    signs = HealthMonitor(num_actions=3)
    for _ in range(30):
        assert signs.update(GOOD | {"seed": 0}) == []
        assert signs.update({"seed": 0, "entropy": 1.0, "feature_spread": None}) == []
