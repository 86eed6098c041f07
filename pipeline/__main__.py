"""Program ``python -m pipeline``, installed also as ``perturbed-libero``."""

import sys

from pipeline.machine_code import ensure_fixed_machine_code


def main() -> int:
    """Call the command that the command line names, and return its exit status."""
    ensure_fixed_machine_code()
    from pipeline.commands.command_line import run

    return run()


if __name__ == "__main__":
    sys.exit(main())
