"""The `warp-reflect` command, and `python -m warp_reflect`."""

import gc
import sys


def main() -> int:
    """Run the command line; returns the exit code."""
    # Importing Warp and the kernels makes a million objects that all stay: searching them for garbage, again and again, would
    # take a fifth of the import.
    gc.disable()
    try:
        from warp_reflect import cli
    finally:
        gc.freeze()
        gc.enable()
    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
