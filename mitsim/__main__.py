"""Entry point of ``mitsim`` and ``python -m mitsim``."""

import sys


def main() -> None:
    """Run the command line; Ctrl-C during its imports ends it as later ones do."""
    try:
        from mitsim.cli.program import main as run
    except KeyboardInterrupt:
        print("mitsim: interrupted", file=sys.stderr)
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
