"""Fine-tune OpenVLA-OFT on the datasets beside this folder, by the settings in ``finetune.yaml``.

Call it in a checkout of OpenVLA-OFT, which stays as it is:

    WANDB_MODE=offline torchrun --standalone --nnodes 1 --nproc-per-node 8 DATA/finetune/run_openvla_oft.py

OFT always logs to Weights & Biases; offline it needs no account. With one, give ``--wandb_entity NAME --wandb_project
NAME`` instead. Further arguments go to OFT's ``vla-scripts/finetune.py`` and win over these, such as
``--dataset_name libero_perturbed_spatial`` for one suite, or ``--max_steps 20000``.

To continue for N steps from a checkpoint that was trained on LIBERO, saved at STEP in the folder CHECKPOINT, add

    --vla_path CHECKPOINT --statistics CHECKPOINT/dataset_statistics.json --resume True --resume_step STEP
    --max_steps STEP+N

Its action head, which OFT loads only with ``--resume``, gives actions in units of its own statistics; with others, the
same outputs would be other movements. Warm-up and cosine go from STEP to the last step. Without ``--statistics``, the
statistics are those of these datasets, and a resumed run goes on within its own cosine.

To train on LIBERO's sets too, link both into one folder, and name each set with its weight, which OFT multiplies by the
set's steps, as it does the 1 of these:

    --data_root_dir MIX --mix libero_goal_no_noops=1 --mix libero_10_no_noops=0.5

OFT's evaluation has one entry of statistics a suite, ``libero_goal``, and takes ``libero_goal_no_noops`` only without
it. So all sets of a suite get the same: those of ``--statistics``, else of the first, which is of these datasets where
they have the suite. LIBERO's sets have no split ``val``: leave out ``--use_val_set True``.

What OFT has no flag for is done here: the datasets and their mixture are registered, AdamW gets the settings' weight
decay (OFT leaves PyTorch's 0.01), a cosine with warm-up takes the place of OFT's step (whose own warm-up would undo
any later decay), the statistics of a checkpoint are also named by suite, which is where OFT's evaluation looks, and
the statistics that OFT computes first are not written among the dataset's files.
"""

import argparse
import importlib
import json
import math
import re
import runpy
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SCRIPT = "vla-scripts/finetune.py"
DATASETS = "prismatic.vla.datasets.rlds"


def mixed(text: str) -> tuple[str, float]:
    """One of LIBERO's sets and its weight, of a text such as ``libero_goal_no_noops=0.5``."""
    match = re.fullmatch(r"(libero_\w+_no_noops)=(\d+\.?\d*|\.\d+)", text)
    if match is None or not float(match[2]):
        raise argparse.ArgumentTypeError(f"{text!r}, expected a set of LIBERO and a weight: libero_goal_no_noops=1")
    return match[1], float(match[2])


def register(mixtures: Mapping[str, Mapping[str, float]], added: Mapping[str, float]) -> None:
    """Enter every dataset, and every mixture of them, where OFT looks datasets up by name.

    Args:
        mixtures: name of a mixture to its datasets, each with its weight.
        added: LIBERO's sets, which come after the others in each mixture and beside each dataset.
    """
    configs = importlib.import_module(f"{DATASETS}.oxe.configs")
    transforms = importlib.import_module(f"{DATASETS}.oxe.transforms")
    named = importlib.import_module(f"{DATASETS}.oxe.mixtures").OXE_NAMED_MIXTURES
    for mixture, weights in mixtures.items():
        named[mixture] = [*weights.items(), *added.items()]
        for dataset in weights:
            named.setdefault(dataset, [(dataset, 1.0), *added.items()])
        for dataset in (*weights, *added):
            transforms.OXE_STANDARDIZATION_TRANSFORMS[dataset] = transforms.libero_dataset_transform
            configs.OXE_DATASET_CONFIGS[dataset] = {
                "image_obs_keys": {"primary": "image", "secondary": None, "wrist": "wrist_image"},
                "depth_obs_keys": {"primary": None, "secondary": None, "wrist": None},
                # Made by the transform: position and axis-angle (which OFT calls Euler), and two fingers.
                "state_obs_keys": ["EEF_state", "gripper_state"],
                "state_encoding": configs.StateEncoding.POS_EULER,
                "action_encoding": configs.ActionEncoding.EEF_POS,
            }


