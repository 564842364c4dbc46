import jax.numpy as jnp
import pytest

from experiments.system.errors import ConfigError
from experiments.training.user_module import load_module
from sndjax import VECTOR, IntrinsicModule

GOOD = """
import sndjax

def mine(num_actions, size):
    return sndjax.make_module("vicreg", "re3", num_actions, size)
"""


def test_load_module_function_of_a_file_returns_its_module(tmp_path):
    (tmp_path / "b.py").write_text(GOOD)
    made = load_module(f"{tmp_path}/b.py:mine", 3, VECTOR)
    assert isinstance(made, IntrinsicModule)
    assert jnp.zeros(()) == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1", "has no function mine"),
        ("def mine(n, size): return 3", "must return an sndjax.IntrinsicModule, not int"),
        ("def mine(n): return 3", "TypeError"),
        ("def mine(n, size):\n    return 1 / 0", "ZeroDivisionError in line 2: division by zero"),
        ("def mine(:", "SyntaxError"),
        ("import sys\nsys.exit(0)", "SystemExit in line 2"),
        ("import no_such_package", "no_such_package"),
    ],
)
def test_load_module_broken_file_raises_one_line(text, words, tmp_path):
    (tmp_path / "b.py").write_text(text)
    with pytest.raises(ConfigError, match=words):
        load_module(f"{tmp_path}/b.py:mine", 3, VECTOR)
