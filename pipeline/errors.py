"""One exception type for everything a user can cause and mend."""

from functools import partial

MAKE_AGAIN = "python -m pipeline run CONFIG"
"""The remedy where something that a run makes is missing or damaged. `dvc repro` would perform the run that params.yaml names."""


class PipelineError(Exception):
    """Says what is wrong, where, what was expected and what to try.

    Args:
        what: the fault, one sentence without a full stop.
        where: the file, field or row it was found in.
        expected: what would have been right (list the values that would have worked).
        remedy: the command or edit that mends it.
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
        # Keyword-only arguments need this to survive the trip back from a worker process.
        where = None if self.where is None else str(self.where)
        return partial(PipelineError, self.what, where=where, expected=self.expected, remedy=self.remedy), ()


class RefusedError(Exception):
    """A perturbation that does not go with its scene.

    Args:
        reason: short and in snake_case, such as ``robot_in_collision``.
    """

    def __init__(self, reason: str):
        super().__init__(reason)
        self.reason = reason
