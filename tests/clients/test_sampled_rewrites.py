"""Rewrites that OpenVLA-OFT's script samples for training; the loader itself is read by a benchmark."""

import argparse
from collections import Counter
from typing import Any

import pytest
from tiny_recipe import export_config, tiny_recipe

from pipeline.clients.recipe import build
from pipeline.clients.templates.run_openvla_oft import SampledRewrites, probability_of

REWRITES = (b"kindly put the bowl on the plate", b"the plate is where the bowl goes", b"place the bowl on the plate")
TEXT = b"\n".join((b"put the bowl on the plate", *REWRITES))
SAMPLE: dict[str, Any] = {"action": 1, "task": {"language_instruction": TEXT}}


def texts(probability: float, key: str, sample: dict[str, Any] = SAMPLE, samples: int = 4000) -> list[bytes]:
    sampled = SampledRewrites(lambda each: each["task"]["language_instruction"], probability, key)
    return [sampled(sample) for _ in range(samples)]


def test_samples_get_each_rewrite_equally_often_with_the_given_probability() -> None:
    counts = Counter(texts(0.8, "process 0"))
    assert counts.keys() == {b"put the bowl on the plate", *REWRITES}
    # Five standard deviations of a share of 4,000 samples are below 0.035.
    assert counts[b"put the bowl on the plate"] / 4000 == pytest.approx(0.2, abs=0.035)
    for rewrite in REWRITES:
        assert counts[rewrite] / 4000 == pytest.approx(0.8 / 3, abs=0.035)


def test_a_process_repeats_its_own_samples_and_no_others() -> None:
    assert texts(0.8, "process 0") == texts(0.8, "process 0")
    assert texts(0.8, "process 0") != texts(0.8, "process 1")


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_samples_without_rewrites_or_without_probability_keep_their_instruction(probability: float) -> None:
    alone = {"task": {"language_instruction": b"open the drawer"}}
    assert {*texts(probability, "any", alone)} == {b"open the drawer"}
    assert {*texts(0.0, "any")} == {b"put the bowl on the plate"}


def test_the_sample_itself_stays_unchanged() -> None:
    seen = SampledRewrites(lambda each: each, 1.0, "any")(SAMPLE)
    assert seen["action"] == 1
    assert seen["task"]["language_instruction"] in REWRITES
    assert SAMPLE["task"]["language_instruction"].count(b"\n") == len(REWRITES)


@pytest.mark.parametrize("text", ["-0.1", "1.1", "nan", "often"])
def test_only_probabilities_are_accepted(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="expected a probability from 0 to 1"):
        probability_of(text)


def test_the_recipe_has_the_probability_of_the_configuration(tmp_path: Any) -> None:
    assert tiny_recipe(tmp_path)["training"]["rewrite_probability"]["value"] == 0
    training = build(tmp_path / "manifest.parquet", [], export_config(), 0.8)["training"]
    assert training["rewrite_probability"]["value"] == 0.8
