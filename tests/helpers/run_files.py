"""Make run directories by hand, for tests of the code that reads them."""

import json

from experiments.config.compose import load_config
from experiments.config.saved import SavedConfig, to_yaml


def made(path, arguments, episodes, figures=None, rows=128):
    """Make a run from `episodes[seed]`: (step, return, score), and `figures[seed]`: the novelty."""
    config = load_config(arguments)
    path.mkdir(parents=True)
    (path / "config.yaml").write_text(to_yaml(SavedConfig(config, {"jax": "0"})))
    head = "seed,step,length,ext_return,score,int_return"
    table = [
        f"{seed},{step},10,{value},{score},0.5"
        for seed, own in episodes.items()
        for step, value, score in own
    ]
    (path / "episodes.csv").write_text("\n".join([head, *table]) + "\n")
    novelty = figures or {seed: [0.5, 0.25] for seed in episodes}
    lines = [
        {"step": rows * (i + 1), "seed": seed, "int_reward_mean": value, "ext_return": None}
        for i in range(len(next(iter(novelty.values()))))
        for seed, value in ((s, v[i]) for s, v in novelty.items())
    ]
    (path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path
