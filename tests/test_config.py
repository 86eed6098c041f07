"""The configuration: what is not understood is refused, by file, field and remedy."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from conftest import REPOSITORY

from pipeline.__main__ import config_schema, schemas
from pipeline.config import load
from pipeline.errors import PipelineError

STARTER = REPOSITORY / "configs" / "starter.yaml"


def changed(path: Path, value: Any, *keys: str) -> Path:
    config = yaml.safe_load(STARTER.read_text())
    section = config
    for key in keys[:-1]:
        section = section[key]
    section[keys[-1]] = value
    file = path / "changed.yaml"
    file.write_text(yaml.safe_dump(config))
    return file


@pytest.mark.parametrize("file", sorted((REPOSITORY / "configs").glob("*.yaml")), ids=lambda file: file.stem)
def test_every_config_is_valid_and_named_after_its_file(file: Path) -> None:
    assert load(file).name == file.stem
    jsonschema.validate(yaml.safe_load(file.read_text()), config_schema())


@pytest.mark.parametrize("name", ["config.schema.json", "manifest.json"])
def test_schema_file_is_that_of_the_code(name: str) -> None:
    stored = json.loads((REPOSITORY / "schemas" / name).read_text())
    assert stored == schemas()[name], "run: python -m pipeline schema"


@pytest.mark.parametrize(
    ("value", "keys", "message"),
    [
        (1, ("render", "jpg_quality"), "render.jpg_quality: Extra inputs are not permitted"),
        (30, ("render", "jpeg_quality"), "render.jpeg_quality: Input should be greater than or equal to 50"),
        ("closed_loop", ("replay", "mode"), "replay.mode: Input should be"),
        ({"camera": 0, "noise": 1, "language": 1}, ("plan", "episodes"), "plan.episodes.camera"),
        ({"camera": 4}, ("plan", "episodes"), "axes and episodes must name the same axes"),
        ({"camera+camera": 4}, ("plan", "episodes"), "plan.episodes: Value error, 'camera+camera' names an axis twice"),
        ({"camera+wind": 4}, ("plan", "episodes"), "names no axis with 'wind', expected layout, pose"),
        ({"camera+": 4}, ("plan", "episodes"), "names no axis with ''"),
        (
            {"camera+light": 4, "light+camera": 2},
            ("plan", "episodes"),
            "'camera+light' is asked for twice, in two orders",
        ),
        (
            {
                "seed": 1,
                "axes": {"layout": {}, "language": {"classes": ["common_sense"]}},
                "episodes": {"language+layout": 4},
            },
            ("plan",),
            "language with added objects needs distraction or paraphrase",
        ),
        ({"camera": {"distance": {"distance_scale": [[[2, 1]]] * 5}}}, ("plan", "axes"), "with low <= high"),
        ({"camera": {"distance": {"distance_scale": [[[0, 1]]] * 5}}}, ("plan", "axes"), "a positive multiple"),
        ({"camera": {"spherical": {"elevation_deg": [[0, math.nan]]}}}, ("plan", "axes"), "finite number"),
        ({"robot": {"norm_rad": [0.1, 0.2, 0.3, 0.4, math.inf]}}, ("plan", "axes"), "finite number"),
        (2**63, ("plan", "seed"), "plan.seed: Input should be less than"),
        ({"camera": 10**9}, ("plan", "episodes"), "plan.episodes.camera: Input should be less than"),
        ({"wind": {}}, ("plan", "axes"), "plan.axes.wind: Extra inputs"),
        ("/tmp", ("demos", "root"), "root goes with source: hdf5"),
        ("carrier pigeon", ("compute",), "compute"),
        ("my_set", ("export", "rlds", "name"), "export.rlds.name"),
        ("libero_aloha", ("export", "rlds", "name"), "a name with libero and without aloha in it"),
        (0.6, ("export", "rlds", "validation"), "export.rlds.validation: Input should be less than or equal to 0.5"),
        (1e-320, ("export", "lerobot", "validation"), "export.lerobot.validation"),
        ({"background": {"colour_scale": [0.2, 0.4, 0.6, 0.8, 2.0]}}, ("plan", "axes"), "colour_scale.4"),
    ],
)
def test_faults_name_file_and_field(tmp_path: Path, value: Any, keys: tuple[str, ...], message: str) -> None:
    file = changed(tmp_path, value, *keys)
    with pytest.raises(PipelineError) as caught:
        load(file)
    assert message in str(caught.value)
    assert str(file) in str(caught.value)


def test_missing_and_broken_files(tmp_path: Path) -> None:
    with pytest.raises(PipelineError, match="cannot read the configuration"):
        load(tmp_path / "no.yaml")

    for text in ("plan: [1,\n", "[" * 1500 + "]" * 1500):
        (tmp_path / "broken.yaml").write_text(text)
        with pytest.raises(PipelineError, match="not valid YAML"):
            load(tmp_path / "broken.yaml")
    (tmp_path / "latin.yaml").write_bytes("name: übung\n".encode("latin-1"))
    with pytest.raises(PipelineError, match="cannot read the configuration"):
        load(tmp_path / "latin.yaml")


def test_aliases_that_unfold_without_end_are_refused_at_once(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    (tmp_path / "bomb.yaml").write_text("\n".join([*lines, "name: *a11\n"]))
    with pytest.raises(PipelineError, match="name: Input should be a valid string"):
        load(tmp_path / "bomb.yaml")


def test_unknown_task_pattern_names_the_closest(tmp_path: Path) -> None:
    config = load(changed(tmp_path, ["libero_goal/put_the_bowl_on_the_plat"], "demos", "tasks"))
    with pytest.raises(PipelineError, match="libero_goal/put_the_bowl_on_the_plate"):
        config.demos.index()
