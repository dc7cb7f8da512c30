"""Run the command: ``python -m ravg``, and the program ``ravg``."""

import sys

from ravg import check_packages


def main() -> int:
    """Run the command as `hybrid.cli.main` does; 1 and one line where another package hides one of ravg's."""
    try:
        check_packages()
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    from hybrid.cli import main as run

    return run()


if __name__ == "__main__":
    sys.exit(main())
