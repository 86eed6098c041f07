"""What lies in the user's own files is noticed when it changes."""

import os
from pathlib import Path

from pipeline.run import inputs


def test_a_file_is_known_by_its_content_and_a_large_one_by_its_time(tmp_path: Path) -> None:
    small, large = tmp_path / "small", tmp_path / "large"
    small.write_text("one")
    with large.open("wb") as opened:
        opened.truncate(16_000_001)
    before = {file: inputs._state(file) for file in (small, large)}
    for file in before:
        os.utime(file, ns=(1, 1))
    assert [inputs._state(file) == state for file, state in before.items()] == [True, False]
    small.write_text("two")
    assert inputs._state(small) != before[small]
