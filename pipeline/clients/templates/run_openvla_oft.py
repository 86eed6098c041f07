"""Fine-tuning of OpenVLA-OFT on the datasets next to this folder, with the settings in ``finetune.yaml``.

Call this script in a checkout of OpenVLA-OFT. It does not change the checkout:

    WANDB_MODE=offline torchrun --standalone --nnodes 1 --nproc-per-node 8 DATA/finetune/run_openvla_oft.py

OFT always logs to Weights & Biases; offline logging needs no account. With an account, give ``--wandb_entity NAME
--wandb_project NAME`` instead. Further arguments are passed to OFT's ``vla-scripts/finetune.py`` and override the
settings. Examples are ``--dataset_name libero_perturbed_spatial`` for one suite, and ``--max_steps 20000``.

A checkpoint that was trained on LIBERO and saved at STEP in the folder CHECKPOINT can be trained for N more steps. Add

    --vla_path CHECKPOINT --statistics CHECKPOINT/dataset_statistics.json --resume True --resume_step STEP
    --max_steps STEP+N

OFT loads the checkpoint's action head only with ``--resume``. The head gives actions in units of the checkpoint's own
statistics; with different statistics, equal outputs would be different movements. Warm-up and cosine run from STEP to
the last step. Without ``--statistics``, these datasets' statistics are used, and a resumed run continues its cosine.
OFT saves a checkpoint at multiples of ``--save_freq``, by default 10000, and not at the last step. Therefore choose
``STEP+N`` or ``--save_freq`` so that the last step is a multiple.

To train on LIBERO's datasets too, link both into one folder, and name each of LIBERO's datasets with its weight. OFT
multiplies each weight by the dataset's number of steps. The datasets of this run have the weight 1:

    --data_root_dir MIX --mix libero_goal_no_noops=1 --mix libero_10_no_noops=0.5

Each training sample gets one of its episode's rewrites in place of the instruction, with the probability
``rewrite_probability`` of the settings. It is 0 if the run's configuration does not set it; ``--rewrite_probability P``
overrides it. Validation and LIBERO's own datasets keep their instructions.

To train on a part of the episodes, choose them by the labels ``axis``, ``component`` and ``level``. An episode has to
have a listed value of each named label. Clean episodes have the axis ``clean`` and level 0. An episode of several axes
needs all its components and levels in the lists:

    --where axis=clean,camera,camera+noise --where level=0,1,2

Statistics are of the chosen episodes. LIBERO's own datasets are read completely.

OFT's evaluation reads one entry of statistics per suite, ``libero_goal``. It reads ``libero_goal_no_noops`` only if
``libero_goal`` is missing. Therefore all datasets of a suite get equal statistics: the statistics of ``--statistics``,
else those of the suite's first dataset. The first is a dataset of this run if the run has the suite. LIBERO's datasets
have no split ``val``: leave out ``--use_val_set True``.

VLA-Adapter has OFT's loader, and a ``vla-scripts/finetune.py`` with other options for its weights. In its checkout, add
``--client vla_adapter`` and the options of ``finetune.yaml``. Its optimizer and schedule stay as they are. With
``--resume`` it loads only the action head and the projector of a checkpoint, so ``--statistics`` is for OFT.

OFT has no flags for the following settings, so this script applies them:

* The datasets and their mixture are registered.
* The reader leaves out the episodes that ``--where`` does not choose.
* The rewrites of an episode pass through OFT's loader together with the instruction, and one is sampled per sample.
* AdamW gets the settings' weight decay (OFT leaves PyTorch's 0.01).
* A cosine with warm-up replaces OFT's step, because OFT's own warm-up would undo any later decay.
* The statistics of a checkpoint are stored under suite names too, because OFT's evaluation looks them up by suite.
* The statistics that OFT computes first are not written into the dataset's folder.
"""

import argparse
import importlib
import json
import math
import os
import random
import re
import runpy
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
OFT = "openvla_oft"
SCRIPT = "vla-scripts/finetune.py"
DATASETS = "prismatic.vla.datasets.rlds"
LABELS = ("axis", "component", "level")
"""Labels of ``--where``."""


