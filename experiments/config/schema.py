"""The typed configuration: every option with its default, its range and its meaning."""

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from .jax_suites import JAX_SUITES
from .library import module_names
from .option import option

OBJECTIVES = ("none", *module_names("objectives"))
SIGNALS = module_names("signals")


@dataclass(frozen=True)
class EnvConfig:
    """The options of the environment."""

    name: str = option(MISSING, "the name that results are stored under")
    id: str = option(MISSING, "the task (with env=envpool, env=gymnasium or env=MiniGrid)")
    suite: str = option(
        "envpool",
        "the library that makes the task; all but the first two live in JAX",
        choices=("envpool", "gymnasium", *JAX_SUITES),
    )
    stack: int = option(1, "number of newest frames that the policy sees", low=1, high=16)
    repeat_first: bool = option(
        True, "fill an episode's first stack with its first frame; false: with zeros"
    )
    reward: str = option(
        "raw",
        "training reward: max(0, sign), the task's own, or 1 at the goal and 0 elsewhere",
        choices=("sign", "raw", "goal"),
    )
    random_action: float = option(
        0.0, "probability that an action is replaced by a random one", low=0, high=1
    )
    total_steps: int = option(1_000_000, "the default of total_steps", low=1)
    baseline_gamma: float = option(0.99, "external discount of algo=ppo", low=0, high=1)
    eta: dict[str, float] = option({}, "published intrinsic scale of each algorithm", low=0)
    observation: str = option(
        "auto",
        "how observations are read: the run's first lines say how; image: its one image alone; "
        "vector: all of it as one vector; cells: MiniGrid's view one-hot",
        choices=("auto", "image", "vector", "cells"),
    )
    pixel_max: float | None = option(
        None, "value of a white pixel, where the bounds of the observations do not say it", above=0
    )
    options: dict[str, Any] = option(
        {}, "arguments of the library that makes the task, e.g. env.options.frame_skip=4"
    )


@dataclass(frozen=True)
class AlgoConfig:
    """The options of the intrinsic module."""

    name: str = option(MISSING, "the algorithm")
    eta: float = option(0.5, "scale of the intrinsic reward", low=0)
    reward_scale: str = option(
        "none",
        "clip(eta * signal, 0, 1), eta * signal, or eta * signal / std of its discounted return",
        choices=("none", "unclipped", "running_std"),
    )
    learning_rate: float = option(
        1e-4, "learning rate of Adam for the intrinsic module", above=0, high=1
    )
    minibatch_size: int = option(512, "rows per gradient step of the intrinsic module", low=2)
    shuffle: bool = option(False, "shuffle the intrinsic module's minibatches")
    epochs: int = option(1, "passes of the intrinsic module over a rollout", low=1, high=1000)
    anneal_learning_rate: bool = option(
        False, "let the module's learning rate fall linearly to 0 over total_steps"
    )
    adam_eps: float = option(1e-8, "epsilon of the module's Adam", above=0, high=1)
    max_grad_norm: float | None = option(
        None, "largest gradient norm of the module; default: any", above=0
    )
    preprocess: str = option(
        "none",
        "what is done to frames before the intrinsic module; standardize clips to 1 deviation, "
        "standardize_wide to 5",
        choices=("none", "mean", "standardize", "standardize_wide"),
    )
    pairing: str = option(
        "asymmetric",
        "how predictor and target differ, for signals with a predictor (Fig. 5.4)",
        choices=("asymmetric", "one_linear", "two_linear", "relu"),
    )
    objective: str = option(
        "none", "the loss that trains the encoder (algo=grid)", choices=OBJECTIVES
    )
    signal: str = option(
        "distillation", "how novelty is computed from the encoder (algo=grid)", choices=SIGNALS
    )
    objective_weight: float = option(1.0, "weight of the objective's loss", low=0)
    signal_weight: float = option(1.0, "weight of the signal's loss", low=0)
    module: str | None = option(None, "a bonus of your own, FILE.py:FUNCTION")


@dataclass(frozen=True)
class PPOConfig:
    """The options of PPO."""

    learning_rate: float = option(1e-4, "learning rate of Adam", above=0, high=1)
    minibatch_size: int = option(512, "rows per gradient step", low=1)
    epochs: int = option(4, "passes over a rollout", low=1, high=1000)
    clip: float = option(0.1, "clipping range of the probability ratio around 1", above=0, high=1)
    gamma_ext: float = option(0.998, "discount of the external reward", low=0, high=1)
    gamma_int: float = option(0.99, "discount of the intrinsic reward", low=0, high=1)
    gae_lambda: float = option(0.95, "lambda of generalized advantage estimation", low=0, high=1)
    entropy_weight: float = option(0.001, "weight of the entropy bonus", low=0)
    value_weight: float = option(0.5, "weight of the value loss", low=0)
    max_grad_norm: float = option(
        0.5, "largest gradient norm; larger gradients are scaled down", above=0
    )
    ext_weight: float | None = option(
        None, "weight of the external advantage (default 2), or of the reward in a sum (1)", low=0
    )
    int_weight: float = option(
        1.0, "weight of the intrinsic advantage, or of the reward in a sum", low=0
    )
    normalize_advantages: bool = option(False, "normalise advantages to mean 0 and std 1")
    normalize_over: str = option(
        "rollout",
        "where advantages are normalised, if they are: before the epochs, or in each minibatch",
        choices=("rollout", "minibatch"),
    )
    bootstrap_truncated: bool = option(
        False, "bootstrap from the last state of an episode that a step limit ended"
    )
    episodic_int: bool = option(True, "end intrinsic returns with the episode")
    published_mask: bool = option(
        False, "use the inverted mask of the published baseline (only algo=ppo)"
    )
    anneal_learning_rate: bool = option(
        False, "let the learning rate fall linearly to 0 over total_steps"
    )
    adam_eps: float = option(1e-8, "epsilon of Adam", above=0, high=1)
    value_clip: float | None = option(
        None, "clipping range of values around those of the rollout; default: none", above=0
    )
    clip_int_value: bool = option(True, "value_clip also clips the intrinsic value")
    target_kl: float | None = option(
        None, "KL estimate after which no further epoch of the rollout is run", above=0
    )
    shuffle_each_epoch: bool = option(
        False, "shuffle the minibatches of every epoch; false: once for all epochs of a rollout"
    )
    normalize_rewards: bool = option(
        False, "divide external rewards by the deviation of their discounted sum (gymnasium's)"
    )
    normalize_observations: bool = option(
        False, "normalise vectors by running mean and deviation, clipped to 10 (gymnasium's)"
    )
    ext_exponent: float = option(
        0.75, "exponent xi of the external reward with combine=product (eq. 4.32)", low=0, high=1
    )


