"""Damaged and hostile files are rejected with words; `python tests/campaigns/fuzz.py` tries a thousand."""

import random

import pytest
from fuzz import KINDS, check

KINDS_A_DAY, CASES = 4, 40


@pytest.mark.slow
def test_damaged_files_are_rejected_or_harmless() -> None:
    seed = 15
    kinds = random.Random(seed).sample(sorted(KINDS), KINDS_A_DAY)
    outcomes, faults = check(kinds, CASES, seed)
    assert faults == [], f"python tests/campaigns/fuzz.py --seed {seed} --cases {CASES} --kinds {' '.join(kinds)}"
    assert outcomes.total() >= CASES
