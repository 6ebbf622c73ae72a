"""Entry point of ``gyrostab`` and ``python -m gyrostab``; handles Ctrl-C while modules load."""

import sys


def main() -> int:
    """Run the command line and return the exit code."""
    try:
        from gyrostab.cli import main as run

        return run()
    except KeyboardInterrupt:
        print("gyrostab: interrupted before it began; nothing was written.", file=sys.stderr)
        return 3


if __name__ == "__main__":
    sys.exit(main())
