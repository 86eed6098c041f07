"""Command ``focus``, which prints one line of JSON last."""

import json
from pathlib import Path

import click

from pipeline.commands.base import FILE_TO_WRITE, PATH, Command, example, result_paths_argument


@click.command(
    cls=Command,
    epilog=example(
        "focus results/act --from configs/joint.yaml --out configs/joint_focused.yaml",
        "focus results/act results/vla_eval --from configs/small.yaml --out configs/second.yaml --episodes 500",
    ),
)
@result_paths_argument
@click.option("--from", "source", metavar="CONFIG", required=True, type=PATH, help="Configuration to start from.")
@click.option(
    "--out",
    metavar="FILE",
    required=True,
    type=FILE_TO_WRITE,
    help="New configuration; its name, without .yaml, becomes the name of the run.",
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
    type=click.FloatRange(0, 1),
    default=0.5,
    help="Smallest share, as a multiple of the share in CONFIG (default: 0.5).",
)
@click.option(
    "--cap",
    metavar="X",
    type=click.FloatRange(1, 100),
    default=2.0,
    help="Largest share, as a multiple of the share in CONFIG (default: 2).",
)
def focus(results: tuple[Path, ...], source: Path, out: Path, episodes: int | None, floor: float, cap: float) -> None:
    """Write a configuration with more episodes for the axes, levels and tasks that policies fail in.

    A new share is the share in CONFIG times the rate of failures, from floor to cap. The rate of an axis, level or task
    with few results is close to the mean rate. The command prints the reason of each share, and writes it into the
    file, without the comments of CONFIG. Results of vla-eval and lerobot-eval count for LIBERO-Plus's test tasks only.
    The last line of the output is JSON.
    """
    from pipeline.evaluation.analyses import focus as focusing

    limits = focusing.Limits(floor, cap)
    focused = focusing.write(results, source, out, episodes, limits)
    print("\n".join("  ".join(row).rstrip() for row in focusing.table(focused.reasons)))
    counted = ", ".join(f"{policy} ({number})" for policy, number in focused.policies.items())
    print(f"counted episodes: {counted}; left out, of other tasks, axes or levels: {focused.left_out}")
    # The reasons are in the table above, and in the file.
    print(json.dumps({"file": str(out), **{name: value for name, value in vars(focused).items() if name != "reasons"}}))