@dataclass(frozen=True)
class NetworkSizes:
    """The sizes of networks; null: those of the named network for this kind of observation."""

    channels: list[int] | None = option(
        None, "channels of the convolutions of stride 2; []: none, pixels as a vector", low=1
    )
    last: int | None = option(
        None, "channels of the last convolution (not of RND's and SND-V's encoders)", low=1
    )
    patch: int | None = option(
        None, "side of the first layer's patches; 0: the thesis' 3x3 with stride 2", low=0
    )
    hidden: list[int] | None = option(None, "widths of the hidden layers for vectors", low=1)
    features: int | None = option(None, "width of the features and of linear layers", low=1)
    activation: str | None = option(
        None,
        "activation; default: relu of the policy, elu of the module; published (of the module): "
        "as in each method's experiments, mostly ReLU",
        choices=("elu", "relu", "leaky_relu", "tanh", "published"),
    )
    layer_norm: bool | None = option(
        None, "layer normalisation before the activations of hidden and linear layers"
    )


@dataclass(frozen=True)
class NetworkConfig(NetworkSizes):
    """The options of networks: of all, and of the policy's or the module's alone."""

    name: str = option("thesis", "the named network")
    memory: str = option(
        "none", "recurrent cell between the policy's torso and its heads", choices=("none", "gru")
    )
    policy: NetworkSizes = field(default_factory=NetworkSizes)
    module: NetworkSizes = field(default_factory=NetworkSizes)


@dataclass(frozen=True)
class Config:
    """All options of a run."""

    env: EnvConfig = field(default_factory=EnvConfig)
    algo: AlgoConfig = field(default_factory=AlgoConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    objective: dict[str, Any] = option({}, "the objective's arguments (--help objective=NAME)")
    signal: dict[str, Any] = option({}, "the signal's arguments (--help signal=NAME)")
    module: dict[str, Any] = option({}, "arguments of your function (--help algo.module=...)")
    combine: str = option(
        "streams",
        "two rewards with two values (the thesis), their sum (eq. 4.1) or product (eq. 4.32)",
        choices=("streams", "sum", "product"),
    )
    seed: int = option(0, "the first seed", low=0, high=2**31 - 1)
    num_seeds: int = option(1, "agents trained side by side: seed, seed + 1, ...", low=1, high=1024)
    iterations_per_call: int | None = option(
        None,
        "with environments in JAX, iterations in one call of the compiled program; default: as "
        "many as take about a second",
        low=1,
        high=65536,
    )
    cores: int | None = option(
        None,
        "CPU cores that agents with small networks are divided among, or policy and module of one "
        "agent; default: those of this process",
        low=1,
        high=1024,
    )
    overlap: int = option(
        0,
        "iterations that a policy acts behind: with 1 the next rollout is collected while the last "
        "one is learned from (docs/overlap.md)",
        low=0,
        high=1,
    )
    precision: str | None = option(
        None,
        "of matrix products: float32, or operands rounded to tf32 (10 bits) or bf16 (7); default: "
        "the device's, float32 on a CPU and tf32 on a GPU",
        choices=("float32", "tf32", "bf16"),
    )
    num_envs: int = option(128, "environments per seed", low=1, high=65536)
    rollout_length: int = option(128, "steps per iteration and environment", low=1, high=65536)
    total_steps: int = option(
        "${env.total_steps}", "agent steps per seed, rounded up to whole iterations", low=1
    )
    checkpoint_every: int = option(50, "iterations between checkpoints", low=1)
    run_dir: str | None = option(None, "where the run goes; default runs/<env>/<algo>/<time>-<id>")
    resume: str | None = option(
        None, "a run directory to resume; auto: run_dir, if there is a run in it"
    )
    repeat: str | None = option(None, "the config.yaml of a run, to start the same run again")
    tracker: str = option(
        "none",
        "a service that also receives metrics.jsonl, on this machine (docs/sweeps.md)",
        choices=("none", "mlflow", "wandb"),
    )
    distributed: bool = option(
        False, "this is one of several processes of a run, one per host (docs/sweeps.md)"
    )
    group: str | None = option(
        None, "the name that a tracker groups runs under; by default a sweep's directory"
    )
    on_nan: str = option(
        "stop",
        "a number that is not finite stops the run, skips the iteration, or is ignored",
        choices=("stop", "skip", "ignore"),
    )

    @property
    def rows(self) -> int:
        """Return the number of rows that one seed collects in an iteration."""
        return self.num_envs * self.rollout_length

    @property
    def seeds(self) -> list[int]:
        """Return the seed of each agent."""
        return [self.seed + i for i in range(self.num_seeds)]

    @property
    def iterations(self) -> int:
        """Return the number of iterations of the whole run."""
        return -(-self.total_steps // self.rows)