def mixed(text: str) -> tuple[str, float]:
    """Parse the name of a LIBERO dataset and its weight from a text such as ``libero_goal_no_noops=0.5``."""
    match = re.fullmatch(r"(libero_\w+_no_noops)=(\d+\.?\d*|\.\d+)", text)
    if match is None or not float(match[2]):
        raise argparse.ArgumentTypeError(f"{text!r}, expected a set of LIBERO and a weight: libero_goal_no_noops=1")
    return match[1], float(match[2])


def condition(text: str) -> tuple[str, tuple[str, ...]]:
    """Parse a label and its values from a text such as ``axis=clean,camera``."""
    label, _, values = text.partition("=")
    listed = tuple(value.strip() for value in values.split(","))
    if label not in LABELS or not all(listed):
        raise argparse.ArgumentTypeError(
            f"{text!r}, expected values of {', '.join(LABELS)}, such as axis=clean,camera,camera+noise"
        )
    return label, listed


def join_conditions(
    given: Sequence[tuple[str, tuple[str, ...]]], offered: Mapping[str, Collection[str]]
) -> dict[str, tuple[str, ...]]:
    """Join the conditions on each label, and sort the axes in the names of combinations as the datasets do.

    Args:
        given: results of ``condition``.
        offered: label to the values that episodes of this run have.

    Raises:
        SystemExit: if no episode has one of the values.
    """
    by_parts = {tuple(sorted(name.split("+"))): name for name in offered["axis"]}
    conditions: dict[str, tuple[str, ...]] = {}
    for label, values in given:
        named = [by_parts.get(tuple(sorted(value.split("+"))), value) if label == "axis" else value for value in values]
        unknown = [value for value in named if value not in offered[label]]
        if unknown:
            sys.exit(
                f"error: no episode has the {label} {', '.join(unknown)}\n"
                f"  they have: {', '.join(sorted(offered[label]))}"
            )
        conditions[label] = (*conditions.get(label, ()), *named)
    return conditions


