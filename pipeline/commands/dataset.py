"""Group ``dataset``: commands about the datasets of a finished run, or about one of another origin."""

import json
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import click

from pipeline.commands.base import (
    FILE_TO_WRITE,
    PATH,
    Command,
    LazyGroup,
    Listed,
    OneOf,
    config_argument,
    example,
    open_run,
)
from pipeline.errors import PipelineError

dataset = LazyGroup(
    "dataset",
    help="Check, audit, regenerate or push a dataset.",
    epilog=example("dataset check configs/starter.yaml", "dataset push lerobot me/my-dataset configs/starter.yaml"),
    sections={
        "Commands": {
            "check": Listed("dataset", "Compare the files of a run with their checksums."),
            "audit": Listed("dataset", "Measure how close any dataset comes to the test tasks."),
            "compare-frame": Listed("dataset", "Compare the first observation of your evaluation with ours."),
            "regenerate": Listed("dataset", "Generate one episode again, and compare it byte for byte."),
            "push": Listed("dataset", "Upload a dataset with its card to the Hugging Face hub."),
        }
    },
)


@click.command(cls=Command, epilog=example("dataset check configs/starter.yaml"))
@config_argument
def check(config: Path) -> int:
    """Compare the files of a run with their checksums, and read RLDS datasets as OpenVLA-OFT does.

    These are replays, frames, datasets, the fine-tuning recipes and the card. The plan, the manifest and the JSON
    reports are only read; other pictures and the report are not checked. Damaged and foreign files are listed, and
    faults that would mislead OpenVLA-OFT's training. The last line is JSON. The exit status is 1 if there is such a
    file or fault. Move a damaged file to another place, and the run generates it again. The stage validate, a part of
    every run, compares the datasets with each other and with the plan.
    """
    from pipeline.clients import oft
    from pipeline.run.layout import STATISTICS
    from pipeline.validation.verify import verify

    run = open_run(config)
    with run.workers() as workers:
        stored = verify(run, workers)
    damaged: list[str] = []
    for findings in stored.values():
        damaged += findings["damaged"]
    trained: dict[str, Any] = {}
    # OpenVLA-OFT's reader stops at damaged files.
    if "rlds" in run.config.export.formats and not stored["rlds"]["damaged"]:
        trained = oft.check_all(run.dataset("rlds").folder, run.path(STATISTICS), run.config.render.size_px)
    misleading: list[str] = []
    for name, findings in trained.items():
        misleading += [f"{name}: {violation}" for violation in findings["violations"]]
    for line in (*damaged, *misleading):
        print(line)
    print(json.dumps({**stored, "openvla_oft": trained}))
    return int(bool(damaged or misleading))


@click.command(cls=Command, epilog=example("dataset audit data/starter/lerobot"))
@click.argument("dataset", metavar="DATASET", type=PATH, help="Folder of an RLDS or LeRobot dataset of any origin.")
@click.option(
    "--manifest",
    metavar="FILE",
    type=PATH,
    help="Manifest with the labels of episodes that lost their labels and kept their episode_id.",
)
def audit(dataset: Path, manifest: Path | None) -> int:
    """Measure how close a dataset comes to the test tasks of the benchmark.

    The instruction of every episode is compared. Camera matrices of the agent view and labels of this project are
    compared if the dataset has them, even after it was edited, merged or filtered. Distances and the number of episodes
    without a comparison are printed as tables. The last line is JSON. The exit status is 1 if an episode overlaps with
    a test task.
    """
    from dataclasses import asdict

    import rich

    from pipeline.planning import leakage
    from pipeline.testset import benchmark
    from pipeline.validation import audit

    if not dataset.is_dir():
        # The benchmark's list of tests is downloaded at its first use.
        raise PipelineError("there is no such folder", where=dataset, expected="an RLDS or LeRobot dataset")
    result = audit.audit(dataset, benchmark.load(), manifest)
    rich.print(leakage.report(result.axes))
    if result.without_task:
        print(
            f"{result.without_task:,} of {result.episodes:,} episodes are of no task of LIBERO; for your own tasks, "
            "run in the folder that has tasks/"
        )
    for axis, number in result.unknown.items():
        print(f"{axis}: unknown for {number:,} of {result.episodes:,} episodes, without labels, text or a known task")
    print(json.dumps(asdict(result) | {"unknown": result.unknown}))
    return int(any(finding.overlaps for finding in result.axes.values()))


