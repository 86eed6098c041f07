"""What a step makes does not change unless its recipe number does."""

import golden_stages
import numpy as np
import pytest
from golden import Golden, recipes, recorded

from pipeline import gl, identity

REMEDY = "raise the recipe number of the step or format and run `python tests/campaigns/golden.py`"
GREY_LEVELS = 3.0
"""How far a cell of a thumbnail may be off on a renderer that is not recorded."""


@pytest.fixture(scope="module")
def golden() -> Golden:
    return Golden(recorded()["cases"])


def test_physics(golden: Golden) -> None:
    assert golden.physics() == recorded()["physics"][str(identity.RECIPES["physics"])], REMEDY


def test_pixels(golden: Golden) -> None:
    pixels = recorded()["pixels"][str(identity.RECIPES["pixels"])]
    thumbnails = golden.thumbnails()
    off = {name: np.abs(np.subtract(cells, pixels["thumbnails"][name])).max() for name, cells in thumbnails.items()}
    assert {name: levels for name, levels in off.items() if levels > GREY_LEVELS} == {}, REMEDY
    device = gl.choose().device
    # A renderer that is not recorded has been compared by thumbnails alone.
    assert golden.pixels() == pixels["devices"].get(device, golden.pixels()), REMEDY


def test_encoding(golden: Golden) -> None:
    assert golden.encoding() == recorded()["encoding"][str(identity.RECIPES["encoding"])], REMEDY


@pytest.mark.slow
@pytest.mark.parametrize("step", golden_stages.STEPS)
def test_stages_behind_the_frames(step: str) -> None:
    assert golden_stages.STEPS[step]() == recorded()[step][str(recipes()[step])], REMEDY


def test_every_recipe_has_golden_results() -> None:
    lacking = [step for step, number in recipes().items() if str(number) not in recorded().get(step, {})]
    assert lacking == [], "run `python tests/campaigns/golden.py`"


def test_a_changed_pixel_is_noticed(golden: Golden) -> None:
    before = golden.pixels()
    frame = golden.frames["clean agentview"]
    frame[128, 128, 0] ^= 1
    changed = {name for name, digest in golden.pixels().items() if digest != before[name]}
    frame[128, 128, 0] ^= 1
    assert changed == {"clean agentview"}
