"""Another recipe, quality or shape of frames makes other files, and only REMAKE=1 lets finished work be replaced."""

from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import pytest
import scipy

from pipeline import identity
from pipeline.config import RenderConfig
from pipeline.episode_schema import SCHEMA
from pipeline.errors import PipelineError
from pipeline.stores.frame_store import FrameStore


def test_a_missing_package_is_named() -> None:
    with pytest.raises(PipelineError, match=r"the package no-such-package is not installed\n  try: mv \.venv"):
        identity.made_with_recipe("a format", 1, ["no-such-package"])


@pytest.mark.parametrize("step", identity.RECIPES)
def test_another_recipe_repeats_its_step_and_all_that_build_on_it(step: identity.Step) -> None:
    before = {each: identity.fingerprint(each) for each in identity.RECIPES}
    with pytest.MonkeyPatch.context() as patch:
        identity._parts.cache_clear()
        patch.setitem(identity.RECIPES, step, identity.RECIPES[step] + 1)
        changed = {each for each in identity.RECIPES if identity.fingerprint(each) != before[each]}
    identity._parts.cache_clear()
    chain: list[identity.Step] = ["physics", "pixels", "encoding"]
    behind = {"checks", "pictures", *chain[chain.index(step) :]} if step in chain else {step}
    assert changed == behind


def test_a_step_states_the_versions_of_its_packages() -> None:
    stated = identity.made_with("physics")
    for package in (mujoco, np, scipy):
        assert stated[package.__name__] == package.__version__


def test_another_quality_and_another_shape_of_frames_are_other_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fingerprint(jpeg_quality: int = 95) -> str:
        return FrameStore(tmp_path, RenderConfig(jpeg_quality=jpeg_quality)).fingerprint

    today = fingerprint()
    assert fingerprint(80) != today
    smaller = SCHEMA.frame.model_copy(update={"shape": (128, 128, 3)})
    monkeypatch.setattr("pipeline.stores.frame_store.SCHEMA", SCHEMA.model_copy(update={"frame": smaller}))
    assert fingerprint() != today


@pytest.mark.parametrize("value", ["", "0", "no"])
def test_only_remake_1_allows_it(value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(identity.REMAKE, value)
    with pytest.raises(PipelineError, match="finished work would be generated again: 2 files"):
        identity.require_remake_permission(Counter({"files": 2}), tmp_path)
