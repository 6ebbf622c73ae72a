"""``python -m gyrostab`` and the command ``gyrostab``: the command line, which may be interrupted while it still loads."""

import sys

__all__ = ["main"]


def main() -> int:
    """Run the command line; the exit code."""
    try:
        from gyrostab.cli import main as run

        return run()
    except KeyboardInterrupt:
        print("gyrostab: interrupted before it began; nothing was written.", file=sys.stderr)
        return 3


if __name__ == "__main__":
    sys.exit(main())
