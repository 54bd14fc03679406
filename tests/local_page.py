"""A command in a process of its own that serves a page until Ctrl-C."""

import os
import signal
import subprocess
import sys


def begun(*words: str) -> tuple["subprocess.Popen[str]", str]:
    """`skope WORDS --port 0 -q` in a process that takes Ctrl-C, and the line that it prints with its address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "skope", *words, "--port", "0", "-q"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert process.stdout
    return process, process.stdout.readline()
