"""The names that other libraries give to our options, for hints about an unknown option.

From CleanRL, Stable-Baselines3, OpenAI baselines, RLlib, PureJaxRL, Stoix and the published RND.
"""

from typing import NamedTuple


class Hint(NamedTuple):
    """What an option is called here.

    Attributes:
      options: our options that do the same, the most likely first.
      note: how the value differs from that of the other libraries, or "".
    """

    options: tuple[str, ...]
    note: str = ""


LEARNING_RATE = Hint(("ppo.learning_rate", "algo.learning_rate"))
CLIP = Hint(("ppo.clip",))
ENTROPY = Hint(("ppo.entropy_weight",))
VALUE = Hint(("ppo.value_weight",))
ROLLOUT = Hint(("rollout_length",), "steps per environment and iteration")
ENVS = Hint(("num_envs",))
EPOCHS = Hint(("ppo.epochs",))
MINIBATCHES = Hint(
    ("ppo.minibatch_size", "algo.minibatch_size"),
    "rows of a minibatch: num_envs x rollout_length / number of minibatches",
)
BATCH = Hint(("ppo.minibatch_size", "algo.minibatch_size"), "rows of a minibatch")
DISCOUNT = Hint(("ppo.gamma_ext", "ppo.gamma_int"))
LAMBDA = Hint(("ppo.gae_lambda",))
NORM = Hint(("ppo.max_grad_norm",))
STEPS = Hint(("total_steps",), "agent steps per seed")
SEED = Hint(("seed",))
SEEDS = Hint(("num_seeds",), "agents side by side, from seed on")
TASK = Hint(("env", "env.id"), "env.id with env=envpool or env=gymnasium")
ALGORITHM = Hint(("algo",))
DIRECTORY = Hint(("run_dir",))
CHECKPOINTS = Hint(("checkpoint_every",), "counted in iterations")
TRACKER = Hint(("tracker",), "mlflow or wandb")
ANNEAL = Hint(("ppo.anneal_learning_rate", "algo.anneal_learning_rate"))
EPISODES = Hint(("episodes",))