def name_statistics_by_suite(suites: Mapping[str, str]) -> None:
    """Store each dataset's statistics under its suite's name too: OFT's evaluation knows no other."""
    module: Any = importlib.import_module(f"{DATASETS}.utils.data_utils")
    save = module.save_dataset_statistics

    def save_with_suites(statistics: Mapping[str, Any], folder: Path) -> None:
        by_suite = {suite: statistics[name] for suite, name in suites.items() if name in statistics}
        save({**statistics, **by_suite}, folder)

    module.save_dataset_statistics = save_with_suites


def statistics_of(file: Path, suites: Collection[str]) -> dict[str, dict[str, Any]]:
    """Suites to a checkpoint's statistics of actions and proprioception, as far as it has them."""
    stored = json.loads(file.read_text())
    former = {}
    for suite in suites:
        # Published checkpoints name LIBERO's sets without no-ops.
        key = next((key for key in (f"{suite}_no_noops", suite) if key in stored), None)
        if key is not None:
            former[suite] = {part: stored[key][part] for part in ("action", "proprio")}
    if not former:
        sys.exit(f"error: {file} has no statistics for {' or '.join(suites)}\n  it has: {', '.join(stored)}")
    return former


def set_statistics(dataset_sha256: str, suite_of: Mapping[str, str], former: Mapping[str, Mapping[str, Any]]) -> None:
    """Have all datasets of a suite normalised alike, and OFT's loader write what it computes to its cache folder.

    ``dataset_statistics_<hash>.json`` would change the dataset's files. OFT takes it for another run's where sizes and
    counts are the same, so the manifest's hash goes into its name.

    Args:
        suite_of: dataset to suite.
        former: suite to the statistics that take the place of a dataset's own; its counts, by which OFT weighs it,
            stay. Without any, the first dataset of a suite gives those of the others.
    """
    # The module that calls the function; it has imported it by name.
    module: Any = importlib.import_module(f"{DATASETS}.dataset")
    compute = module.get_dataset_statistics
    folder = Path.home() / ".cache" / "orca"  # where OFT itself writes when it may not write to the dataset
    folder.mkdir(parents=True, exist_ok=True)
    shared = dict(former)

    def get_dataset_statistics(dataset: Any, hash_dependencies: tuple[str, ...], save_dir: object = None) -> Any:
        own = compute(dataset, (*hash_dependencies, dataset_sha256), save_dir=str(folder))
        # OFT passes the folder of the dataset's version.
        name = Path(str(save_dir)).parent.name
        suite = suite_of.get(name, name)
        if former and suite not in former:
            sys.exit(f"error: the given statistics have none for {suite}\n  they have: {', '.join(former)}")
        counts = {part: number for part, number in own.items() if part.startswith("num_")}
        return {**shared.setdefault(suite, own), **counts}

    module.get_dataset_statistics = get_dataset_statistics


@dataclass(frozen=True)
class Schedule:
    """The learning rate: a linear warm-up, then a cosine that ends at 0 with the last step.

    Attributes:
        steps: from the first run on where training is resumed.
        warmup_steps: how many of them rise to the full rate.
        first: the step that this run begins with.
    """

    steps: int
    warmup_steps: int
    first: int = 0

    def share(self, step: int) -> float:
        """The share of the full rate at a step of this run, the first of which is 0."""
        step += self.first
        if step < self.warmup_steps:
            return (step + 1) / self.warmup_steps
        done = (step - self.warmup_steps) / max(self.steps - self.warmup_steps, 1)
        return (1 + math.cos(math.pi * min(done, 1.0))) / 2


