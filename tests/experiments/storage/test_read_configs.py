from dataclasses import replace

import pytest
from helpers.run_files import made

from experiments.config.compose import load_config
from experiments.config.saved import SavedConfig, read_saved, to_yaml
from experiments.storage import read_configs
from experiments.storage.read_configs import ConfigReader
from experiments.system.errors import ConfigError


@pytest.fixture
def parsed(monkeypatch):
    """Return the names of the files that are parsed."""
    names = []
    parse = read_configs.parse_saved
    keep = lambda text, where: names.append(where) or parse(text, where)
    monkeypatch.setattr(read_configs, "parse_saved", keep)
    return names


def sweep(place, algorithms=("ppo", "rnd"), seeds=6):
    """Write the runs of a sweep, and return the paths of their configurations."""
    paths = []
    for algo in algorithms:
        for seed in range(seeds):
            path = place / algo / str(seed)
            options = ["env=MountainCar", f"algo={algo}", f"seed={seed}", f"run_dir={path}"]
            made(path, options, {seed: []})
            paths.append(path / "config.yaml")
    return paths


def test_ConfigReader_runs_of_a_sweep_equal_each_parsed_alone(tmp_path, parsed):
    reader = ConfigReader()
    for path in sweep(tmp_path):
        config = reader.read(path)
        assert config == read_saved(path).config
        assert (str(config.seed), config.run_dir) == (path.parent.name, str(path.parent))
    assert len(parsed) == 2  # one for each algorithm, not for each seed


@pytest.mark.parametrize(
    "where",
    [None, "7", "runs/a b", "1e5", "a/" + "very long " * 20, "no", "2026-11-27", "~", "#x/y", "-/"],
    ids=lambda where: str(where)[:9],
)
def test_ConfigReader_unusual_run_dir_equals_the_parsed_file(tmp_path, where):
    reader, config = ConfigReader(), load_config(["env=MountainCar", "algo=rnd"])
    for seed in (3, 4):
        path = tmp_path / f"{seed}.yaml"
        written = replace(config, seed=seed, run_dir=where)
        path.write_text(to_yaml(SavedConfig(written, {})))
        assert reader.read(path) == written


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("seed: 5\n", "seed: many\n"),
        ("seed: 5\n", "seed: 5\nseed: {}\n"),
        ("eta:", "eta: &a"),
        ("tracker: none", "tracker: *a"),
        ("num_envs: ", "num_envs: x"),
    ],
)
def test_ConfigReader_damaged_file_after_good_ones_is_refused(tmp_path, old, new):
    *good, last = sweep(tmp_path, ["rnd"])
    reader = ConfigReader()
    for path in good:
        reader.read(path)
    assert old in last.read_text()
    last.write_text(last.read_text().replace(old, new, 1))
    if new.startswith("eta: &a"):
        assert reader.read(last) == read_saved(last).config  # an anchor alone changes nothing
        return
    with pytest.raises(ConfigError, match=str(last)):
        read_saved(last)
    with pytest.raises(ConfigError, match=str(last)):
        reader.read(last)


def test_ConfigReader_missing_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml cannot be read"):
        ConfigReader().read(tmp_path / "none.yaml")
