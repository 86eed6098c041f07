"""Stage inputs: write out the configuration, list the user's own files, and look whether stored ones have changed.

So DVC notices what it cannot see itself.
"""

from pipeline.files import write_json
from pipeline.run import export, inputs
from pipeline.run.run import INPUTS, SETTINGS, Run
from pipeline.run.stage import main


def run(run: Run) -> None:
    write_json(run.path(SETTINGS), inputs.settings(run.config))
    write_json(run.path(INPUTS), inputs.listing(run.config))
    run.trajectories.notice_changes()
    run.frames.notice_changes()
    for dataset in (*run.formats, *run.failure_formats):
        export.notice_changes(dataset)


if __name__ == "__main__":
    main(run, __doc__)
