"""Run a command and print, as one line of JSON, how long it took, its largest resident memory, and what it said.

A process of its own, and a small one: Linux counts the memory of whoever starts a process among that process's own.
It is run as a script, without site packages.
"""

import json
import os
import subprocess
import sys
import tempfile
import time


def main(command: list[str]) -> None:
    """Run `command`."""
    with tempfile.TemporaryFile("w+") as said:
        began = time.perf_counter()
        process = subprocess.Popen(command, stdout=said, stderr=said)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        memory = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        result = {"seconds": seconds, "memory": memory, "said": said.read(), "code": process.returncode}
    print(json.dumps(result))


if __name__ == "__main__":
    main(sys.argv[1:])
