"""The configuration: what is not understood is rejected, by file, field and remedy."""

import inspect
import json
import math
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any, get_args

import jsonschema
import pytest
import yaml
from checkout import REPOSITORY
from pydantic import BaseModel, ValidationError

from pipeline.axes.background import BackgroundAxis
from pipeline.axes.base import LEVELS
from pipeline.axes.camera import CameraAxis
from pipeline.axes.language import LanguageAxis
from pipeline.catalogue.sources import Folder
from pipeline.commands.develop import schemas
from pipeline.config import Config, load
from pipeline.errors import PipelineError
from pipeline.export_config import Where
from pipeline.field_tables import with_tables
from pipeline.libero.assets import libero_folder
from pipeline.run.claim import find_missing_parent
from pipeline.run.inputs import settings_of

STARTER = REPOSITORY / "configs" / "starter.yaml"


def changed(path: Path, value: Any, *keys: str) -> Path:
    config = yaml.safe_load(STARTER.read_text())
    section = config
    for key in keys[:-1]:
        section = section.setdefault(key, {})
    section[keys[-1]] = value
    file = path / "changed.yaml"
    file.write_text(yaml.safe_dump(config))
    return file


@pytest.mark.parametrize("file", sorted((REPOSITORY / "configs").glob("*.yaml")), ids=lambda file: file.stem)
def test_every_config_is_valid_and_named_after_its_file(file: Path) -> None:
    assert load(file).name == file.stem
    jsonschema.validate(yaml.safe_load(file.read_text()), schemas()["config.schema.json"])


@pytest.mark.parametrize("name", ["config.schema.json", "manifest.json"])
def test_schema_file_is_that_of_the_code(name: str) -> None:
    stored = json.loads((REPOSITORY / "schemas" / name).read_text())
    assert stored == schemas()[name], "run: python -m pipeline schema"


def test_the_page_of_fields_is_that_of_the_code() -> None:
    """Each model that a configuration contains has its table, and each field its values, default and description."""
    page = (REPOSITORY / "docs" / "fields.md").read_text()
    schema = schemas()["config.schema.json"]
    assert with_tables(page, schema) == page, "run: python -m pipeline schema"
    models = {name for name, model in schema["$defs"].items() if "properties" in model}
    assert set(re.findall(r"<!-- fields: (\w+) -->", page)) == models - {"Axes"} | {"Config"}
    assert "| `jpeg_quality` | whole number, 50 to 100 | `95` |" in page
    assert "| `turn_deg` | number, 0 to 180 | `20` |" in page
    assert re.findall(r"^\|.*\| *\|$", page, re.MULTILINE) == [], "a field without a description"


