"""Memory of a whole run, as the kernel counts it."""

from pathlib import Path

import pytest


@pytest.mark.slow
def test_the_largest_process_of_a_small_run_stays_within_a_bound(finished: Path) -> None:
    """Resident memory, mapped files included. One process performs all stages; three runs needed 3.4 to 3.6 GB."""
    largest_kb = int((finished.parent.parent / "largest_process_kb").read_text())
    assert 1024 * largest_kb < 3.8e9
