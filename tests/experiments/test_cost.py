import pytest

import sndjax
from experiments.cost import giga_per_step
from sndjax.algorithms import NAMED

# Worked out by hand from the networks and the loops: forward 1, backward 2, for acting, intrinsic
# rewards, four PPO epochs and one motivation pass. Predictions there encode both states of each
# row for the reward; here every frame is encoded once, which saves one encoder pass a step:
# 2 (48*48*9*32 + 24*24*9*32*64 + 12*12*9*64*64 + 12*12*9*64*128 + 12*12*128*512) operations.
ENCODER = 0.0733
BY_HAND = {"ppo": 1.02, "rnd": 1.19, "snd_vic": 1.83, "snd_std": 1.89}
BY_HAND |= {"icm": 1.61 - ENCODER, "sp": 1.67 - ENCODER}


@pytest.mark.parametrize("name", BY_HAND)
def test_the_counted_work_is_the_nominal_work(name):
    make = NAMED[name]
    module = make(18, sndjax.ATARI) if make else None
    assert giga_per_step(module, "Atari") == pytest.approx(BY_HAND[name], rel=0.03)