def register(mixtures: Mapping[str, Mapping[str, float]], added: Mapping[str, float]) -> None:
    """Register every dataset and every mixture in the tables from which OFT reads datasets by name.

    Args:
        mixtures: name of a mixture to its datasets, each with its weight.
        added: LIBERO's datasets, each with its weight. They are added to the end of each mixture and of each single
            dataset.
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
                # The transform makes these keys: position and axis-angle (which OFT calls Euler), and two fingers.
                "state_obs_keys": ["EEF_state", "gripper_state"],
                "state_encoding": configs.StateEncoding.POS_EULER,
                "action_encoding": configs.ActionEncoding.EEF_POS,
            }


def choose_episodes(datasets: Collection[str], conditions: Mapping[str, Collection[str]]) -> None:
    """Make OFT's loader read only the episodes of these datasets whose labels meet all conditions.

    Args:
        datasets: datasets of this run; others are read completely.
        conditions: result of ``join_conditions``.
    """
    tf: Any = importlib.import_module("tensorflow")
    # OFT reads every split through this class.
    reader: Any = importlib.import_module("dlimp").DLataset
    read = reader.from_rlds

    def is_chosen(trajectory: dict[str, Any]) -> Any:
        labels = trajectory["traj_metadata"]["episode_metadata"]
        met = []
        for label, values in conditions.items():
            # OFT's reader repeats each label for every step.
            text = labels[label][0]
            parts = text[None] if label == "axis" else tf.strings.split(text, "+")
            met.append(tf.reduce_all(tf.reduce_any(parts[:, None] == tf.constant(list(values)), axis=1)))
        return tf.reduce_all(met)

    def read_chosen(builder: Any, split: str, **options: Any) -> Any:
        episodes = read(builder, split=split, **options)
        if builder.name not in datasets:
            return episodes
        chosen = episodes.filter(is_chosen)
        # From no episodes, OFT would wait for its first sample without end.
        if next(iter(chosen.take(1)), None) is None:
            wanted = " and ".join(f"{label}={','.join(values)}" for label, values in conditions.items())
            sys.exit(
                f"error: no episode of {builder.name}, split {split}, has {wanted}\n"
                "  try: other values of --where, or --dataset_name for the dataset of one suite"
            )
        return chosen

    reader.from_rlds = staticmethod(read_chosen)


class SampledRewrites:
    """A transform of OFT's samples that first replaces the instruction by one of the episode's rewrites.

    Args:
        transform: OFT's own transform of a sample.
        probability: probability of a replacement.
        key: key of the samples' random choices.
    """

    def __init__(self, transform: Callable[[dict[str, Any]], Any], probability: float, key: str) -> None:
        self.transform = transform
        self.probability = probability
        self.generator = random.Random(key)

    def __call__(self, sample: dict[str, Any]) -> Any:
        """Transform a sample whose text has the instruction in the first line, and a rewrite in each further line."""
        instruction, *rewrites = sample["task"]["language_instruction"].split(b"\n")
        if rewrites and self.generator.random() < self.probability:
            instruction = self.generator.choice(rewrites)
        task = {**sample["task"], "language_instruction": instruction}
        return self.transform({**sample, "task": task})


def sample_rewrites(datasets: Collection[str], probability: float, key: str) -> None:
    """Make OFT's loader pass the rewrites of these datasets on, and sample one for each training sample.

    OFT's loader keeps no metadata of an episode but the instruction of each step. Therefore the instruction and the
    rewrites pass through the loader as the lines of one text.

    Args:
        datasets: datasets that ``register`` has registered.
        probability: probability of a replacement; 0 in validation.
        key: key of the samples' random choices.
    """
    tf: Any = importlib.import_module("tensorflow")
    transforms = importlib.import_module(f"{DATASETS}.oxe.transforms")

    # OFT names its stored statistics after the source text of this function.
    def with_rewrites(trajectory: dict[str, Any]) -> dict[str, Any]:
        # OFT's reader repeats each entry of the metadata for every step.
        rewrites = trajectory["traj_metadata"]["episode_metadata"]["rewrites"]
        rows = tf.reshape(rewrites, [-1, tf.shape(trajectory["action"])[0]])
        lines = tf.concat([trajectory["language_instruction"][None], rows], axis=0)
        text = tf.strings.reduce_join(lines, axis=0, separator="\n")
        return {**transforms.libero_dataset_transform(trajectory), "language_instruction": text}

    for dataset in datasets:
        transforms.OXE_STANDARDIZATION_TRANSFORMS[dataset] = with_rewrites
    package: Any = importlib.import_module(DATASETS.rpartition(".")[0])
    loader = package.RLDSDataset

    class RLDSDataset(loader):  # type: ignore[misc, valid-type]
        def __init__(self, root: Path, mix: str, transform: Any, *words: Any, train: bool = True, **options: Any):
            sampled = SampledRewrites(transform, probability if train else 0.0, key)
            super().__init__(root, mix, sampled, *words, train=train, **options)

    package.RLDSDataset = RLDSDataset


def probability_of(text: str) -> float:
    """Parse a probability.

    Raises:
        argparse.ArgumentTypeError: if the text is no number from 0 to 1.
    """
    try:
        probability = float(text)
    except ValueError:
        probability = math.nan
    if not 0 <= probability <= 1:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a probability from 0 to 1")
    return probability


def name_statistics_by_suite(suites: Mapping[str, str]) -> None:
    """Store each dataset's statistics under its suite's name too: OFT's evaluation reads no other name."""
    module: Any = importlib.import_module(f"{DATASETS}.utils.data_utils")
    save = module.save_dataset_statistics

    def save_with_suites(statistics: Mapping[str, Any], folder: Path) -> None:
        by_suite = {suite: statistics[name] for suite, name in suites.items() if name in statistics}
        save({**statistics, **by_suite}, folder)

    module.save_dataset_statistics = save_with_suites


