"""Exception type for every fault that a user can cause and correct."""

from functools import partial

MAKE_AGAIN = "python -m pipeline run CONFIG"
"""Remedy where an output of a run is missing or damaged. `dvc repro` would run the configuration in params.yaml."""

RUN_AGAIN = f"run `{MAKE_AGAIN}`"
"""``MAKE_AGAIN`` as part of a sentence."""


class PipelineError(Exception):
    """Error that states the fault, its place, the expected value and a remedy.

    Args:
        what: the fault, one sentence without a full stop.
        where: the file, field or row of the fault.
        expected: a correct value (list the values that would have worked).
        remedy: the command or edit that corrects the fault.
    """

    def __init__(self, what: str, *, where: object = None, expected: str | None = None, remedy: str | None = None):
        self.what, self.where, self.expected, self.remedy = what, where, expected, remedy
        lines = [what if where is None else f"{where}: {what}"]
        if expected is not None:
            lines.append(f"  expected: {expected}")
        if remedy is not None:
            lines.append(f"  try: {remedy}")
        super().__init__("\n".join(lines))

    def __reduce__(self) -> tuple[object, ...]:
        # Exceptions with keyword-only arguments cannot be pickled otherwise, on their way back from a worker process.
        where = None if self.where is None else str(self.where)
        return partial(PipelineError, self.what, where=where, expected=self.expected, remedy=self.remedy), ()


class RejectedError(Exception):
    """A perturbation that is rejected in its scene.

    Args:
        reason: short and in snake_case, such as ``robot_in_collision``.
    """

    def __init__(self, reason: str):
        super().__init__(reason)
        self.reason = reason
