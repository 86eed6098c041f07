"""A record says whether finished work is up to date, and names what has changed."""

import pytest

from pipeline.record import Basis, Record

MADE_WITH = {"recipe of physics": "8", "numpy": "2.2.6"}
REQUESTED = {"settings": {"seed": 1, "episodes": {"camera": 4}}, "files": {"plan.parquet": "aa", "inputs.json": "bb"}}
RECORD = Record(Basis.of(REQUESTED, MADE_WITH), {"report.html": "cc"})


def test_the_same_basis_matches_also_after_a_round_through_json_and_in_another_order() -> None:
    reordered = {name: REQUESTED[name] for name in reversed(REQUESTED)}
    for requested in (REQUESTED, reordered, {**REQUESTED, "settings": {"seed": 1, "episodes": {"camera": 4}}}):
        basis = Basis.of(requested, dict(reversed(MADE_WITH.items())))
        assert RECORD.matches(basis)
        assert RECORD.describe_mismatch(basis) is None
    assert Basis.of({"axes": ("camera", "light")}, {}) == Basis.of({"axes": ["camera", "light"]}, {})


@pytest.mark.parametrize(
    ("requested", "made_with", "reason"),
    [
        ({**REQUESTED, "files": {"plan.parquet": "dd", "inputs.json": "bb"}}, MADE_WITH, "changed plan.parquet"),
        ({**REQUESTED, "files": {"plan.parquet": "aa"}}, MADE_WITH, "changed inputs.json"),
        ({**REQUESTED, "settings": {"seed": 2, "episodes": {"camera": 5}}}, MADE_WITH, "changed seed, episodes.camera"),
        (
            {"settings": 1, "files": {"a": "1", "b": "2"}},
            MADE_WITH,
            "changed settings, plan.parquet, inputs.json and 2 more",
        ),
        ({**REQUESTED, "optional": None}, MADE_WITH, "changed optional"),
        (REQUESTED, {**MADE_WITH, "numpy": "2.3.0"}, "numpy 2.2.6, here 2.3.0"),
        (REQUESTED, {**MADE_WITH, "mujoco": "3.2.7"}, "mujoco none, here 3.2.7"),
    ],
)
def test_what_differs_is_named(requested: object, made_with: dict[str, str], reason: str) -> None:
    basis = Basis.of(requested, made_with)
    assert not RECORD.matches(basis)
    assert RECORD.describe_mismatch(basis) == reason
    assert RECORD.same_request(basis) == (requested == REQUESTED)


def test_values_that_differ_between_tasks_can_be_left_out() -> None:
    basis = Basis.of(REQUESTED, {**MADE_WITH, "draws": "abc", "numpy": "2.3.0"})
    assert RECORD.describe_mismatch(basis, unnamed=("draws",)) == "other draws, numpy 2.2.6, here 2.3.0"
