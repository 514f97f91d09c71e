"""Entry point of the program: an interrupt ends it without a traceback, even during start-up."""

import sys


def main() -> None:
    """Run the command line."""
    try:
        from rpim_opt.cli import main as run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted.\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
