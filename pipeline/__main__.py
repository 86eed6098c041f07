"""Command line: what a person does around a run. The run itself is `dvc repro`.

Each command is a function here, whose docstring is what ``--help`` says of it. What takes seconds to import, such as
the simulator, it imports itself, so that the others need not wait.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import yaml
from rich.console import Console

from pipeline.arguments import positive
from pipeline.axes import AXES
from pipeline.compute.pool import runner
from pipeline.config import ComputeConfig, Config, DemosConfig, load
from pipeline.evaluation import commands as evaluation_commands
from pipeline.exit_status import exit_status
from pipeline.files import replaced
from pipeline.formats.registry import FORMATS, formats_of
from pipeline.libero.fetch import fetch
from pipeline.libero.tasks import SUITES, select_tasks
from pipeline.publish import attribution
from pipeline.rewriting.language_model import LanguageModel
from pipeline.rewriting.rewrite import extend
from pipeline.run import manifest
from pipeline.run.stage import owned
from pipeline.testset import benchmark
from pipeline.validation import doctor

SCHEMAS = Path(__file__).parent.parent / "schemas"


def schemas() -> dict[str, dict[str, Any]]:
    """The files of ``schemas/`` that are written from the code."""
    return {"config.schema.json": config_schema(), "manifest.json": manifest.described()}


def config_schema() -> dict[str, Any]:
    """JSON Schema of the files in ``configs/``."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Config.model_json_schema()}


def _doctor(arguments: argparse.Namespace) -> int:
    """check versions, OpenGL, disk, memory and demonstrations for a configuration; changes nothing"""
    return doctor.run(load(arguments.config or _chosen()))


def _chosen() -> Path:
    """The configuration that ``dvc repro`` would run here."""
    params = Path("params.yaml")
    name = yaml.safe_load(params.read_text())["run"] if params.is_file() else "starter"
    return Path("configs") / f"{name}.yaml"


def _fetch(arguments: argparse.Namespace) -> int:
    """download LIBERO's demonstrations (HDF5) from the hub, or go on with a download that was cut short"""
    files = fetch(arguments.out, arguments.suites, arguments.endpoint)
    print(f"{len(files)} files are in {arguments.out}: set demos.source: hdf5 and demos.root: {arguments.out}")
    return 0


def _preview(arguments: argparse.Namespace) -> int:
    """draw what an axis does to a task: its first frame, and eleven draws over the components and levels"""
    from pipeline.report import preview

    config = load(arguments.config)
    tasks = select_tasks([arguments.task])
    stage = preview.staged(tasks, config)
    with replaced(arguments.out) as temporary:
        preview.draw(stage, arguments.axis, config, benchmark.load()).save(temporary, format="PNG")
        of = f", the first of {len(tasks)} tasks" if len(tasks) > 1 else ""
        print(f"{arguments.out} shows {arguments.axis} on {stage.demo.demo_id}{of}")
    return 0


def _rewrite(arguments: argparse.Namespace) -> int:
    """have a language model reword a task's instruction, lint what it says, and add it to a bank of rewrites

    Asks an OpenAI-compatible endpoint for rewrites of each class (distraction, common sense, reasoning chain,
    paraphrase) until the bank has enough of each. The same lint as of the shipped bank decides what is let in. Run
    again, it goes on where it was stopped. A key is read from OPENAI_API_KEY.
    """
    extend(arguments.bddl_file, arguments.out, arguments.per_class, LanguageModel(arguments.endpoint, arguments.model))
    print(f"{arguments.out} holds {arguments.per_class} rewrites of each class for {arguments.bddl_file.stem}")
    return 0


def _sources(arguments: argparse.Namespace) -> int:
    """fetch and convert the textures and objects that a configuration names, as its plan would, and count them"""
    print(json.dumps(attribution.counts(load(arguments.config).plan.axes)))
    return 0


def _expand(arguments: argparse.Namespace) -> int:
    """make many demonstrations of each task from the starter set's one, where the hub cannot be reached

    Replays each human demonstration from other starts of the arm, with the target elsewhere, and writes those that
    reach the goal in LIBERO's own HDF5 layout (states, actions and scenes; no images). They are marked as expanded in
    the files and in every dataset made from them.
    """
    from pipeline.run.expand import expand

    demos = DemosConfig(tasks=tuple(arguments.tasks))
    with runner(ComputeConfig(), arguments.out) as run:
        made = expand(arguments.out, demos, arguments.per_task, arguments.seed, benchmark.load(), run)
    print(
        f"{made.written} demonstrations in {len(made.files)} files: set demos.source: hdf5 and {arguments.out} as root"
    )
    print(json.dumps({"written": made.written, "dropped": dict(made.dropped.most_common()), "short": made.short}))
    return 0


