"""The resolved configuration with places, the help of one method, one form of options."""

import subprocess
import sys
from dataclasses import asdict

import pytest
import yaml

from experiments import cli, run
from experiments.config.compose import load_config
from experiments.config.explain import describe_config
from experiments.config.key_value import to_key_value
from experiments.config.option_help import run_help
from experiments.system.errors import ConfigError

LAPTOP = [
    "env=CoinrunEasy",
    "algo=icm",
    "preset=laptop",
    "ppo.clip=0.3",
    "signal.gradient=symmetric",
]


def places(arguments):
    """Return the place of every value, by its line's name; nested names by their last part."""
    found = {}
    for line in describe_config(arguments).splitlines():
        if "#" in line:
            text, _, place = line.rpartition("# ")
            found[text.partition(":")[0].strip()] = place
    return found


def test_describe_config_is_yaml_of_the_whole_configuration():
    assert yaml.safe_load(describe_config(LAPTOP)) == asdict(load_config(LAPTOP))
    module = ["env=gymnax", "env.id=CartPole-v1", "algo=grid", "algo.objective=none"]
    module += ["algo.signal=re3", "network=mlp"]
    assert yaml.safe_load(describe_config(module)) == asdict(load_config(module))


def test_describe_config_names_the_place_of_each_value():
    found = places(LAPTOP)
    wanted = {
        "clip": "command line",
        "gradient": "command line",
        "reward_scale": "preset=laptop",
        "num_envs": "preset=laptop",
        "objective_weight": "algo=icm",
        "eta": "algo=icm, from env.eta",
        "total_steps": "default, from env.total_steps",
        "gae_lambda": "default",
        "on_nan": "default",
    }
    assert {key: found[key] for key in wanted} == wanted
    baseline = places(["env=Gravitar", "algo=ppo"])
    assert baseline["gamma_ext"] == "algo=ppo, from env.baseline_gamma"
    assert baseline["baseline_gamma"] == "env=Gravitar"
    preset = places(["env=Venture", "preset=noveld", "network=wide"])
    assert (preset["signal"], preset["combine"]) == ("preset=noveld", "preset=noveld")
    assert preset["memory"] == preset["update_proportion"] == "preset=noveld"
    lines = describe_config(["env=Venture", "preset=noveld"]).splitlines()
    assert [line.split("# ")[1] for line in lines if "name: grid" in line] == ["preset=noveld"]


def test_describe_config_of_a_users_function_beside_a_preset(tmp_path):
    (tmp_path / "my.py").write_text("def mine(n, size, heat=2.0): ...")
    module = f"algo.module={tmp_path / 'my.py'}:mine"
    text = describe_config(["env=CoinrunEasy", "preset=laptop", module])
    assert [line.split("# ")[1] for line in text.splitlines() if "name: mine" in line] == [
        "algo=module"
    ]
    assert "heat: 2.0" in text


def test_describe_config_of_a_stored_run_names_that(tmp_path):
    text = describe_config(["env=MountainCar", "algo=rnd", "seed=3"])
    (tmp_path / "config.yaml").write_text(text)
    stored = places([f"repeat={tmp_path / 'config.yaml'}", "algo=rnd"])
    assert stored["seed"] == "repeat"
    new = places(["env=MountainCar", "algo=rnd", "resume=auto", f"run_dir={tmp_path / 'new'}"])
    assert (new["seed"], new["run_dir"]) == ("default", "command line")


def test_run_help_of_a_signal_has_its_equation_its_options_and_their_ranges():
    text = run_help(["signal=distillation", "objective=vicreg"])
    assert "(eq. 4.23)" in text
    assert "signal.update_proportion=1.0" in text
    assert "[more than 0, at most 1]" in text
    assert "(eq. 5.7)" in text
    assert "objective.covariance_weight=0.04" in text
    with pytest.raises(ConfigError, match="unknown signal 'novel'; did you mean noveld"):
        run_help(["signal=novel"])
    with pytest.raises(ConfigError, match=r"give signal=NAME"):
        run_help(["seed=1"])


def test_run_help_of_an_algorithm_and_of_a_run_shows_the_defaults_that_hold_there():
    text = run_help(["algo=rnd"])
    assert "signal.update_proportion=0.25" in text
    assert "section 4.1.2" in text
    text = run_help(["env=MountainCar", "algo=icm", "network.hidden=[9]"])
    for line in ("signal.gradient=detached", "algo.objective_weight=0.8", "network.hidden=[9]"):
        assert line in text
    assert "ppo.learning_rate=0.0005" in text


def test_run_help_of_a_users_function_shows_its_arguments(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        'def f(n, size, heat: float = 2.0):\n    """Make.\n\n    Args:\n      heat: h.\n    """\n'
    )
    assert "module.heat=2.0" in run_help([f"algo.module={path}:f"])


def test_to_key_value_reads_both_forms_and_leaves_flags():
    arguments = ["--ppo.normalize-rewards", "--env=Venture", "--algo", "rnd", "--cfg", "seed=1"]
    assert to_key_value(arguments) == [
        "ppo.normalize_rewards=true", "env=Venture", "algo=rnd", "--cfg", "seed=1",
    ]  # fmt: skip
    assert to_key_value(["--algo.shuffle", "false", "-m"]) == ["algo.shuffle=false", "-m"]
    assert to_key_value(["--seed"]) == ["--seed"]
    assert to_key_value(["--signal.centre", "--seed", "1"]) == ["signal.centre=true", "seed=1"]
    assert to_key_value(["--seed", "--algo", "rnd"]) == ["--seed", "algo=rnd"]
    assert to_key_value(["--network.hidden", "[8,8]", "--signal.alpha", "0.5"]) == [
        "network.hidden=[8,8]", "signal.alpha=0.5",
    ]  # fmt: skip


def test_run_prints_the_configuration_the_version_and_errors_as_one_line(capsys):
    assert run.main(["--env", "MountainCar", "--algo", "rnd", "--seed", "7", "--cfg"]) == 0
    assert "seed: 7" in capsys.readouterr().out
    assert run.main(["--cfg", "env=MountainCar"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert run.main(["--help", "signal=x"]) == 2
    for main in (run.main, cli.main):
        assert main(["--version"]) == 0
        assert capsys.readouterr().out.startswith("sndjax ")
        assert main(["--help", "signal=re3"]) == 0
        assert "signal.k=4" in capsys.readouterr().out


def test_cfg_does_not_import_jax():
    code = (
        "import sys; from experiments.run import main; "
        "main(['--cfg', 'env=MountainCar', 'algo=snd_vic', 'signal.update_proportion=0.5']); "
        "main(['--help', 'signal=noveld']); assert 'jax' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