def read_schedule(words: Sequence[str], steps: int, warmup_steps: int, *, anew: bool = False) -> Schedule:
    """The recipe's schedule, by the steps, the warm-up and the resumed step among OFT's arguments.

    Args:
        words: arguments of OFT's script.
        steps: the recipe's, for want of ``--max_steps``.
        warmup_steps: the recipe's; without ``--lr_warmup_steps`` the same share of the schedule's steps.
        anew: whether the resumed checkpoint is of another training, so that the schedule begins with it.

    Raises:
        SystemExit: with words, when nothing is resumed although ``anew``, or OFT would never stop.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--max_steps", type=int, default=steps)
    parser.add_argument("--lr_warmup_steps", type=int)
    yaml: Any = importlib.import_module("yaml")  # as OFT reads its booleans
    parser.add_argument("--resume", type=yaml.safe_load, default=False)
    parser.add_argument("--resume_step", type=int, default=0)
    given, _ = parser.parse_known_args(words)
    first = given.resume_step if given.resume else 0
    if anew and not first:
        sys.exit(
            "error: --statistics without --resume: OFT would begin with a new action head\n"
            "  try: --vla_path CHECKPOINT --resume True --resume_step STEP --max_steps STEP+N"
        )
    if first >= given.max_steps:
        sys.exit(
            f"error: --resume_step {first} is not below --max_steps {given.max_steps}, at which OFT stops\n"
            f"  try: --max_steps {first + steps} for {steps} more"
        )
    steps_here = given.max_steps - first if anew else given.max_steps
    warmup = steps_here * warmup_steps // steps if given.lr_warmup_steps is None else given.lr_warmup_steps
    return Schedule(steps_here, warmup, 0 if anew else first)


def set_optimiser(weight_decay: float, schedule: Schedule) -> None:
    """Have OFT's script find the recipe's optimiser and schedule where it looks for ``AdamW`` and ``MultiStepLR``."""
    import torch  # takes seconds, which a call in the wrong folder need not wait for

    class AdamW(torch.optim.AdamW):
        def __init__(self, params: Any, lr: float) -> None:
            super().__init__(params, lr=lr, weight_decay=weight_decay)

    class Cosine(torch.optim.lr_scheduler.LambdaLR):
        def __init__(self, optimizer: torch.optim.Optimizer, **_: object) -> None:
            super().__init__(optimizer, schedule.share)

    optim: Any = torch.optim
    optim.AdamW, optim.lr_scheduler.MultiStepLR = AdamW, Cosine


def arguments(recipe: Mapping[str, Any]) -> list[str]:
    """The recipe as arguments of OFT's script."""
    training = {name: field["value"] for name, field in recipe["training"].items()}
    flags = {
        "vla_path": training["base_weights"],
        "data_root_dir": HERE.parent / "rlds",
        "dataset_name": recipe["name"],
        "batch_size": training["batch_size_per_gpu"],
        "learning_rate": training["learning_rate"],
        "num_steps_before_decay": training["steps"],
        "max_steps": training["steps"],
        "use_l1_regression": training["action_head"] == "l1_regression",
        "use_diffusion": False,
        "use_film": False,
        "num_images_in_input": training["images"],
        "use_proprio": training["proprioception"],
        "image_aug": training["image_augmentation"],
        "lora_rank": training["lora_rank"],
        "shuffle_buffer_size": training["shuffle_buffer"],
    }
    return [word for name, value in flags.items() for word in (f"--{name}", str(value))]


def prepare() -> None:
    """Give OFT the recipe: its arguments, and all that it has no flag for."""
    yaml: Any = importlib.import_module("yaml")
    recipe = yaml.safe_load((HERE / "finetune.yaml").read_text())
    dataset, training = recipe["dataset"], recipe["training"]
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--statistics", type=Path)
    parser.add_argument("--mix", type=mixed, action="append", default=[])
    own, given = parser.parse_known_args()
    added, suites = dict(own.mix), dataset["suites"]["value"]
    suite_of = {name: suite for suite, name in suites.items()}
    suite_of |= {name: name.removesuffix("_no_noops") for name in added}
    schedule = read_schedule(
        given, training["steps"]["value"], training["warmup_steps"]["value"], anew=own.statistics is not None
    )
    # OFT takes its constants (chunk of 8, 7 actions, 8 of proprioception) from the word "libero" among the arguments.
    # Of two values the last counts; a warm-up of OFT's own would undo the cosine, so there is none.
    sys.argv = [SCRIPT, *arguments(recipe), *given, "--lr_warmup_steps", "0"]
    register(dataset["mixtures"]["value"], added)
    name_statistics_by_suite(suites)
    former = statistics_of(own.statistics, dict.fromkeys(suite_of.values())) if own.statistics else {}
    set_statistics(dataset["sha256"]["value"], suite_of, former)
    set_optimiser(training["weight_decay"]["value"], schedule)


def main() -> None:
    if not Path(SCRIPT).is_file():
        sys.exit(f"error: no {SCRIPT} in {Path.cwd()}\n  try: call this in a checkout of OpenVLA-OFT")
    try:
        prepare()
    except ModuleNotFoundError as error:
        sys.exit(
            f"error: {sys.executable} has no module {error.name}\n"
            "  try: activate the environment of OpenVLA-OFT (its SETUP.md), and call torchrun there"
        )
    runpy.run_path(SCRIPT, run_name="__main__")


if __name__ == "__main__":
    main()