def _evaluation_report(arguments: argparse.Namespace) -> int:
    """write one HTML page and one JSON file about evaluations: rates, the paper's table, comparisons, failures

    Reads the folders that `evaluate` wrote, on one machine or on several, and sets different policies side by side.
    Two different results of one episode are an error. The last line is JSON.
    """
    from pipeline.evaluation.results import read
    from pipeline.report import evaluation_report

    print(json.dumps(evaluation_report.write(read(arguments.folders), arguments.out)))
    return 0


def _check_oft(arguments: argparse.Namespace) -> int:
    """read a run's RLDS as OpenVLA-OFT's loader does, and print what it would train on as one line of JSON"""
    from pipeline.clients import oft_check

    found = oft_check.check_run(arguments.data)
    print(json.dumps(found))
    return int(any(dataset["violations"] for dataset in found.values()))


def _coverage(arguments: argparse.Namespace) -> int:
    """set what a policy sees in a finished run beside what it sees in the benchmark's test tasks

    First looks, how far the hand and the targets are moved, where objects are added, how much of a view changes, grey
    levels and words, axis by axis. The last line is JSON: number, tenth, fiftieth and ninetieth percentile of each.
    """
    from pipeline.report import seen

    measures = seen.measure(owned(arguments.config or _chosen()), benchmark.load())
    Console().print(seen.table(measures))
    print(json.dumps({f"{one.axis}: {one.what}": {"tests": one.tested, "run": one.ours} for one in measures}))
    return 0


def _verify(arguments: argparse.Namespace) -> int:
    """read every stored file of a run, and say which are not what was written

    Compares trajectories, frames and both datasets with the checksums that they were stored with. The last line is
    JSON. Ends with 1 where a file is damaged: delete it, and `dvc repro` makes it anew.
    """
    from pipeline.validation.verify import verify

    config = owned(arguments.config)
    with runner(config.compute, config.data) as run:
        results = verify(config, run)
    for result in results.values():
        for damaged in result["damaged"]:
            print(damaged)
    print(json.dumps(results))
    return int(any(result["damaged"] for result in results.values()))


def _regenerate(arguments: argparse.Namespace) -> int:
    """rebuild one episode from the manifest and its demonstration, and say whether it is the dataset's, byte for byte

    Replays, renders and serialises one kept episode again. The last line is JSON: whether it equals the record in the
    RLDS set beside the manifest, which columns differ, and which versions and OpenGL device are not those of the
    manifest. Ends with 1 when it is not identical.
    """
    from pipeline.validation.regenerate import regenerate

    found = regenerate(arguments.episode_id, arguments.manifest, arguments.out, arguments.demos)
    print(json.dumps(found))
    return int(found["identical"] is False or found["reason"] != "kept")


def _push(arguments: argparse.Namespace) -> int:
    """upload a run's dataset with its card to the Hugging Face hub; without --really, say what would go

    Sends one of the datasets of a finished and validated run: its files, the card, the manifest and the recipe, in
    one commit. Cut off, it goes on where it was. A token is read from HF_TOKEN or `hf auth login`.
    """
    config = owned(arguments.config)
    from pipeline.publish import push

    (target,) = (
        one for one in formats_of(config.data, config.export, config.render.extras) if one.name == arguments.format
    )
    upload = push.prepare(target)
    print(upload.summary())
    if not arguments.really:
        print(f"nothing was sent: with --really this goes to {arguments.repository}")
        return 0
    print(push.send(upload, arguments.repository, private=arguments.private, endpoint=arguments.endpoint))
    return 0


def _schema(arguments: argparse.Namespace) -> int:
    """write the files of schemas/ that follow from the code"""
    for name, content in schemas().items():
        with replaced(SCHEMAS / name) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n")
        print(f"wrote {SCHEMAS / name}")
    return 0


