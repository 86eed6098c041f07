"""Typed configuration: one file is one run, with a section per stage. Omitted fields have defaults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import AfterValidator, Field, ValidationError, ValidationInfo, field_validator, model_validator

from pipeline import origins
from pipeline.axes import AXES, Axes, Axis, axes_of, components_of
from pipeline.axes.language import load_bank, load_further_bank
from pipeline.catalogue import object_sources, texture_sources
from pipeline.compute_config import ComputeConfig
from pipeline.config_faults import describe
from pipeline.episode_schema import SCHEMA, SIZE_PX, Content
from pipeline.errors import PipelineError
from pipeline.export_config import CLEAN, ExportConfig
from pipeline.libero.demonstrations import DemoEntry, DemoIndex, DemoSource, HDF5Source, StarterSource
from pipeline.libero.starts import SETTLING_STEPS
from pipeline.libero.tasks import SUITES, select_tasks
from pipeline.publish_config import PublishConfig
from pipeline.strict_yaml import StrictLoader
from pipeline.testset import benchmark
from pipeline.types import LONGEST_NAME, NO_TRUTH, Count, Frozen, Place, RenderedExtra, find_home

CHECKOUT = (
    *(".ci", ".dvc", ".git", ".venv", "benchmarks", "configs", "docs", "examples", "pipeline", "schemas", "stages"),
    *("tasks", "tests"),
)
"""Folders of a checkout that no run may use: tracked folders, git's folder, the packages and the user's tasks."""


NAME = r"^[a-z][a-z0-9_]*$"
"""Pattern of the name of a run."""


class DemosConfig(Frozen):
    """Demonstrations that a run perturbs.

    Attributes:
        source: ``starter`` selects the 130 demonstrations of a Python package, ``hdf5`` selects the files in ``root``.
            The default is ``hdf5`` if ``root`` is set, else ``starter``.
        root: Folder with files ``<suite>/<task>_demo.hdf5``; none by default.
        tasks: Shell-style patterns of ``<suite>/<task>``; by default the tasks of the four suites.
        per_task: Largest number of demonstrations of each task; by default all of them.
    """

    source: Literal["starter", "hdf5"] = "starter"
    root: Place | None = None
    tasks: Annotated[tuple[str, ...], Field(min_length=1)] = (
        "libero_spatial/*",
        "libero_object/*",
        "libero_goal/*",
        "libero_10/*",
    )
    per_task: Count | None = None

    @model_validator(mode="before")
    @classmethod
    def _source_of_root(cls, raw: Any) -> Any:
        if not isinstance(raw, Mapping):
            return raw
        fitting = "starter" if raw.get("root") is None else "hdf5"
        source = raw.get("source", fitting)
        if source != fitting and "hdf5" in (source, fitting):
            raise ValueError("source: hdf5 and root require each other")
        return {**raw, "source": source}

    def open(self) -> DemoSource:
        return StarterSource() if self.root is None else HDF5Source(self.root)

    def index(self) -> DemoIndex:
        """Return the usable demonstrations of the selected tasks, and the problems of unusable ones."""
        return self.open().index(select_tasks(self.tasks), self.per_task)

    def reject_tasks_without(self, entries: Sequence[DemoEntry]) -> None:
        """Reject selected tasks without any of ``entries``.

        Other tasks would be planned in their place, and their finished work would be deleted.

        Raises:
            PipelineError: naming the tasks.
        """
        usable = {entry.task for entry in entries}
        without = [str(task) for task in select_tasks(self.tasks) if task not in usable]
        if without:
            raise PipelineError(
                f"{len(without)} of the selected tasks have no usable demonstration: {', '.join(without)}",
                where=self.root,
                remedy="add demonstrations of these tasks, or exclude the tasks from demos.tasks",
            )


class PlanConfig(Frozen):
    """Episodes to plan from the demonstrations.

    Attributes:
        seed: Key of every random value of the run.
        axes: Ranges of each axis; default ranges for an axis of ``episodes`` that is not listed.
        episodes: Number of kept episodes to generate of each axis, spread over the tasks evenly or by
            ``task_weights``; empty for clean twins alone. Axes joined by ``+`` in any order, such as
            ``camera+light+language``, perturb the same episode.
        reserve: Share of additional candidates of each task, 0 to 10, rounded up; 0.5 by default. A failed episode is
            replaced by the reserve with the nearest level, then the same component.
        task_weights: Weight of ``<suite>/<task>`` in the distribution of episodes over the tasks; 1 by default.
    """

    seed: Annotated[int, Field(ge=-(2**63), lt=2**63), NO_TRUTH] = 0
    axes: Axes = Axes()
    episodes: dict[str, Count]
    reserve: Annotated[float, Field(ge=0.0, le=10.0), NO_TRUTH] = 0.5
    # Excluded at its default, as a field that was added later.
    task_weights: dict[str, Annotated[float, Field(gt=0.0, le=1000.0)]] = Field(
        default_factory=dict, exclude_if=lambda weights: not weights
    )

    @model_validator(mode="before")
    @classmethod
    def _default_ranges(cls, raw: Any) -> Any:
        if not isinstance(raw, Mapping) or not isinstance(raw.get("episodes"), Mapping):
            return raw
        # YAML reads a section whose options are all comments as None.
        axes = {} if raw.get("axes") is None else raw["axes"]
        if not isinstance(axes, Mapping):
            return raw
        with_defaults = dict(axes)
        for name in raw["episodes"]:
            for axis in str(name).split("+"):
                if axis in AXES and with_defaults.get(axis) is None:
                    with_defaults[axis] = {}
        return {**raw, "axes": with_defaults}

    @field_validator("episodes")
    @classmethod
    def _canonical(cls, episodes: dict[str, int]) -> dict[str, int]:
        named: dict[str, int] = {}
        for written, count in episodes.items():
            name = "+".join(axes_of(written))
            if name in named:
                raise ValueError(f"{name!r} is listed twice, in two orders")
            named[name] = count
        return named

    @model_validator(mode="after")
    def _axes_match_episodes(self) -> PlanConfig:
        in_axes = {*self.axes.configured()}
        in_episodes: set[str] = set()
        for name in self.episodes:
            in_episodes.update(axes_of(name))
        for axis in sorted(in_axes ^ in_episodes):
            section, lacking = ("axes", "episodes") if axis in in_axes else ("episodes", "axes")
            raise ValueError(f"axes and episodes must name the same axes: {axis} is in {section}, but not in {lacking}")
        for name in self.episodes:
            self.axes_for(name)
        return self

    def axes_for(self, name: str) -> tuple[Axis, ...]:
        """Return the axes that the episodes called ``name`` sample from.

        Raises:
            ValueError: as ``Axis.restrict_for``.
        """
        axes = [self.axes.configured()[axis] for axis in axes_of(name)]
        return tuple(axis.restrict_for(axes) for axis in axes)


class ReplayConfig(Frozen):
    """Options of the replay of demonstrations.

    Attributes:
        mode: ``open_loop`` sends the recorded actions unchanged, as the paper does. ``tracked`` follows the hand's path
            of a successful replay by feedback. ``auto``, the default, tracks if the open-loop replay fails, and always
            after a push and from a start of LIBERO's reset.
        noops: ``drop``, the default, skips every no-op, as OpenVLA does. ``trim_ends`` skips only the no-ops before the
            first and after the last real action. ``keep`` skips none.
        settle_steps: Control steps without action, with an open gripper, before the first frame; 10 by default. Every
            evaluation has these steps, and so has OpenVLA's own regeneration of LIBERO's demonstrations.
        fixture_seed: Seed of LIBERO's reset if the source did not record the scene. With the default 0, after settling,
            38 of the 40 starter demonstrations of the four suites reach their goal open-loop.
    """

    mode: Literal["open_loop", "tracked", "auto"] = "auto"
    noops: Literal["drop", "trim_ends", "keep"] = "drop"
    settle_steps: Annotated[int, Field(ge=0, le=200), NO_TRUTH] = SETTLING_STEPS
    fixture_seed: int = Field(default=0, ge=0, lt=2**32)


class FilterConfig(Frozen):
    """Limits of the quality of successful replays, named after columns of the manifest; no limits by default.

    An episode beyond a limit is dropped, with the column as its reason, and a reserve replaces it. Its trajectory stays
    stored.

    Attributes:
        non_target_moved_m: Largest displacement of another object at any step, in m, from the first observation; less
            than 1 mm counts as 0.
        non_target_left_m: Largest displacement of another object after the last step, in m; less than 1 mm counts as 0.
        touched_steps: Largest number of steps after which the robot touches a thing that is not part of the goal.
        path_m: Largest length of the end effector's path, in m.
        jerk_rms_m_s3: Largest root mean square of the end effector's jerk, in m/s^3.
        idle_share: Largest share of steps, 0 to 1, in which hand and fingers hardly move.
        joint_margin_rad: Smallest distance of a joint of the arm to its limit, in rad.
        lag_m: Largest distance between the commanded and the reached position of the hand at a step, in m.
        exceeds_step_limit: ``drop`` drops episodes with more control steps than an evaluation of their suite allows.
    """

    non_target_moved_m: float | None = Field(default=None, ge=0.0)
    non_target_left_m: float | None = Field(default=None, ge=0.0)
    touched_steps: int | None = Field(default=None, ge=0)
    path_m: float | None = Field(default=None, gt=0.0)
    jerk_rms_m_s3: float | None = Field(default=None, gt=0.0)
    idle_share: float | None = Field(default=None, ge=0.0, le=1.0)
    joint_margin_rad: float | None = Field(default=None, ge=-1.0, le=3.0)
    lag_m: float | None = Field(default=None, gt=0.0)
    exceeds_step_limit: Literal["drop"] | None = None

    def fault(self, quality: Mapping[str, Any]) -> str | None:
        """Return the first column of ``Quality`` whose figure is rejected, `None` if there is none."""
        for name, limit in self.model_dump(exclude_none=True, exclude={"exceeds_step_limit"}).items():
            rejected = quality[name] < limit if name == "joint_margin_rad" else quality[name] > limit
            if rejected:
                return name
        return None


FurtherCamera = Literal["frontview", "birdview", "sideview", "galleryview"]
"""Camera of ``further_views`` in ``schemas/episode.json``."""

Name = TypeVar("Name", bound=str)


def _sorted_once(names: tuple[Name, ...]) -> tuple[Name, ...]:
    return tuple(sorted(set(names)))


class RenderConfig(Frozen):
    """Options of rendering.

    Attributes:
        size_px: Height and width of the frames in pixels, an even number from 64 to 512; 256 by default, as in
            LIBERO-Plus's training set.
        views: LIBERO's cameras to show in addition to the agent view and the wrist view: ``frontview``, ``birdview``,
            ``sideview`` and ``galleryview``; none by default. The axes camera and noise leave them unchanged.
        encoding: File format of the frames; only ``jpeg`` exists.
        jpeg_quality: JPEG quality of the frames, 50 to 100; 95 by default.
        extras: Further content of all datasets: ``depth``, ``segmentation`` and ``boxes`` of all views, and
            ``object_poses``; none by default.
    """

    # The defaults are left out, so that earlier frames and datasets stay up to date.
    size_px: int = Field(default=SIZE_PX, ge=64, le=512, multiple_of=2, exclude_if=lambda size_px: size_px == SIZE_PX)
    views: Annotated[tuple[FurtherCamera, ...], AfterValidator(_sorted_once)] = Field(
        default=(), exclude_if=lambda views: not views
    )

    encoding: Literal["jpeg"] = "jpeg"
    jpeg_quality: int = Field(default=95, ge=50, le=100)
    extras: Annotated[tuple[RenderedExtra, ...], AfterValidator(_sorted_once)] = ()

    @property
    def content(self) -> Content:
        """Return the content of the episodes."""
        further_views = [view for view, spec in SCHEMA.further_views.items() if spec.camera in self.views]
        return Content((*SCHEMA.views, *further_views), self.size_px, self.extras)


class FinetuneConfig(Frozen):
    """Options of the fine-tuning recipe.

    Attributes:
        rewrite_probability: Probability, 0 to 1, with which OpenVLA-OFT's script replaces the instruction of a training
            sample by one of the episode's rewrites; 0 by default, as in the paper.
    """

    rewrite_probability: float = Field(default=0.0, ge=0.0, le=1.0)


class Config(Frozen):
    """Configuration of a whole run.

    Attributes:
        name: Name of the run and of its folder: at most 60 small letters, digits and underscores, beginning with a
            letter.
        folder: Folder that contains the folder of the run; ``data`` by default. The parent of an absolute path outside
            of the home folder must exist.
        demos: Demonstrations that the run perturbs; by default the starter set of the four suites.
        plan: Episodes to plan from the demonstrations.
        replay: Options of the replay of demonstrations.
        filter: Limits of the quality of successful replays; none by default.
        render: Options of rendering.
        export: Output formats and their options; by default RLDS and LeRobot.
        finetune: Options of the fine-tuning recipe.
        compute: Place of the computation; by default all cores of this machine.
        publish: Statements of the dataset card; none by default.
    """

    name: str = Field(pattern=NAME, max_length=LONGEST_NAME)
    # The default is left out, so that runs that were finished before the field existed stay up to date.
    folder: Place = Field(default=Path("data"), exclude_if=lambda folder: folder == Path("data"))
    demos: DemosConfig = DemosConfig()
    plan: PlanConfig
    replay: ReplayConfig = ReplayConfig()
    filter: FilterConfig = Field(default=FilterConfig(), exclude_if=lambda limits: limits == FilterConfig())
    render: RenderConfig = RenderConfig()
    export: ExportConfig = Field(default=ExportConfig(), validate_default=True)
    # Excluded at its default, as a section that was added later.
    finetune: FinetuneConfig = Field(default=FinetuneConfig(), exclude_if=lambda section: section == FinetuneConfig())
    compute: ComputeConfig = ComputeConfig()
    publish: PublishConfig = PublishConfig()

    @field_validator("demos")
    @classmethod
    def _known_tasks(cls, demos: DemosConfig) -> DemosConfig:
        try:
            chosen = select_tasks(demos.tasks)
        except PipelineError as error:
            of_file = f"{error.where}: " if error.where else ""
            raise ValueError(f"tasks: {of_file}{error.what}, expected {error.expected}") from error
        own_tasks = [task for task in chosen if task.suite not in SUITES]
        for own_task in own_tasks:
            for kind, name in (("suite", own_task.suite), ("task", own_task.name)):
                if len(name) > LONGEST_NAME:
                    raise ValueError(
                        f"tasks: the name of the {kind} {name} has {len(name)} characters, expected at most "
                        f"{LONGEST_NAME}, because paths of datasets contain it; rename the {kind}"
                    )
        if demos.root is None and own_tasks:
            raise ValueError(f"the starter set has no demonstration of {own_tasks[0]}: set root")
        return demos

    @field_validator("export")
    @classmethod
    def _named(cls, export: ExportConfig, info: ValidationInfo) -> ExportConfig:
        named = export.named(f"libero_{info.data.get('name', '')}")
        for options in named.formats.values():
            options.reject_name()
        return named

    @model_validator(mode="after")
    def _weights_are_of_chosen_tasks(self) -> Config:
        chosen = [str(task) for task in select_tasks(self.demos.tasks)]
        for name in self.plan.task_weights:
            if name not in chosen:
                similar = get_close_matches(name, chosen, n=1)
                expected = f"did you mean {similar[0]}?" if similar else "expected <suite>/<task>"
                raise ValueError(f"plan.task_weights: demos.tasks does not select {name!r}; {expected}")
        return self

    @model_validator(mode="after")
    def _replay_suits_axes(self) -> Config:
        axes = self.plan.axes
        if axes.disturbance and self.replay.noops != "drop":
            raise ValueError("the axis disturbance requires replay.noops: drop, as pushes count steps without no-ops")
        if self.replay.mode == "open_loop":
            if axes.disturbance:
                raise ValueError(
                    "the axis disturbance requires replay.mode: auto or tracked, as recorded actions do not correct "
                    "pushes"
                )
            if axes.goal:
                raise ValueError(
                    "the axis goal requires replay.mode: auto or tracked, as its objects stand elsewhere than recorded"
                )
        return self

    @model_validator(mode="after")
    def _tasks_have_rewrites(self) -> Config:
        language = self.plan.axes.language
        if not language:
            return self
        # The shipped bank has no rewrites of LIBERO-90.
        banks = [load_bank()]
        if language.bank:
            banks.append(load_further_bank(language.bank))
        without: list[str] = []
        for task in select_tasks(self.demos.tasks):
            if not any(bank.get(task.suite, {}).get(task.name) for bank in banks):
                without.append(str(task))
        if without:
            raise ValueError(
                f"plan.axes.language: {len(without)} tasks have no rewrites, such as {without[0]}; leave language "
                "out, exclude the tasks from demos.tasks, or name a bank that the command rewrite has written"
            )
        return self

    @model_validator(mode="after")
    def _formats_hold_the_content(self) -> Config:
        for options in self.export.formats.values():
            options.reject_content(self.render.content)
        return self

    @model_validator(mode="after")
    def _rewrites_are_sampled_by_a_client(self) -> Config:
        if self.finetune.rewrite_probability and "rlds" not in self.export.formats:
            raise ValueError(
                "finetune.rewrite_probability requires export.rlds, as only the script for OpenVLA-OFT samples rewrites"
            )
        return self

    @model_validator(mode="after")
    def _export_selects_from_the_run(self) -> Config:
        components, levels = {CLEAN}, {0}
        for name, axis in self.plan.axes.configured().items():
            components.update(getattr(axis, "components", components_of(name)))
            levels.update(axis.levels)
        values_of_run: dict[str, set[Any]] = {
            "axis": {CLEAN, *self.plan.episodes},
            "component": components,
            "level": levels,
            "suite": {task.suite for task in select_tasks(self.demos.tasks)},
        }
        for field, values in values_of_run.items():
            for value in getattr(self.export.where, field, None) or ():
                if value not in values:
                    raise ValueError(
                        f"export.where.{field}: the run has no {value!r}, expected values {sorted(values)}"
                    )
        return self

    @model_validator(mode="after")
    def _folder_of_its_own(self) -> Config:
        """Reject a folder in which stages would delete files that do not belong to the run."""
        data = self.run_folder.resolve()
        for root in {Path.cwd(), Path(__file__).resolve().parents[1]}:
            nested = next((root / name for name in CHECKOUT if _nested(data, (root / name).resolve())), None)
            if nested or root.is_relative_to(data):
                raise ValueError(f"folder: {data} overlaps with the folder {nested or root} of the checkout")
        home = find_home()
        if home is not None and home.resolve().is_relative_to(data):
            raise ValueError(f"folder: {data} is or contains the home folder")
        for shared in (texture_sources.FOLDER, object_sources.FOLDER, benchmark.FOLDER):
            if _nested(data, shared.resolve()):
                raise ValueError(f"name: all runs share the folder {shared}; choose another name")
        if self.demos.root is not None and _nested(data, self.demos.root.resolve()):
            raise ValueError(f"folder: {data} overlaps with demos.root, {self.demos.root}")
        return self

    @property
    def run_folder(self) -> Path:
        """Folder of all files that this run generates."""
        return self.folder / self.name


def _nested(first: Path, second: Path) -> bool:
    """Return whether two resolved paths are equal, or one is inside the other."""
    return first.is_relative_to(second) or second.is_relative_to(first)


def load(path: Path) -> Config:
    """Read and validate a configuration.

    Raises:
        PipelineError: naming the file, every wrong field, and valid values.
    """
    return validate(read_content(path), path)


def read_content(path: Path) -> Any:
    """Read the content of a configuration, without validation.

    Raises:
        PipelineError: naming the file.
    """
    try:
        return yaml.load(path.read_text(encoding="utf-8"), StrictLoader)
    except FileNotFoundError as error:
        files = [file.as_posix() for file in sorted(Path("configs").glob("*.yaml"))]
        similar = get_close_matches(path.as_posix(), files, n=1)
        raise PipelineError(
            "there is no such configuration",
            where=path,
            expected=f"did you mean {similar[0]}?" if similar else ", ".join(files) or "the path of a YAML file",
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise PipelineError(
            f"cannot read the configuration ({error})", where=path, expected="a text file in UTF-8"
        ) from error
    except yaml.MarkedYAMLError as error:
        raise PipelineError(
            f"the file is not valid YAML: {_describe_yaml_fault(error)}",
            where=path,
            expected="fields as in configs/starter.yaml",
            remedy="use spaces as indents" if "'\\t'" in str(error.problem) else None,
        ) from error
    except (yaml.YAMLError, RecursionError) as error:
        raise PipelineError(
            f"the file is not valid YAML: {error}", where=path, expected="a file such as configs/starter.yaml"
        ) from error


def _describe_yaml_fault(error: yaml.MarkedYAMLError) -> str:
    """Describe a fault with its place, and the place where the faulty part begins."""
    parts: list[str] = []
    for text, mark in ((error.problem, error.problem_mark), (error.context, error.context_mark)):
        if text:
            parts.append(f"{text} in line {mark.line + 1}, column {mark.column + 1}" if mark else text)
    return ", ".join(parts)


def validate(content: Any, path: Path) -> Config:
    """Validate the content of a configuration in the file ``path``.

    Raises:
        PipelineError: naming the file, every wrong field, and valid values.
    """
    origins.check_module("libero")  # It has the list of tasks.
    if content is None:
        raise PipelineError("the file is empty", where=path, remedy="copy the fields of configs/starter.yaml into it")
    try:
        return Config.model_validate(content)
    except ValidationError as error:
        faults = "\n    ".join(describe(error, Config))
        raise PipelineError(
            f"the configuration is not valid:\n    {faults}",
            where=path,
            remedy="look up the fields in docs/fields.md",
        ) from error
