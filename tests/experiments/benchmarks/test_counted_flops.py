import pytest

import sndjax
from experiments.benchmarks.analytic_flops import encoder_flops, flops_per_step
from experiments.benchmarks.counted_flops import ENVS, gflop_per_step
from experiments.config.compose import load_config
from sndjax.algorithms import NAMED
from sndjax.grid import OBJECTIVES, make_encoder_and_predictor


def shared(objective, signal):
    """Return how many encodings per row are saved by sharing.

    In a minibatch of 512 rows the encoder encodes 512 + 128 frames, not 1,024. The prediction
    signal encodes every frame of a rollout once, for both states of a row.
    """
    return (signal == "prediction") + (
        3 * (1 - ENVS / 512) if objective not in (None, "none", "contrastive") else 0
    )


@pytest.mark.parametrize("name", ["ppo", "rnd", "snd_v", "snd_vic", "snd_std", "icm", "sp"])
def test_counted_flops_equals_analytic_flops_less_shared_work(name):
    make, algo = NAMED[name], load_config(["env=Venture", f"algo={name}"]).algo
    objective, signal = algo.objective if make else None, algo.signal
    module = make(18, sndjax.ATARI) if make else None
    wanted = flops_per_step(objective, signal, sndjax.ATARI, (96, 96, 1), 4, 18)
    if shared(objective, signal):
        own, _ = make_encoder_and_predictor(
            OBJECTIVES[objective], sndjax.ATARI, "elu", "asymmetric"
        )
        wanted -= shared(objective, signal) * encoder_flops(own, (96, 96, 1))
    assert gflop_per_step(module, "Atari") == pytest.approx(wanted / 1e9, rel=0.03)
