"""Commands about a finished run or a third-party dataset: ``check``, ``audit``, ``regenerate`` and ``push``."""

import argparse
import json
import sys
from typing import Any

from pipeline.commands.base import add, add_config, argument, owned, value
from pipeline.errors import PipelineError

TITLE = "a finished run"


def add_commands(commands: Any) -> None:
    add(commands, check, add_config)
    dataset = value("dataset", "DATASET", "folder of an RLDS or LeRobot set, whoever made it")
    labels = "labels of episodes that lost theirs and kept their episode_id"
    add(commands, audit, dataset, value("--manifest", "FILE", labels))
    add(
        commands,
        regenerate,
        value("episode_id", "EPISODE_ID", "as in the manifest and in the datasets", str),
        add_config,
        value("--out", "DIR", "new folder for what is rebuilt", required=True),
        value("--manifest", "FILE", "of a dataset from elsewhere, in place of a configuration"),
        value("--demos", "DIR", "with --manifest: the HDF5 demonstrations that it was made from"),
    )
    add(
        commands,
        push,
        _format,
        value("repository", "REPOSITORY", "owner/name on the hub", str),
        add_config,
        argument("--really", action="store_true", help="send it"),
        argument("--private", action="store_true", help="create a private repository; refuse a public one"),
        argument(
            "--replace", action="store_true", help="delete what is not an earlier upload of the same run and format"
        ),
    )


def check(arguments: argparse.Namespace) -> int:
    """read all that a run stored, compare it with its checksums, and read its RLDS as OpenVLA-OFT does

    Says which files are not what was written, and what OpenVLA-OFT would train on and what would mislead it. The last
    line is JSON. Ends with 1 where something is off: move a damaged file away, and the run makes it again. (The stage
    validate, which is a part of every run, compares the content of the datasets with each other and with the plan.)
    """
    from pipeline.clients import oft
    from pipeline.run.layout import STATISTICS
    from pipeline.validation.verify import verify

    run = owned(arguments)
    with run.workers() as workers:
        stored = verify(run, workers)
    damaged: list[str] = []
    for findings in stored.values():
        damaged += findings["damaged"]
    trained: dict[str, Any] = {}
    # OpenVLA-OFT's reader stops at damaged files.
    if "rlds" in run.config.export.formats and not stored["rlds"]["damaged"]:
        trained = oft.check_all(run.dataset("rlds").folder, run.path(STATISTICS))
    misleading: list[str] = []
    for name, findings in trained.items():
        misleading += [f"{name}: {violation}" for violation in findings["violations"]]
    for line in (*damaged, *misleading):
        print(line)
    print(json.dumps({**stored, "openvla_oft": trained}))
    return int(bool(damaged or misleading))


def audit(arguments: argparse.Namespace) -> int:
    """say how near a dataset comes to the benchmark's test tasks, and what cannot be known of it

    Compares the instruction of every episode, the matrices of its agent view where the dataset has them, and this
    project's labels where it has these, also after it was edited, merged or filtered. The last line is JSON. Ends with
    1 where an episode overlaps with a test task.
    """
    from dataclasses import asdict

    import rich

    from pipeline.planning import leakage
    from pipeline.testset import benchmark
    from pipeline.validation.audit import audit

    result = audit(arguments.dataset, benchmark.load(), arguments.manifest)
    rich.print(leakage.report(result.axes))
    for axis, number in result.unknown.items():
        print(f"{axis}: not known of {number:,} of {result.episodes:,} episodes: no labels, no text, or no known task")
    print(json.dumps(asdict(result) | {"unknown": result.unknown}))
    return int(any(finding.overlaps for finding in result.axes.values()))


def regenerate(arguments: argparse.Namespace) -> int:
    """rebuild one episode from the manifest and its demonstration, and say whether it is the dataset's, byte for byte

    Replays, renders and serialises one kept episode again. The last line is JSON: whether it equals the record in the
    RLDS set beside the manifest, which columns differ, and which versions and OpenGL device are not those of the
    manifest. Ends with 1 when it is not identical.
    """
    from pipeline.validation.regenerate import regenerate

    manifest, demos = arguments.manifest, arguments.demos
    if (manifest is None and demos is not None) or (manifest is not None and arguments.config is not None):
        raise PipelineError(
            "two places to take the demonstrations from", where="options", expected="CONFIG, or --manifest and --demos"
        )
    if manifest is None:
        run = owned(arguments)
        manifest, demos = run.manifest_file, run.config.demos.root
    result = regenerate(arguments.episode_id, manifest, arguments.out, demos)
    if result["identical"] is None:
        print(f"only made, in {arguments.out}: no RLDS set lies beside {manifest} to compare it with", file=sys.stderr)
    print(json.dumps(result))
    return int(result["identical"] is False or result["reason"] != "kept")


def _format(command: argparse.ArgumentParser) -> None:
    from pipeline.formats.registry import FORMATS

    names = [kind.name for kind in FORMATS]
    command.add_argument("format", choices=names, metavar="FORMAT", help=" or ".join(names))


def push(arguments: argparse.Namespace) -> None:
    """upload a run's dataset with its card to the Hugging Face hub; without --really, say what would go

    Sends one of the datasets of a finished and validated run: its files, the card, the manifest and finetune/, in one
    commit; only files as they were recorded. A repository with anything but an earlier upload of the same run and
    format is refused. Cut off, it resumes. A token is read from HF_TOKEN or `hf auth login`, the address of another
    hub from HF_ENDPOINT.
    """
    run = owned(arguments)
    if arguments.format not in run.config.export.formats:
        raise PipelineError(
            f"the run has no {arguments.format}",
            where=f"export.{arguments.format}",
            expected=" or ".join(run.config.export.formats),
        )
    from pipeline.publish import push

    upload = push.prepare(run.dataset(arguments.format), run)
    print(upload.summary())
    options = {"private": arguments.private, "replace": arguments.replace}
    if arguments.really:
        print(push.send(upload, arguments.repository, **options))
        return
    print(push.compare(upload, arguments.repository, **options))
    print(f"nothing was sent: with --really this goes to {arguments.repository}")
