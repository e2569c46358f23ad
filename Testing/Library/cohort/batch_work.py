"""Work that stands for colouring in the tests of batch workers; in a file of its own because other processes import it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path


def say(task: dict, text: str) -> None:
    with Path(task["seen"]).open("a", encoding="utf-8") as file:
        file.write(f"{text}\n")


def work(task: dict, progress=None, cancelled=None) -> str:
    """Leave a line in the file `seen` and do what the task says; one more line after waiting."""
    say(task, task["name"])
    if task["do"] == "die" or (task["do"] == "die once" and Path(task["seen"]).read_text().count(task["name"]) == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if task["do"] == "raise":
        raise ValueError("bad volume")
    while task["do"] == "wait" and not cancelled():
        time.sleep(0.01)
    if task["do"] == "wait":
        say(task, "stopped")
    return task["name"].upper()