def parser() -> argparse.ArgumentParser:
    top = argparse.ArgumentParser(
        prog="python -m pipeline",
        description="Perturbed fine-tuning data from LIBERO demonstrations. `dvc repro` makes the datasets of the "
        "configuration that params.yaml names; the commands here are for what comes before and after.",
        epilog="Examples: `python -m pipeline doctor` before a long run; `python -m pipeline fetch demos "
        "libero_goal` for all 50 demonstrations of each task where the hub can be reached; `python -m pipeline preview "
        "'libero_goal/turn_on*' camera` to look at what an axis does.",
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_before(commands)
    evaluation_commands.add_commands(commands)
    _add_after(commands)
    return top


def _command(commands: Any, run: Callable[[argparse.Namespace], int]) -> argparse.ArgumentParser:
    """Add a command that is named as its function."""
    described, _, details = (run.__doc__ or "").partition("\n\n")
    name = run.__name__.removeprefix("_").replace("_", "-")
    command: argparse.ArgumentParser = commands.add_parser(name, help=described, description=details or None)
    command.set_defaults(run=run)
    return command


def _add_config(command: argparse.ArgumentParser, nargs: Literal["?"] | None = None) -> None:
    default = " (default: the one that params.yaml names)" if nargs else ""
    described = f"of the run, such as configs/starter.yaml{default}"
    command.add_argument("config", type=Path, nargs=nargs, metavar="CONFIG", help=described)


def _add_before(commands: Any) -> None:
    """The commands for what comes before a run."""
    command = _command(commands, _doctor)
    _add_config(command, nargs="?")

    command = _command(commands, _fetch)
    command.add_argument("out", type=Path, help="folder to use as demos.root afterwards")
    command.add_argument("suites", nargs="+", choices=SUITES, metavar="SUITE", help=f"any of {', '.join(SUITES)}")
    command.add_argument("--endpoint", help="address of a mirror of the hub")

    command = _command(commands, _preview)
    command.add_argument("task", metavar="TASK", help="a pattern of <suite>/<task>, such as 'libero_goal/turn_on*'")
    command.add_argument("axis", choices=AXES, metavar="AXIS", help=f"any of {', '.join(AXES)}")
    command.add_argument(
        "--config",
        type=Path,
        default=Path("configs/starter.yaml"),
        help="whose seed, ranges and demonstrations to use (default: configs/starter.yaml); an axis that it does not "
        "name has its default ranges",
    )
    command.add_argument("--out", type=Path, default=Path("sheet.png"), help="picture to write (default: sheet.png)")

    command = _command(commands, _rewrite)
    command.add_argument("bddl_file", type=Path, metavar="BDDL_FILE", help="the task, <suite>/<task>.bddl")
    command.add_argument("--out", type=Path, required=True, help="bank to extend or to begin, such as bank.yaml")
    command.add_argument(
        "--per-class", type=positive, default=9, metavar="N", help="rewrites of each class wanted (default: 9)"
    )
    command.add_argument(
        "--endpoint",
        required=True,
        metavar="URL",
        help="what /chat/completions is appended to: http://localhost:8000/v1",
    )
    command.add_argument("--model", required=True, metavar="NAME", help="name of the model at the endpoint")

    command = _command(commands, _sources)
    command.add_argument(
        "--config",
        type=Path,
        default=Path("configs/paper.yaml"),
        help="whose sources (default: configs/paper.yaml)",
    )

    demos = commands.add_parser("demos", help="make demonstrations")
    made = demos.add_subparsers(dest="verb", required=True, metavar="VERB")
    command = _command(made, _expand)
    command.add_argument("out", type=Path, help="folder to use as demos.root afterwards")
    command.add_argument(
        "--per-task", type=positive, default=10, metavar="N", help="demonstrations of each task (default: 10)"
    )
    command.add_argument(
        "--tasks",
        nargs="+",
        default=DemosConfig().tasks,
        metavar="PATTERN",
        help="patterns of <suite>/<task> (default: the four suites)",
    )
    command.add_argument("--seed", type=int, default=0, help="of every draw (default: 0)")


def _add_after(commands: Any) -> None:
    """The commands for a finished run and for evaluations."""
    command = _command(commands, _evaluation_report)
    command.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="folder of results")
    command.add_argument(
        "--out",
        type=Path,
        default=Path("report.html"),
        metavar="FILE",
        help="page to write, with a JSON file of the same name beside it (default: report.html)",
    )

    command = _command(commands, _check_oft)
    command.add_argument("data", type=Path, metavar="DIR", help="the run's data folder, such as data/starter")

    command = _command(commands, _coverage)
    _add_config(command, nargs="?")

    command = _command(commands, _verify)
    _add_config(command)

    command = _command(commands, _regenerate)
    command.add_argument("episode_id", metavar="EPISODE_ID", help="as in the manifest and in both datasets")
    command.add_argument("--manifest", type=Path, required=True, metavar="FILE", help="data/<run>/manifest.parquet")
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for what is rebuilt")
    command.add_argument(
        "--demos", type=Path, metavar="DIR", help="folder of the HDF5 demonstrations, where the run was made from those"
    )

    command = _command(commands, _push)
    _add_config(command)
    names = [kind.name for kind in FORMATS]
    command.add_argument("format", choices=names, metavar="FORMAT", help=" or ".join(names))
    command.add_argument("repository", metavar="REPOSITORY", help="owner/name on the hub")
    command.add_argument("--really", action="store_true", help="send it")
    command.add_argument("--private", action="store_true", help="make a new repository private")
    command.add_argument("--endpoint", metavar="URL", help="address of the hub, when not the usual one")

    command = _command(commands, _schema)


def main() -> int:
    arguments = parser().parse_args()
    return exit_status(lambda: int(arguments.run(arguments)))


if __name__ == "__main__":
    sys.exit(main())