def statistics_of(file: Path, suites: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return suite to a checkpoint's statistics of actions and proprioception, for the suites in the file.

    Raises:
        SystemExit: if the file has statistics for none of the suites.
    """
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


def set_statistics(content: str, suite_of: Mapping[str, str], former: Mapping[str, Mapping[str, Any]]) -> None:
    """Make OFT normalise all datasets of a suite alike and write the statistics it computes to its cache folder.

    In the dataset's folder, ``dataset_statistics_<hash>.json`` would change the dataset's files. OFT confuses the
    files of two runs with equal sizes and counts, and of two choices of episodes. Therefore ``content`` becomes part of
    the file's name.

    Args:
        content: text that identifies the episodes: the manifest's hash, and the conditions of ``choose_episodes``.
        suite_of: dataset to suite.
        former: suite to the statistics that replace a dataset's own. The dataset keeps its own counts, which OFT uses
            as weights. If empty, the statistics of a suite's first dataset replace those of the suite's other datasets.
    """
    # This module calls the function; it has imported the function by name.
    module: Any = importlib.import_module(f"{DATASETS}.dataset")
    compute = module.get_dataset_statistics
    folder = Path.home() / ".cache" / "orca"  # OFT's own choice if the dataset's folder is read-only
    folder.mkdir(parents=True, exist_ok=True)
    shared = dict(former)

    def get_dataset_statistics(dataset: Any, hash_dependencies: tuple[str, ...], save_dir: object = None) -> Any:
        computed = compute(dataset, (*hash_dependencies, content), save_dir=str(folder))
        # OFT passes the folder of the dataset's version.
        name = Path(str(save_dir)).parent.name
        suite = suite_of.get(name, name)
        if former and suite not in former:
            sys.exit(f"error: the given statistics have none for {suite}\n  they have: {', '.join(former)}")
        counts = {part: number for part, number in computed.items() if part.startswith("num_")}
        return {**shared.setdefault(suite, computed), **counts}

    module.get_dataset_statistics = get_dataset_statistics


@dataclass(frozen=True)
class Schedule:
    """Schedule of the learning rate: a linear warm-up, then a cosine that ends at 0 with the last step.

    Attributes:
        steps: number of steps, counted from the first run if training is resumed.
        warmup_steps: number of steps in which the rate rises to the full rate.
        first: the step that this run begins with.
    """

    steps: int
    warmup_steps: int
    first: int = 0

    def share(self, step: int) -> float:
        """Return the share of the full rate at a step of this run; this run's first step is 0."""
        step += self.first
        if step < self.warmup_steps:
            return (step + 1) / self.warmup_steps
        done = (step - self.warmup_steps) / max(self.steps - self.warmup_steps, 1)
        return (1 + math.cos(math.pi * min(done, 1.0))) / 2


def read_schedule(words: Sequence[str], steps: int, warmup_steps: int, *, restart: bool = False) -> Schedule:
    """Return the recipe's schedule with the steps, the warm-up and the resumed step from OFT's arguments.

    Args:
        words: arguments of OFT's script.
        steps: the recipe's number of steps, used without ``--max_steps``.
        warmup_steps: the recipe's number of warm-up steps. Without ``--lr_warmup_steps``, the schedule has the
            recipe's ratio of warm-up steps to steps.
        restart: True if the resumed checkpoint comes from another training, so that the schedule begins with it.

    Raises:
        SystemExit: with a message, if ``restart`` is set but nothing is resumed, or if OFT would never stop.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--max_steps", type=int, default=steps)
    parser.add_argument("--lr_warmup_steps", type=int)
    yaml: Any = importlib.import_module("yaml")  # OFT parses its booleans with YAML
    parser.add_argument("--resume", type=yaml.safe_load, default=False)
    parser.add_argument("--resume_step", type=int, default=0)
    given, _ = parser.parse_known_args(words)
    first = given.resume_step if given.resume else 0
    if restart and not first:
        sys.exit(
            "error: --statistics without --resume: OFT would begin with a new action head\n"
            "  try: --vla_path CHECKPOINT --resume True --resume_step STEP --max_steps STEP+N"
        )
    if first >= given.max_steps:
        sys.exit(
            f"error: --resume_step {first} is not below --max_steps {given.max_steps}, at which OFT stops\n"
            f"  try: --max_steps {first + steps} for {steps} more"
        )
    steps_here = given.max_steps - first if restart else given.max_steps
    warmup = steps_here * warmup_steps // steps if given.lr_warmup_steps is None else given.lr_warmup_steps
    return Schedule(steps_here, warmup, 0 if restart else first)


def set_optimiser(weight_decay: float, schedule: Schedule) -> None:
    """Replace ``AdamW`` and ``MultiStepLR``, which OFT's script imports, by the recipe's optimiser and schedule."""
    import torch  # takes seconds; a call in the wrong folder fails before this import

    class AdamW(torch.optim.AdamW):
        def __init__(self, params: Any, lr: float) -> None:
            super().__init__(params, lr=lr, weight_decay=weight_decay)

    class Cosine(torch.optim.lr_scheduler.LambdaLR):
        def __init__(self, optimizer: torch.optim.Optimizer, **_: object) -> None:
            super().__init__(optimizer, schedule.share)

    optim: Any = torch.optim
    optim.AdamW, optim.lr_scheduler.MultiStepLR = AdamW, Cosine


def arguments(recipe: Mapping[str, Any], client: str) -> list[str]:
    """Return the recipe as arguments of the client's script."""
    training = {name: field["value"] for name, field in recipe["training"].items()}
    flags = {"vla_path": training["base_weights"]} if client == OFT else {}
    flags |= {
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
    words: list[str] = []
    for name, value in flags.items():
        words += [f"--{name}", str(value)]
    return words


def prepare() -> None:
    """Give OFT the recipe: arguments, and the settings for which OFT has no flag."""
    yaml: Any = importlib.import_module("yaml")
    recipe = yaml.safe_load((HERE / "finetune.yaml").read_text())
    dataset, training = recipe["dataset"], recipe["training"]
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--client", choices=[OFT, "vla_adapter"], default=OFT)
    parser.add_argument("--statistics", type=Path)
    parser.add_argument("--mix", type=mixed, action="append", default=[])
    parser.add_argument("--where", type=condition, action="append", default=[])
    rewrite_probability = training.get("rewrite_probability", {"value": 0.0})["value"]
    parser.add_argument("--rewrite_probability", type=probability_of, default=rewrite_probability)
    options, given = parser.parse_known_args()
    if options.statistics and options.client != OFT:
        sys.exit(f"error: --statistics is for {OFT}: {options.client} does not resume from a whole checkpoint")
    added, suites = dict(options.mix), dataset["suites"]["value"]
    suite_of = {name: suite for suite, name in suites.items()}
    suite_of |= {name: name.removesuffix("_no_noops") for name in added}
    schedule = read_schedule(
        given, training["steps"]["value"], training["warmup_steps"]["value"], restart=options.statistics is not None
    )
    # OFT derives its constants (chunk of 8, 7 actions, 8 of proprioception) from the word "libero" in the arguments.
    # If a flag is given twice, its last value counts.
    sys.argv = [SCRIPT, *arguments(recipe, options.client), *given]
    register(dataset["mixtures"]["value"], added)
    if options.rewrite_probability:
        key = f"process {os.environ.get('RANK', '0')}, from step {schedule.first}"
        sample_rewrites({*suites.values()}, options.rewrite_probability, key)
    name_statistics_by_suite(suites)
    former = statistics_of(options.statistics, dict.fromkeys(suite_of.values())) if options.statistics else {}
    content = dataset["sha256"]["value"]
    if options.where:
        conditions = join_conditions(options.where, dataset["labels"]["value"])
        choose_episodes({*suites.values()}, conditions)
        content += json.dumps(conditions)
    set_statistics(content, suite_of, former)
    if options.client == OFT:
        # OFT's own warm-up would undo the cosine.
        sys.argv += ["--lr_warmup_steps", "0"]
        set_optimiser(training["weight_decay"]["value"], schedule)


def main() -> None:
    """Run OFT's script with the recipe, or end with a message if OFT cannot be imported."""
    if not Path(SCRIPT).is_file():
        sys.exit(f"error: no {SCRIPT} in {Path.cwd()}\n  try: call this in a checkout of OpenVLA-OFT or VLA-Adapter")
    try:
        prepare()
    except ModuleNotFoundError as error:
        sys.exit(
            f"error: {sys.executable} has no module {error.name}\n"
            "  try: activate the environment of OpenVLA-OFT (its SETUP.md) or VLA-Adapter, and call torchrun there"
        )
    runpy.run_path(SCRIPT, run_name="__main__")


if __name__ == "__main__":
    main()
