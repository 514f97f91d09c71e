"""The program: an interrupt is one word, also while the commands are loaded."""

import sys


def main() -> None:
    """Load the commands and run the one that was asked for."""
    try:
        from rpim_opt.cli import main as run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted.\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
