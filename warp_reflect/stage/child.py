"""The child process of `guard.read_untrusted`: arguments on stdin as JSON, the answer as files in a folder."""

from __future__ import annotations

import json
import sys
from pathlib import Path


def main() -> int:
    """Read one stage under limits; 0 if there is an answer, be it an error message."""
    arguments = json.load(sys.stdin)
    folder = Path(arguments.pop("folder"))
    limit_memory(arguments.pop("memory_bytes"))
    from warp_reflect.pictures import with_pictures
    from warp_reflect.stage.guard import Limits
    from warp_reflect.stage.layers import check_layers
    from warp_reflect.stage.read import read_stage
    from warp_reflect.stage.transfer import save

    arguments["limits"] = Limits(**arguments["limits"])
    try:
        check_layers(arguments["path"], arguments["limits"])
        # Pictures can be hostile as well: they are decoded here too.
        save(with_pictures(read_stage(**arguments)), folder)
        answer = {}
    except (ValueError, FileNotFoundError) as fault:
        answer = {"error": str(fault), "kind": type(fault).__name__}
    except MemoryError:
        answer = {"error": f"reading {arguments['path']} ran out of memory", "kind": "ValueError"}
    (folder / "answer.json").write_text(json.dumps(answer))
    return 0


def limit_memory(size: int) -> None:
    """Bound the address space of this process and leave no core file."""
    try:
        import resource
    except ImportError:  # not on Windows: there the time limit alone holds
        return
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    sys.exit(main())