# The last part of the other name, in lower case with underscores -> the hint.
OTHER_NAMES: dict[str, Hint] = {
    **dict.fromkeys(("lr", "step_size", "alpha", "policy_lr", "actor_lr"), LEARNING_RATE),
    **dict.fromkeys(("clip_eps", "clip_coef", "clip_range", "cliprange", "clip_param"), CLIP),
    **dict.fromkeys(("clip_ratio", "clip_epsilon", "ppo_clip", "epsilon_clip"), CLIP),
    **dict.fromkeys(("ent_coef", "entropy_coef", "entropy_coeff", "entropy_cost"), ENTROPY),
    **dict.fromkeys(("ent_weight", "entropy_loss_weight", "entropy"), ENTROPY),
    **dict.fromkeys(("vf_coef", "value_coef", "value_loss_coef", "vf_loss_coeff"), VALUE),
    **dict.fromkeys(("critic_coef", "value_cost", "vf_cost", "baseline_cost"), VALUE),
    **dict.fromkeys(("n_steps", "num_steps", "nsteps", "rollout_steps", "horizon"), ROLLOUT),
    **dict.fromkeys(("unroll_length", "rollout_fragment_length", "rollout_len"), ROLLOUT),
    **dict.fromkeys(("n_envs", "nenvs", "num_workers", "num_actors", "num_env"), ENVS),
    **dict.fromkeys(("update_epochs", "n_epochs", "num_epochs", "ppo_epochs"), EPOCHS),
    **dict.fromkeys(("ppo_epoch", "noptepochs", "num_sgd_iter", "k_epochs"), EPOCHS),
    **dict.fromkeys(("num_minibatches", "n_minibatches", "nminibatches"), MINIBATCHES),
    **dict.fromkeys(("num_mini_batch", "num_mini_batches"), MINIBATCHES),
    **dict.fromkeys(("batch_size", "mini_batch_size", "sgd_minibatch_size"), BATCH),
    **dict.fromkeys(("gamma", "discount", "discount_factor"), DISCOUNT),
    **dict.fromkeys(("ext_gamma", "gamma_e", "extrinsic_gamma"), Hint(("ppo.gamma_ext",))),
    **dict.fromkeys(("int_gamma", "gamma_i", "intrinsic_gamma"), Hint(("ppo.gamma_int",))),
    **dict.fromkeys(("gae_lambda", "gae_lam", "lam", "lambda", "lambda_", "tau"), LAMBDA),
    **dict.fromkeys(("max_grad_norm", "grad_clip", "max_gradient_norm", "grad_norm"), NORM),
    **dict.fromkeys(("norm_adv", "normalize_advantage"), Hint(("ppo.normalize_advantages",))),
    **dict.fromkeys(("ext_coef", "ext_coeff", "ext_reward_coef"), Hint(("ppo.ext_weight",))),
    **dict.fromkeys(("int_coef", "int_coeff", "int_reward_coef"), Hint(("ppo.int_weight",))),
    **dict.fromkeys(("beta", "intrinsic_coef", "intrinsic_scale"), Hint(("algo.eta",))),
    "gradient": Hint(("signal.gradient",)),
    "activation": Hint(("network.module.activation", "network.policy.activation")),
    **dict.fromkeys(("anneal_lr", "lr_anneal", "linear_lr_schedule"), ANNEAL),
    **dict.fromkeys(("clip_vloss", "clip_range_vf", "value_clip_eps"), Hint(("ppo.value_clip",))),
    **dict.fromkeys(("hidden_sizes", "layer_size", "hidden_dim"), Hint(("network.hidden",))),
    **dict.fromkeys(("update_prop", "rnd_update_proportion"), Hint(("signal.update_proportion",))),
    **dict.fromkeys(("total_timesteps", "timesteps", "num_timesteps"), STEPS),
    **dict.fromkeys(("total_env_steps", "num_env_steps", "num_frames", "total_frames"), STEPS),
    **dict.fromkeys(("max_steps", "steps", "max_timesteps", "env_steps"), STEPS),
    **dict.fromkeys(("random_seed", "rng_seed", "manual_seed", "prng_seed"), SEED),
    **dict.fromkeys(("seeds", "n_seeds", "nseeds", "num_agents"), SEEDS),
    **dict.fromkeys(("env_id", "env_name", "environment", "task", "game", "gym_id"), TASK),
    **dict.fromkeys(("algorithm", "algo_name", "agent", "method"), ALGORITHM),
    **dict.fromkeys(("log_dir", "logdir", "save_dir", "output_dir", "out_dir"), DIRECTORY),
    **dict.fromkeys(("exp_dir", "save_path", "log_path", "out"), DIRECTORY),
    **dict.fromkeys(("checkpoint_freq", "checkpoint_interval", "save_freq"), CHECKPOINTS),
    **dict.fromkeys(("save_interval", "save_every"), CHECKPOINTS),
    **dict.fromkeys(("track", "wandb", "use_wandb", "logger"), TRACKER),
    **dict.fromkeys(("frame_stack", "num_stack", "n_stack", "framestack"), Hint(("env.stack",))),
    **dict.fromkeys(("n_episodes", "num_episodes", "eval_episodes"), EPISODES),
    **dict.fromkeys(("n_eval_episodes", "num_eval_episodes"), EPISODES),
    **dict.fromkeys(("fps", "frame_rate"), Hint(("rate",))),
    **dict.fromkeys(("deterministic", "greedy"), Hint(("policy",), "policy=greedy")),
}


def other_name_hint(name: str, known: set[str]) -> str:
    """Return what an option of another library is called here, as "A or B (note)", or "".

    Args:
      name: the unknown option.
      known: the options that exist; others are not named.

    >>> other_name_hint("ppo.lr", {"ppo.learning_rate", "algo.learning_rate", "seed"})
    'ppo.learning_rate'
    >>> other_name_hint("colour", {"seed"})
    ''
    """
    group, _, last = name.lower().replace("-", "_").rpartition(".")
    hint = OTHER_NAMES.get(last)
    if hint is None:
        return ""
    options = [option for option in hint.options if option in known and option != name]
    same_group = [option for option in options if group and option.startswith(f"{group}.")]
    note = f" ({hint.note})" if hint.note else ""
    return f"{' or '.join(same_group or options)}{note}" if options else ""
