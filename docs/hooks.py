"""Pages of the manual that are made when it is built: the reference, the examples, contributing."""

import ast
import re
from pathlib import Path
from posixpath import relpath

from mkdocs.structure.files import File

import sndjax

ROOT = Path(__file__).parents[1]
REFERENCE = {
    "bonus": (
        "A bonus for your loop",
        "bonus Bonus BonusSettings BonusState",
    ),
    "module": (
        "Modules",
        "make_module make_named make_intrinsic_module IntrinsicModule ObjectiveRecipe ALGORITHMS "
        "rnd qrnd snd_v snd_std snd_vic snd_vinv snd_barlow snd_byol icm sp sp_vic sp_vinv "
        "ModuleParams ModuleState",
    ),
    "objectives": (
        "Objectives",
        "Objective contrastive contrastive_loss st_dim st_dim_loss vicreg vicreg_loss "
        "vicreg_inverse barlow_twins barlow_twins_loss byol byol_distance inverse_dynamics "
        "inverse_dynamics_loss weighted_sum TargetNetwork Encode Features Loss",
    ),
    "signals": (
        "Signals",
        "Signal distillation distillation_error distillation_loss prediction prediction_error "
        "prediction_loss disagreement ensemble_variance re3 neighbour_distance simhash noveld "
        "noveld_reward e3b elliptical_bonus ngu EncoderView",
    ),
    "rollouts": (
        "Rollouts",
        "Rollout from_autoreset check_rollout Transition gather_transitions slice_transitions "
        "JaxEnvironment LiveEnvironments Visits init_environments step_environments collect "
        "FrameStack",
    ),
    "agent": (
        "Our own PPO",
        "AgentSpec Hyperparameters IntrinsicConfig TrainState init_train_state make_train_step "
        "Experience Actor ActorMemory ActOutput act clipped_surrogate generalized_advantage "
        "scale_reward",
    ),
    "networks": (
        "Networks and numbers",
        "Architecture ATARI PROCGEN SMALL VECTOR size_for Encoder ActorCritic MLP Params State "
        "RunningStatistics ReturnStatistics masked_mean all_finite skip_nonfinite __version__",
    ),
}


def defining_modules():
    """Return the module that defines each public name, from the imports of the package."""
    tree = ast.parse((ROOT / "sndjax" / "__init__.py").read_text())
    found = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name: node.module for alias in node.names}
    return found


def reference_pages():
    """Return the pages of the reference.

    Raises:
      ValueError: a public name is on no page, or on several.
    """
    listed = [name for _, names in REFERENCE.values() for name in names.split()]
    if sorted(listed) != sorted(sndjax.__all__):
        wrong = set(listed) ^ set(sndjax.__all__) or {n for n in listed if listed.count(n) > 1}
        raise ValueError(f"docs/hooks.py: not on exactly one page of the reference: {wrong}")
    modules = defining_modules()
    for page, (title, names) in REFERENCE.items():
        blocks = [f"::: {modules[name]}.{name}" for name in names.split()]
        yield f"reference/{page}.md", "\n\n".join([f"# {title}", *blocks]) + "\n"


def reference_of(path):
    """Return the page of the reference that has what a file of the library defines."""
    module = path.removesuffix(".py").replace("/", ".")
    names = {name for name, where in defining_modules().items() if where == module}
    return next(page for page, (_, listed) in REFERENCE.items() if names & set(listed.split()))


def example_pages():
    """Return a page for every example: what it is, how it is run, its code."""
    for path in sorted((ROOT / "examples").glob("*.py")):
        code = path.read_text()
        title, _, rest = (ast.get_docstring(ast.parse(code)) or "").partition("\n")
        text = f"# {path.name}\n\n{title}\n\n```text\n{rest.strip()}\n```\n" if rest.strip() else ""
        text = text or f"# {path.name}\n\n{title}\n"
        yield f"examples/{path.stem}.md", f"{text}\n```python\n{code}```\n"


def on_files(files, config):
    """Add the pages that are made."""
    pages = dict(reference_pages()) | dict(example_pages())
    pages["contributing.md"] = (ROOT / "CONTRIBUTING.md").read_text()
    pages["changes.md"] = (ROOT / "CHANGELOG.md").read_text()
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Turn links to files of the repository into links to the pages that are made of them."""
    here = str(Path(page.file.src_uri).parent)

    def link(found):
        target, anchor = found[2].removeprefix("docs/"), found[3] or ""
        name = re.sub(r"^(\.\./)*", "", target)
        if name.startswith("examples/"):
            target = relpath(str(Path(name).with_suffix(".md")), here)
        elif name.startswith("sndjax/"):
            target = relpath(f"reference/{reference_of(name)}.md", here)
        elif name == "CONTRIBUTING.md":
            target = relpath("contributing.md", here)
        elif name.startswith("experiments/") or name.endswith("/"):
            return found[1]  # text alone: it is no page
        return f"[{found[1]}]({target}{anchor})"

    return re.sub(r"\[([^\]]*)\]\((?!https?:|#)([^)#\s]+)(#[^)]*)?\)", link, markdown)


def on_post_page(output, page, config):
    """Check that a page loads nothing from elsewhere.

    Raises:
      ValueError: it loads a script, a style or a picture over the network.
    """
    found = re.search(r'<(script|link|img|iframe)[^>]*(src|href)="https?://[^"]*"', output)
    if found:
        raise ValueError(f"{page.file.src_uri} is loaded from elsewhere: {found[0]}")
    return output
