"""Command ``evaluate``, which prints one line of JSON last."""

import json
from pathlib import Path
from typing import Any

import click
from dask.system import CPU_COUNT

from pipeline.commands.base import PATH, Command, example, given, model_options
from pipeline.compute.pool import runner
from pipeline.compute_config import ComputeConfig
from pipeline.evaluation.analyses.tested import tested_in
from pipeline.evaluation.environment import EpisodeSettings
from pipeline.evaluation.evaluate import evaluate as run_evaluation
from pipeline.evaluation.evaluation import Evaluation
from pipeline.evaluation.policy_config import PolicyConfig
from pipeline.evaluation.selection import Selection
from pipeline.report import paper_rows
from pipeline.report.paper_table import table_of
from pipeline.run import claim

TRAINED_ON = "Configuration of the policy's training data; held-out perturbations that overlap with it are resampled."


@click.command(
    cls=Command,
    epilog=example(
        "evaluate results/act --checkpoint data/act --source libero_plus --subset 100",
        "evaluate results/pi05 --server ws://localhost:8000 --label pi05",
    ),
)
@click.argument("out", metavar="DIR", type=PATH, help="Folder of the results.")
@click.option("--server", metavar="URL", help="Address of a model server, such as ws://localhost:8000.")
@click.option("--checkpoint", metavar="DIR", type=PATH, help="Folder of a policy that lerobot saved.")
@click.option(
    "--replay",
    is_flag=False,
    flag_value="open_loop",
    type=click.Choice(("open_loop", "tracked")),
    help="Replay the demonstrations in place of a policy, as a check: open_loop (the default value) sends their own "
    "actions, tracked follows their paths by feedback.",
)
@model_options(
    Selection,
    source="--source",
    file="--tasks-from",
    suites="--suite",
    axes="--axis",
    components="--component",
    levels="--level",
    tasks="--task",
    subset="--subset",
    episodes="--episodes",
    seed="--seed",
)
@click.option("--trained-on", metavar="CONFIG", type=PATH, help=TRAINED_ON)
@model_options(
    EpisodeSettings,
    prompt="--prompt",
    step_limits="--step-limits",
    black="--black",
    initial_states="--initial-states",
    look_every="--look-every",
    state_angle="--state-angle",
    actions="--actions",
    own_step_limit="--own-step-limit",
)
@model_options(PolicyConfig, label="--label", timeout_s="--timeout")
@click.option(
    "--demos",
    metavar="DIR",
    type=PATH,
    help="Folder of demonstrations, <suite>/<task>_demo.hdf5, for --initial-states demonstration, --replay and "
    "held-out perturbations (default: the starter set).",
)
@click.option("--assets", metavar="DIR", type=PATH, help="Folder of the unpacked asset archive of LIBERO-Plus.")
@click.option(
    "--videos",
    type=click.Choice(("none", "failures", "all")),
    default="none",
    help="Episodes whose videos are stored (default: none).",
)
@click.option(
    "--workers", metavar="N", type=click.IntRange(min=1), help="Number of processes (default: one for each core)."
)
def evaluate(
    out: Path,
    server: str | None,
    checkpoint: Path | None,
    replay: str | None,
    trained_on: Path | None,
    assets: Path | None,
    videos: Any,
    workers: int | None,
    **options: Any,
) -> None:
    """Run a policy on LIBERO's tasks or your own, on LIBERO-Plus's test tasks or on held-out perturbations.

    The command writes a file for each episode into DIR. summary.json has the success rates of the episodes that this
    call selects, with their 95 % intervals. episodes.csv has the success of each episode of the policy with the same
    settings. The policy is a model server of vla-eval, which you start first, or a
    checkpoint of lerobot. A stopped evaluation resumes when the command is called again. For test tasks of LIBERO-Plus,
    the command prints the paper's table of this policy's results in DIR under these settings. It also writes the table
    into DIR as paper_table.md, .csv and .tex. The last line of the output is JSON.
    """
    policies = {"server": server, "checkpoint": checkpoint, "replay": replay}
    chosen = [name for name, value in policies.items() if value is not None]
    if len(chosen) != 1:
        raise click.UsageError("Expected exactly one of --server, --checkpoint and --replay.")
    (kind,) = chosen
    policy = {"kind": replay} if kind == "replay" else {"kind": kind, "address": str(policies[kind])}
    config = PolicyConfig.model_validate(policy | given(options, PolicyConfig))
    plan = {"plan": claim.open_run(trained_on).plan_file} if trained_on else {}
    settings = EpisodeSettings.model_validate(given(options, EpisodeSettings) | plan)
    evaluation = Evaluation(settings, config, config.identity(), out, videos=videos, archive=assets)
    table_path = out / "paper_table"
    paper_rows.reject_other_tables(table_path)
    number = workers or CPU_COUNT
    compute = ComputeConfig(cluster="loop" if number == 1 else "local", workers=number)
    with runner(compute, out, renders=True) as pool:
        summary = run_evaluation(evaluation, Selection.model_validate(given(options, Selection)), pool, number)
    _print_table(evaluation, table_path)
    print(json.dumps({"all": summary["all"], "refused": summary["refused"], "by_axis": summary["by_axis"]}))


def _print_table(evaluation: Evaluation, path: Path) -> None:
    """Print and write the paper's table of an evaluation's results on test tasks, if it has any."""
    tested = evaluation.test_results()
    if tested:
        found = table_of([tested_in(evaluation.policy.name(evaluation.identity), tested)])
        print(paper_rows.markdown(found))
        paper_rows.write_table(found, path)
