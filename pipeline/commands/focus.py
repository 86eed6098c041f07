"""Command ``focus``, which prints one line of JSON last."""

import json
from pathlib import Path

import click

from pipeline.commands.base import PATH, Command, example


@click.command(
    cls=Command,
    epilog=example(
        "focus results/act --from configs/joint.yaml --out configs/joint_focused.yaml",
        "focus results/act results/vla_eval --from configs/small.yaml --out configs/second.yaml --episodes 500",
    ),
)
@click.argument(
    "results",
    metavar="PATH...",
    nargs=-1,
    required=True,
    type=PATH,
    help="Folders of `evaluate`; folders or files of vla-eval (*_aggregate.json) and lerobot-eval (eval_info.json).",
)
@click.option("--from", "source", metavar="CONFIG", required=True, type=PATH, help="Configuration to start from.")
@click.option(
    "--out",
    metavar="FILE",
    required=True,
    type=PATH,
    help="Configuration to write; its name, without .yaml, becomes the name of the run.",
)
@click.option(
    "--episodes",
    metavar="N",
    type=click.IntRange(min=1),
    help="Total number of perturbed episodes (default: that of CONFIG).",
)
@click.option(
    "--floor",
    metavar="X",
    type=float,
    default=0.5,
    help="Smallest share, as a multiple of the share in CONFIG (default: 0.5).",
)
@click.option(
    "--cap",
    metavar="X",
    type=float,
    default=2.0,
    help="Largest share, as a multiple of the share in CONFIG (default: 2).",
)
def focus(results: tuple[Path, ...], source: Path, out: Path, episodes: int | None, floor: float, cap: float) -> None:
    """Write a configuration with more episodes for the axes, levels and tasks that policies fail in.

    A new share is the share in CONFIG times the rate of failures, from floor to cap. The rate of an axis, level or task
    with few results is close to the mean rate. The command prints the reason of each share, and writes it into the
    file. The last line of the output is JSON.
    """
    from pipeline.evaluation import focus as focusing

    limits = focusing.Limits(floor, cap)
    focused = focusing.write(results, source, out, episodes, limits)
    print("\n".join("  ".join(row).rstrip() for row in focusing.table(focused.reasons)))
    changed = {"file": str(out), "episodes": focused.episodes, "levels": focused.levels}
    print(json.dumps({**changed, "task_weights": focused.task_weights}))