def models_in(annotation: Any) -> set[type[BaseModel]]:
    """Find the models that a type annotation contains, and the models in their fields."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        found: set[type[BaseModel]] = {annotation}
        for field in annotation.model_fields.values():
            found |= models_in(field.annotation)
        return found
    return set().union(*(models_in(part) for part in get_args(annotation)))


@pytest.mark.parametrize("model", sorted(models_in(Config), key=str))
def test_every_field_is_described(model: type[BaseModel]) -> None:
    """The descriptions are a table of the documentation: one entry for each field, in whole sentences."""
    entries = inspect.getdoc(model).partition("Attributes:\n")[2]  # type: ignore[union-attr]
    described = dict(re.findall(r"^    (\w+): (.*(?:\n     .*)*)", entries, re.MULTILINE))
    assert list(described) == [name for name in model.model_fields if name in described], "in the order of the fields"
    assert set(described) == set(model.model_fields)
    for name, text in described.items():
        assert re.fullmatch(r"(?s)([A-Z0-9]|``).*\.", text), name


@pytest.mark.parametrize(
    ("value", "keys", "message"),
    [
        (1, ("render", "jpg_quality"), "render.jpg_quality: unknown field; did you mean jpeg_quality?"),
        (30, ("render", "jpeg_quality"), "render.jpeg_quality: expected at least 50, got 30"),
        ("closed_loop", ("replay", "mode"), "replay.mode: expected 'open_loop', 'tracked' or 'auto', got"),
        ({"camera": 0, "noise": 1, "language": 1}, ("plan", "episodes"), "plan.episodes.camera"),
        ({"axes": {"pose": {}}, "episodes": {"camera": 4}}, ("plan",), "axes and episodes must name the same axes"),
        ({"camera+camera": 4}, ("plan", "episodes"), "plan.episodes: 'camera+camera' names an axis twice"),
        ({"camera+wind": 4}, ("plan", "episodes"), "'wind' in 'camera+wind' is no axis, expected goal, layout, pose"),
        ({"camera+": 4}, ("plan", "episodes"), "'' in 'camera+' is no axis"),
        (
            {"camera+light": 4, "light+camera": 2},
            ("plan", "episodes"),
            "'camera+light' is listed twice, in two orders",
        ),
        (
            {
                "seed": 1,
                "axes": {"layout": {}, "language": {"classes": ["common_sense"]}},
                "episodes": {"language+layout": 4},
            },
            ("plan",),
            "with layout, axes.language.components must contain distraction or paraphrase",
        ),
        ({"camera": {"distance": {"distance_scale": [[[2, 1]]] * 5}}}, ("plan", "axes"), "with low <= high"),
        ({"camera": {"distance": {"distance_scale": [[[0, 1]]] * 5}}}, ("plan", "axes"), "a positive multiple"),
        ({"camera": {"spherical": {"elevation_deg": [[0, math.nan]]}}}, ("plan", "axes"), "finite number"),
        ({"robot": {"norm_rad": [0.1, 0.2, 0.3, 0.4, math.inf]}}, ("plan", "axes"), "finite number"),
        (2**63, ("plan", "seed"), "plan.seed: expected less than"),
        ({"camera": 10**9}, ("plan", "episodes"), "plan.episodes.camera: expected at most 1000000, got 1000000000"),
        ({"wind": {}}, ("plan", "axes"), "plan.axes.wind: unknown field; the fields are goal, layout, pose"),
        ({"source": "starter", "root": "/tmp"}, ("demos",), "source: hdf5 and root require each other"),
        ({"source": "hdf5"}, ("demos",), "source: hdf5 and root require each other"),
        ({"tasks": ["libero_goal/put_the_bowl_on_the_plat"]}, ("demos",), "libero_goal/put_the_bowl_on_the_plate"),
        ([], ("demos", "tasks"), "demos.tasks: expected at least 1 value"),
        ({"tasks": ["libero_90/*"]}, ("demos",), "plan.axes.language: 90 tasks have no rewrites"),
        ({"rlds": None, "lerobot": None}, ("export",), "no format is left, expected one of rlds, lerobot"),
        ({"axis": ["wind"]}, ("export", "where"), "export.where.axis: the run has no 'wind', expected values ["),
        ({"component": ["scene", "sky"]}, ("export", "where"), "export.where.component: the run has no 'sky'"),
        ({"level": [6]}, ("export", "where"), "export.where.level.0: expected at most 5, got 6"),
        ({"level": []}, ("export", "where"), "export.where.level"),
        ({"suite": ["libero_90"]}, ("export", "where"), "export.where.suite: the run has no 'libero_90'"),
        ("objects", ("name",), "all runs share the folder data/objects"),
        ("carrier pigeon", ("compute",), "compute"),
        ("my_set", ("export", "rlds", "name"), "export.rlds.name"),
        ("libero_aloha", ("export", "rlds", "name"), "a name with libero and without aloha in it"),
        ({"name": "kitchen_val"}, ("export", "lerobot_openpi"), "names of sets for validation end in _val"),
        (
            {"lerobot_v21": {"convention": "openpi"}, "lerobot_openpi": {}},
            ("export",),
            "lerobot_v21 with the convention openpi has the content of lerobot_openpi",
        ),
        (4, ("export", "lerobot", "parts"), "export.lerobot.parts: unknown field"),
        (0.6, ("export", "rlds", "validation"), "export.rlds.validation: expected at most 0.5, got 0.6"),
        (1e-320, ("export", "lerobot", "validation"), "export.lerobot.validation"),
        ({"levels": 1}, ("plan", "axes", "camera"), "plan.axes.camera.levels: expected a list, such as [1, 2], got 1"),
        ({"levels": [9]}, ("plan", "axes", "camera"), "plan.axes.camera.levels.0: expected 1, 2, 3, 4 or 5, got 9"),
        ({"components": None, "distance": None}, ("plan", "axes", "camera"), "plan.axes.camera.components: expected a"),
        ("high", ("render", "jpeg_quality"), "render.jpeg_quality: expected a whole number, got 'high'"),
        ("My run", ("name",), "name: expected a lower-case letter, then lower-case letters, digits or underscores"),
        ({}, ("export", "lerobot_v21"), "export.lerobot_v21.convention: this field is required"),
        (3, ("plan", "sed"), "plan.sed: unknown field; did you mean seed?"),
        (
            {"camera": {"distance": {"distance_scale": [[[1, 2]]]}}},
            ("plan", "axes"),
            "distance_scale: expected more entries than 1",
        ),
        (
            "libero_goal/*",
            ("demos", "tasks"),
            "demos.tasks: expected a list, such as [libero_goal/*], got 'libero_goal/*'",
        ),
        ("slrum", ("compute", "cluster"), "compute.cluster: expected local, loop, slurm, or an address such as tcp://"),
        (
            {"libero_goal/put_the_bowl_on_plate": 2},
            ("plan", "task_weights"),
            "did you mean libero_goal/put_the_bowl_on_the_plate?",
        ),
        ("no.yaml", ("plan", "axes", "language", "bank"), "plan.axes.language.bank: there is no such file (got "),
        ({"background": {"colour_scale": [0.2, 0.4, 0.6, 0.8, 2.0]}}, ("plan", "axes"), "colour_scale.4"),
    ],
)
def test_faults_name_file_and_field(tmp_path: Path, value: Any, keys: tuple[str, ...], message: str) -> None:
    file = changed(tmp_path, value, *keys)
    with pytest.raises(PipelineError) as caught:
        load(file)
    assert message in str(caught.value)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ({"level": [1, 5]}, "export.where.level: the run has no 5, expected values [0, 1, 2]"),
        ({"component": ["spherical"]}, "export.where.component: the run has no 'spherical', expected values ["),
        ({"level": [0, 2], "component": ["clean", "distance"]}, None),
    ],
)
def test_an_export_selects_levels_and_components_that_the_plan_samples(
    where: dict[str, Any], message: str | None, tmp_path: Path
) -> None:
    file = tmp_path / "one.yaml"
    plan = {"axes": {"camera": {"levels": [1, 2], "components": ["distance"]}}, "episodes": {"camera": 1}}
    file.write_text(yaml.safe_dump({"name": "one", "plan": plan, "export": {"rlds": {}, "where": where}}))
    if message is None:
        assert load(file).export.where == Where.model_validate(where)
        return
    with pytest.raises(PipelineError) as caught:
        load(file)
    assert message in str(caught.value)


@pytest.mark.parametrize("axes", ["", "\n    camera:\n    noise: {levels: [3]}"])
def test_an_axis_whose_options_are_all_comments_has_its_defaults(axes: str, tmp_path: Path) -> None:
    file = tmp_path / "comments.yaml"
    file.write_text(f"name: comments\nplan:\n  axes:{axes}\n  episodes: {{camera: 1, noise: 1}}\n")
    plan = load(file).plan
    assert plan.axes.camera == CameraAxis()
    assert plan.axes.noise
    assert plan.axes.noise.levels == ((3,) if axes else LEVELS)


@pytest.mark.parametrize("keys", [("name",), ("export", "rlds", "name"), ("export", "lerobot", "name")])
def test_names_of_more_than_60_characters_are_rejected(keys: tuple[str, ...], tmp_path: Path) -> None:
    longest = "libero" + "e" * 54
    load(changed(tmp_path, longest, *keys))
    with pytest.raises(PipelineError, match=f"{'.'.join(keys)}: expected at most 60 characters, got"):
        load(changed(tmp_path, longest + "e", *keys))


@pytest.mark.parametrize(("suite", "task"), [("kitchen", "t" * 61), ("k" * 61, "turn_on")])
def test_own_suites_and_tasks_of_more_than_60_characters_are_rejected(
    suite: str, task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LIBERO's own names are as long as they are: 85 characters in LIBERO-90."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tasks" / suite).mkdir(parents=True)
    source = libero_folder() / "bddl_files" / "libero_goal" / "turn_on_the_stove.bddl"
    shutil.copy(source, tmp_path / "tasks" / suite / f"{task}.bddl")
    plan = {"axes": {"noise": {}}, "episodes": {"noise": 1}}
    file = tmp_path / "long.yaml"
    file.write_text(yaml.safe_dump({"name": "long", "plan": plan, "demos": {"root": "demos", "tasks": [f"{suite}/*"]}}))
    with pytest.raises(PipelineError, match=r"demos: .*has 61 characters, expected at most 60"):
        load(file)
    file.write_text(yaml.safe_dump({"name": "long", "plan": plan, "demos": {"tasks": ["libero_90/*"]}}))
    load(file)


def tracked_folders() -> list[str]:
    listed = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout
    return sorted({line.partition("/")[0] for line in listed.splitlines() if "/" in line})


def places() -> list[Path]:
    """Folders of the user and of the checkout, each named in another way than the simplest."""
    inside = [REPOSITORY / "docs" / ".." / name / "run" for name in tracked_folders()]
    return [*inside, *(path.parent for path in inside), REPOSITORY, REPOSITORY.parent, Path.home(), Path("/usr/../")]


@pytest.mark.parametrize("place", places(), ids=str)
def test_no_run_has_a_folder_of_the_checkout_or_the_home_folder(place: Path, tmp_path: Path) -> None:
    """Here through a link, as the pattern of `name` would stop most."""
    (tmp_path / "base").symlink_to(place)
    fields = yaml.safe_load((REPOSITORY / "configs" / "starter.yaml").read_text())
    file = tmp_path / "base.yaml"
    file.write_text(yaml.safe_dump(fields | {"name": "base", "folder": str(tmp_path)}))
    with pytest.raises(PipelineError, match=r"folder: .* (of the checkout|the home folder)"):
        load(file)


@pytest.mark.parametrize(("folder", "root"), [("demos", "demos/run"), ("demos", "demos"), (".", "run/demos")])
def test_no_run_is_stored_among_demonstrations(
    folder: str, root: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    demos = {"root": root, "tasks": ["libero_goal/*"]}
    plan = {"axes": {"noise": {}}, "episodes": {"noise": 10}}
    file = tmp_path / "run.yaml"
    fields = {"name": "run", "folder": str(tmp_path / "elsewhere" / ".." / folder), "demos": demos, "plan": plan}
    file.write_text(yaml.safe_dump(fields))
    with pytest.raises(PipelineError, match=r"overlaps with demos\.root"):
        load(file)
    file.write_text(yaml.safe_dump(fields | {"folder": "data"}))
    load(file)


@pytest.mark.parametrize("name", ["data", "testset"])
def test_no_run_is_stored_where_all_runs_store(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "run.yaml"
    plan = {"axes": {"noise": {}}, "episodes": {"noise": 10}}
    folder = "." if name == "data" else "data/../data"
    file.write_text(yaml.safe_dump({"name": name, "folder": folder, "plan": plan}))
    with pytest.raises(PipelineError, match="all runs share the folder"):
        load(file)


@pytest.mark.slow
def test_missing_and_broken_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(REPOSITORY)
    with pytest.raises(PipelineError, match=r"no\.yaml: there is no such configuration"):
        load(tmp_path / "no.yaml")
    with pytest.raises(PipelineError, match=r"did you mean configs/starter\.yaml\?"):
        load(Path("configs/startr.yaml"))
    (tmp_path / "empty.yaml").write_text("# Nothing yet.\n")
    with pytest.raises(PipelineError, match=r"empty\.yaml: the file is empty"):
        load(tmp_path / "empty.yaml")
    (tmp_path / "tab.yaml").write_text("plan:\n\tseed: 1\n")
    with pytest.raises(PipelineError, match=r"(?s)tab\.yaml.* in line 2, column 1.*use spaces as indents"):
        load(tmp_path / "tab.yaml")
    (tmp_path / "quote.yaml").write_text('name: "mine\nplan:\n  episodes: {light: 1}\n')
    with pytest.raises(PipelineError, match=r"while scanning a quoted scalar in line 1, column 7") as caught:
        load(tmp_path / "quote.yaml")
    assert "indents" not in str(caught.value)

    for text in ("plan: [1,\n", "[" * 1500 + "]" * 1500):
        (tmp_path / "broken.yaml").write_text(text)
        with pytest.raises(PipelineError, match="not valid YAML"):
            load(tmp_path / "broken.yaml")
    (tmp_path / "latin.yaml").write_bytes("name: übung\n".encode("latin-1"))
    with pytest.raises(PipelineError, match="cannot read the configuration"):
        load(tmp_path / "latin.yaml")


@pytest.mark.parametrize(
    "text", ["name: dup\nplan: {seed: 5}\nplan: {episodes: {light: 3}}", "plan: {episodes: {camera: 2, camera: 1}}"]
)
def test_a_key_that_is_given_twice_is_rejected(tmp_path: Path, text: str) -> None:
    (tmp_path / "dup.yaml").write_text(text)
    with pytest.raises(
        PipelineError, match=r"dup\.yaml.*not valid YAML: the key '(plan|camera)' is repeated in line \d"
    ):
        load(tmp_path / "dup.yaml")


def test_aliases_that_unfold_without_end_are_rejected_at_once(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    (tmp_path / "bomb.yaml").write_text("\n".join([*lines, "name: *a11\n"]))
    with pytest.raises(PipelineError, match="name: expected text, got"):
        load(tmp_path / "bomb.yaml")


THREE_LINES = "name: mine\nplan:\n  episodes: {camera: 40, camera+language: 8}\n"


def test_three_lines_are_a_whole_run(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(THREE_LINES)
    jsonschema.validate(yaml.safe_load(THREE_LINES), schemas()["config.schema.json"])
    config = load(file)
    assert config.run_folder == Path("data/mine")
    assert {name for name, axis in config.plan.axes if axis} == {"camera", "language"}
    assert (config.plan.reserve, config.replay.mode, config.demos.source) == (0.5, "auto", "starter")
    assert config.export.name == "libero_mine"
    assert {name: one.name for name, one in config.export.formats.items()} == dict.fromkeys(
        ("rlds", "lerobot"), "libero_mine"
    )


@pytest.mark.parametrize(
    ("axis", "replay", "message"),
    [
        ("disturbance", "noops: keep", r"disturbance requires replay\.noops: drop"),
        ("disturbance", "mode: open_loop", r"disturbance requires replay\.mode: auto or tracked"),
        ("goal", "mode: open_loop", r"goal requires replay\.mode: auto or tracked"),
    ],
)
def test_axes_reject_a_replay_that_cannot_perform_them(axis: str, replay: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "run.yaml"
    file.write_text(f"{{name: run, plan: {{episodes: {{{axis}: 1}}}}, replay: {{{replay}}}}}")
    with pytest.raises(PipelineError, match=message):
        load(file)


def test_sampled_rewrites_need_the_format_whose_client_samples_them() -> None:
    run = {"name": "run", "plan": {"episodes": {"noise": 1}}, "finetune": {"rewrite_probability": 0.5}}
    assert Config.model_validate(run).finetune.rewrite_probability == 0.5
    with pytest.raises(ValidationError, match=r"rewrite_probability requires export\.rlds"):
        Config.model_validate(run | {"export": {"rlds": None}})


def test_the_examples_of_the_documentation_are_valid() -> None:
    text = (REPOSITORY / "docs" / "configuration.md").read_text()
    examples = [yaml.safe_load(block) for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)]
    whole = [example for example in examples if "name" in example]
    assert len(whole) == 1
    everything = yaml.safe_load((REPOSITORY / "configs" / "small.yaml").read_text())
    for example in examples:
        if "axes" in example:
            example = {"plan": everything["plan"] | example}
        if {"plan", "export"}.intersection(example):
            Config.model_validate(everything | example)


def test_a_folder_of_demonstrations_is_of_hdf5_files_and_one_format_is_enough(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        THREE_LINES + "demos: {root: d}\nfolder: /big/disk\nexport: {rlds: {validation: 0.1}, lerobot: null}"
    )
    config = load(file)
    assert config.demos.source == "hdf5"
    assert config.run_folder == Path("/big/disk/mine")
    assert list(config.export.formats) == ["rlds"]
    assert config.export.name == config.export.formats["rlds"].name == "libero_mine"


def test_a_path_may_begin_at_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "bank.yaml").write_text("{}")
    file = tmp_path / "mine.yaml"
    own = "{sources: [{folder: ~/own, licence: mine}]}"
    axes = f"{{language: {{bank: ~/bank.yaml}}, background: {own}}}"
    plan = f"plan: {{episodes: {{language: 1, background: 1}}, axes: {axes}}}"
    file.write_text(f"name: mine\ndemos: {{root: ~/d}}\nfolder: ~/runs\n{plan}")
    config = load(file)
    language, background = (config.plan.axes.configured()[axis] for axis in ("language", "background"))
    assert isinstance(language, LanguageAxis)
    assert isinstance(background, BackgroundAxis)
    (source,) = background.sources
    assert isinstance(source, Folder)
    found = [config.folder, config.demos.root, language.bank, source.folder]
    assert found == [tmp_path / name for name in ("runs", "d", "bank.yaml", "own")]


@pytest.mark.parametrize("fields", ["plan: {episodes: {camera: true}}", "plan: {seed: true, episodes: {camera: 1}}"])
def test_true_is_no_number(fields: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(f"name: mine\n{fields}")
    with pytest.raises(PipelineError, match=r"plan\.(episodes\.camera|seed): expected a number \(got True\)"):
        load(file)


@pytest.mark.parametrize("fields", ["folder: ~nobody_here/runs", "demos: {root: ~nobody_here/demos}"])
def test_an_unknown_home_folder_is_named(fields: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(f"name: mine\n{fields}\nplan: {{episodes: {{camera: 1}}}}")
    with pytest.raises(PipelineError, match=r"(folder|demos\.root): the home folder of ~ is unknown here"):
        load(file)


def test_a_user_without_a_home_folder_reads_a_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that runs under a number. Python reports it by this error."""

    def without_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", without_home)
    assert load(REPOSITORY / "configs" / "starter.yaml").name == "starter"
    assert find_missing_parent(Path("/nowhere/runs")) == Path("/nowhere")


