"""The `warp-reflect` command, and `python -m warp_reflect`."""

import gc
import os
import sys
from contextlib import suppress

# Of the `render` command's arguments: with one of these another process or device makes the frames, or none may be to make.
ELSEWHERE = ("cuda", "--workers", "--scheduler", "--resume", "--print-job")


def main() -> int:
    """Run the command line; returns the exit code."""
    # Importing Warp and the kernels makes a million objects that all stay: searching them for garbage, again and again, would
    # take a fifth of the import.
    gc.disable()
    try:
        _begin_to_compile(sys.argv[1:])
        from warp_reflect import cli
    finally:
        gc.freeze()
        gc.enable()
    return cli.main()


def _begin_to_compile(arguments: list[str]) -> None:
    """What every frame asks for first, and the header that all kernels need, while the rest is still imported."""
    stages = [each for each in arguments[1:] if os.path.isfile(each)]
    if arguments[:1] != ["render"] or not stages or any(word in each for each in arguments for word in ELSEWHERE):
        return
    from warp_reflect import devices, kernels

    with suppress(OSError):  # is said where the device is opened for the command
        kernels.begin(["vector"], devices.open_device("cpu"))


if __name__ == "__main__":
    sys.exit(main())