@click.command(
    "compare-frame", cls=Command, epilog=example("dataset compare-frame first.png libero_goal/turn_on_the_stove")
)
@click.argument("picture", metavar="PICTURE", type=PATH, help="PNG or JPEG file of the image that the policy gets.")
@click.argument("task", metavar="SUITE/TASK", help="Task of the evaluation, such as libero_goal/turn_on_the_stove.")
@click.option(
    "--init-state", metavar="K", type=click.IntRange(min=0), default=0, help="LIBERO's initial state (default: 0)."
)
@click.option(
    "--view",
    type=click.Choice(("agentview", "wrist")),
    default="agentview",
    help="View that the picture should show (default: agentview).",
)
@click.option(
    "--sheet", metavar="FILE", type=FILE_TO_WRITE, help="PNG file to write: picture, frame and their difference."
)
@click.option("--json", "as_json", is_flag=True, help="Print the report as one line of JSON.")
def compare_frame(picture: Path, task: str, init_state: int, view: str, sheet: Path | None, as_json: bool) -> int:
    """Compare the first observation of your own evaluation with the frame of the datasets.

    Save the image that the policy gets after LIBERO's reset, initial state K and ten settling steps. The command
    renders this frame and reports each difference with a remedy: size, rotation, colours, camera, MuJoCo's version,
    start and task. A difference is reported if its undoing fits, and no other view or orientation comes close. The exit
    status is 1 if the frames differ.
    """
    from contextlib import closing

    from pipeline.evaluation.first_observation import frame_report
    from pipeline.evaluation.first_observation.start_frames import LastStartFrames
    from pipeline.libero.tasks import find_task, select_tasks
    from pipeline.outputs import reject_other_file

    if sheet is not None:
        reject_other_file(sheet)
    suite, _, name = task.partition("/")
    found = find_task(suite, name) if name else select_tasks([task])[0]
    with closing(LastStartFrames()) as opened:
        report = frame_report.compare_frame(picture, found, init_state, view, opened, partial(print, file=sys.stderr))
    if sheet is not None:
        frame_report.write_sheet(report, sheet)
    print(json.dumps(report.as_json()) if as_json else "\n".join(report.lines()))
    return int(not report.equal)


@click.command(cls=Command, epilog=example("dataset regenerate 0123456789abcdef configs/starter.yaml --out again"))
@click.argument("episode_id", metavar="EPISODE_ID", help="Identifier as in the manifest and in the datasets.")
@click.argument(
    "config",
    metavar="[CONFIG]",
    required=False,
    type=PATH,
    help="File of the run's configuration; for a dataset without a run, give --manifest instead.",
)
@click.option("--out", metavar="DIR", type=PATH, required=True, help="New folder for the regenerated episode.")
@click.option("--manifest", metavar="FILE", type=PATH, help="Manifest of a dataset without a run.")
@click.option(
    "--demos",
    metavar="DIR",
    type=PATH,
    help="With --manifest: folder of the HDF5 demonstrations that the dataset was generated from.",
)
def regenerate(episode_id: str, config: Path | None, out: Path, manifest: Path | None, demos: Path | None) -> int:
    """Generate one episode again from the manifest and its demonstration, and compare it byte for byte.

    The episode is replayed, rendered and serialised again, into the folder of --out. The last line is JSON. It states
    if the episode equals the record in the RLDS dataset next to the manifest, and lists the columns, versions and
    OpenGL devices that differ. The exit status is 1 if the episodes differ.
    """
    from pipeline.validation import regenerate

    if manifest is None and config is None:
        raise click.UsageError("Missing argument 'CONFIG', or option '--manifest'.")
    if (manifest is None and demos is not None) or (manifest is not None and config is not None):
        raise PipelineError(
            "the options name two sources of demonstrations",
            where="options",
            expected="either CONFIG, or --manifest and --demos",
        )
    if config is not None:
        run = open_run(config)
        manifest, demos = run.manifest_file, run.config.demos.root
    assert manifest is not None
    result = regenerate.regenerate(episode_id, manifest, out, demos)
    if result["identical"] is None:
        print(f"generated {out} without a comparison: no RLDS dataset is next to {manifest}", file=sys.stderr)
    print(json.dumps(result))
    return int(result["identical"] is False or result["reason"] != "kept")


def _formats() -> Iterable[str]:
    from pipeline.formats.registry import FORMATS

    return [kind.name for kind in FORMATS]


@click.command(cls=Command, epilog=example("dataset push lerobot me/my-dataset configs/starter.yaml --really"))
@click.argument("format_name", metavar="FORMAT", type=OneOf(_formats), help="Format of the dataset, such as lerobot.")
@click.argument("repository", metavar="REPOSITORY", help="Repository <owner>/<name> on the hub.")
@config_argument
@click.option("--really", is_flag=True, help="Upload the files instead of listing them.")
@click.option("--private", is_flag=True, help="Create a private repository, and reject a public one.")
@click.option(
    "--replace",
    is_flag=True,
    help="Overwrite or delete other files in the repository; without it, a repository with other files is rejected.",
)
def push(format_name: str, repository: str, config: Path, really: bool, private: bool, replace: bool) -> None:
    """Upload a run's dataset with its card to the Hugging Face hub. Without --really, only list the files.

    One dataset of a finished and validated run is uploaded in one commit: its files, the card, the manifest and
    finetune/. Files must be unchanged since they were recorded. A repository with other files than an earlier upload of
    the same run and format is rejected. A stopped upload resumes when the command is called again. The token is read
    from HF_TOKEN or `hf auth login`, and the address of another hub from HF_ENDPOINT.
    """
    from pipeline.publish.push import compare, prepare, send

    run = open_run(config)
    if format_name not in run.config.export.formats:
        raise PipelineError(
            f"the run has no {format_name} dataset",
            where=f"export.{format_name}",
            expected=" or ".join(run.config.export.formats),
        )
    upload = prepare(run.dataset(format_name), run)
    print(upload.summary())
    options = {"private": private, "replace": replace}
    if really:
        print(send(upload, repository, **options))
        return
    print(compare(upload, repository, **options))
    print(f"no file was uploaded: add --really to upload these files to {repository}")