@pytest.mark.parametrize(
    ("suite", "task"), [("libero_goal", "put_the_bowl_on_the_plat"), ("libero_gaol", "put_the_bowl_on_the_plate")]
)
def test_a_bank_of_a_task_that_does_not_exist_is_rejected(suite: str, task: str, tmp_path: Path) -> None:
    """The shipped bank has the task's rewrites, so a plan would leave out those of the misspelt one without a word."""
    bank = tmp_path / "bank.yaml"
    bank.write_text(yaml.safe_dump({suite: {task: {"paraphrase": ["set the bowl upon the plate"]}}}))
    file = tmp_path / "mine.yaml"
    file.write_text(f"name: mine\nplan: {{episodes: {{language: 1}}, axes: {{language: {{bank: {bank}}}}}}}")
    with pytest.raises(PipelineError, match=rf"bank\.yaml: the bank has rewrites of an unknown task .*{suite}"):
        load(file)


def test_what_a_field_had_before_it_existed_leaves_no_trace() -> None:
    """Finished files are identified by settings: those of before must still be found."""
    config = load(STARTER)
    assert settings_of(config.export) == {
        "rlds": {"name": "libero_perturbed", "shards": 4, "validation": 0.0},
        "lerobot": {"name": "libero_perturbed", "parts": 4, "frames": "video", "validation": 0.0},
    }
    assert "folder" not in settings_of(config)
    # What the report quotes can be read again.
    assert Config.model_validate(config.model_dump(exclude_defaults=True)) == config


@pytest.mark.parametrize(
    ("where", "taken"),
    [
        ({}, {"twin", "weak", "strong", "both"}),
        ({"axis": ["camera"]}, {"weak", "strong"}),
        ({"axis": ["clean", "camera+light"]}, {"twin", "both"}),
        ({"component": ["distance", "diffuse"]}, {"weak", "both"}),
        ({"level": [0, 1, 2]}, {"twin", "weak"}),
        ({"level": [1, 2, 5], "axis": ["camera", "camera+light"]}, {"weak", "strong", "both"}),
        ({"suite": ["libero_goal"]}, {"weak", "both"}),
    ],
)
def test_where_takes_what_every_field_lists(where: dict[str, Any], taken: set[str]) -> None:
    episodes = {
        "twin": ("clean", "clean", "0", "libero_10"),
        "weak": ("camera", "distance", "1", "libero_goal"),
        "strong": ("camera", "spherical", "5", "libero_10"),
        "both": ("camera+light", "distance+diffuse", "2+5", "libero_goal"),
    }
    assert {name for name, columns in episodes.items() if Where.model_validate(where).takes(*columns)} == taken
