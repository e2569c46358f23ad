"""Batch: processes and clusters, also where they are killed in the middle."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from batch_samples import OPTIONS, assert_whole, expected_states, states, tree
from batch_work import work

from MedColorLib import Settings, run_batch
from MedColorLib.cohort import workers as batch_workers
from MedColorLib.cohort.workers import WorkerLost, run_here, run_on_cluster, run_processes
from MedColorLib.errors import DeviceError, MissingPackageError
from MedColorLib.parameters import PRESETS

ROOT = Path(__file__).resolve().parents[3]


def tasks_of(folder: Path, *what: str) -> list[dict]:
    return [{"name": f"task{n}", "do": do, "seen": str(folder / "seen")} for n, do in enumerate(what)]


def answer(server: socket.socket, says: bytes | str | None) -> None:
    """Say the same to everybody (b"": hang up; "echo": what was said), until the server is closed."""
    with contextlib.ExitStack() as held, contextlib.suppress(OSError):
        while True:
            peer = held.enter_context(server.accept()[0])
            if says == b"":
                peer.close()
            elif says:
                peer.sendall(peer.recv(1 << 16) if says == "echo" else says)


def seen_in(folder: Path) -> list[str]:
    return sorted((folder / "seen").read_text().splitlines())


class TestWorkers:
    def test_here(self, tmp_path):
        results = dict(run_here(work, tasks_of(tmp_path, "", "raise", ""), lambda *_: None))
        assert (results[0], results[2]) == ("TASK0", "TASK2") and isinstance(results[1], ValueError)

    @pytest.mark.slow
    def test_a_killed_process_loses_nothing_of_others(self, tmp_path):
        tasks = tasks_of(tmp_path, "", "die once", "raise", "", "die", "")
        results = dict(run_processes(work, tasks, 2))
        assert [results[n] for n in (0, 1, 3, 5)] == ["TASK0", "TASK1", "TASK3", "TASK5"]
        assert isinstance(results[2], ValueError) and isinstance(results[4], WorkerLost)
        assert "killed 3 times" in str(results[4])
        counts = {"task1": 2, "task4": 3}
        assert seen_in(tmp_path) == [f"task{n}" for n in range(6) for _ in range(counts.get(f"task{n}", 1))]

    def test_stopped_when_the_caller_stops_asking(self, tmp_path):
        ended = run_processes(work, tasks_of(tmp_path, "", "wait", "wait", "wait"), 2)
        assert next(ended) == (0, "TASK0")
        while len(seen_in(tmp_path)) < 3:
            time.sleep(0.01)
        ended.close()
        assert (
            seen_in(tmp_path) == ["stopped", "stopped", "task0", "task1", "task2"]
            and not multiprocessing.active_children()
        )

    def test_processes_are_started_one_by_one(self, monkeypatch):
        starting, most = [], []

        class Pool(ThreadPoolExecutor):
            def __init__(self, *_):
                super().__init__(1)

            def submit(self, *_):
                starting.append(1)
                time.sleep(0.05)
                most.append(len(starting))
                starting.pop()
                return super().submit(str)

        monkeypatch.setattr(batch_workers, "ProcessPoolExecutor", Pool)
        assert dict(run_processes(threads_of, [None] * 4, 4)) == dict.fromkeys(range(4), "")
        assert most == [1] * 4

    def test_cores_are_shared_out(self, monkeypatch):
        monkeypatch.setattr(batch_workers, "_cores", lambda: 7)
        assert dict(run_processes(threads_of, [None] * 2, 5)) == {0: 3, 1: 3}


def threads_of(_task, progress=None, cancelled=None) -> int:
    import torch

    return torch.get_num_threads()


@pytest.fixture
def killer(cohort):
    """Kills one process, given by a function, as soon as matches of a volume are on disk; says how many it killed."""
    killed = []

    def start(victim) -> list:
        def watch() -> None:
            while not list(Path("out").glob(".unfinished/*/[!.]*.safetensors")):
                time.sleep(0.002)
            pid = victim()
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

        threading.Thread(target=watch, daemon=True).start()
        return killed

    return start


@pytest.mark.slow
class TestKilledInTheMiddle:
    """Whole volumes on the raster of the preset, in other processes."""

    @pytest.fixture(autouse=True)
    def one_by_one(self, monkeypatch):
        # `small_raster` of the classes above lasts for the file, and other processes do not know it
        monkeypatch.setitem(PRESETS, "draft", replace(PRESETS["draft"], grid_px=160))
        self.settings = Settings(preset="draft", features="embedded", device="cpu", batch=1)

    def test_a_worker_of_the_pool(self, cohort, killer, caplog):
        killed = killer(lambda: multiprocessing.active_children()[0].pid)
        result = run_batch("in", ["section.png"], "out", self.settings, workers=2)
        assert states(result) == expected_states("done") and len(killed) == 1
        assert [r.getMessage() for r in caplog.records] == [
            "batch: a worker process was killed; its volume is done again"
        ]
        assert_whole(Path("out"), self.settings)

    def test_a_worker_of_a_cluster(self, cohort, killer):
        distributed = pytest.importorskip("distributed")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=60
        ) as cluster:
            busy = lambda: next(iter(cluster.workers.values())).pid  # noqa: E731 (asked when it is time)
            killed = killer(busy)
            result = run_batch("in", ["section.png"], "out", self.settings, scheduler=cluster.scheduler_address)
            assert states(result) == expected_states("done") and len(killed) == 1
            assert_whole(Path("out"), self.settings)
            again = run_batch("in", ["section.png"], "out", self.settings, scheduler=cluster.scheduler_address)
            assert states(again) == expected_states("skipped")

    @pytest.mark.skipif(not Path("/proc/self").exists(), reason="children are found in /proc")
    def test_the_whole_command(self, cohort):
        """Its workers end with it; the next run finishes what is left."""
        command = [sys.executable, "-m", "MedColorLib", "batch", "in", *OPTIONS, "-o", "out", "--workers", "2"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        run = subprocess.Popen(command, env=environment)
        while not list(Path("out").glob("[!.]*-colored.json")):  # those with a dot are being written
            assert run.poll() is None
            time.sleep(0.002)
        children = [int(pid) for pid in Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()]
        run.kill()
        run.wait()
        while any(alive(pid) for pid in children):
            time.sleep(0.01)
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 1 and "finished before" in done.stdout and "4 of 5 volumes" in done.stdout
        assert_whole(Path("out"), self.as_said())

    def test_ctrl_c_reaches_all_processes(self, cohort):
        """As a terminal sends it. Every process ends by itself; a temporary file is nowhere; the same command goes on."""
        command = [sys.executable, "-m", "MedColorLib", "batch", "in", *OPTIONS, "-o", "out", "--workers", "2"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        run = subprocess.Popen(command, env=environment, start_new_session=True, preexec_fn=_heed_ctrl_c, **pipes)  # noqa: PLW1509
        while not list(Path("out").rglob("[!.]*-colored.json")):  # those with a dot are being written
            assert run.poll() is None
            time.sleep(0.002)
        os.killpg(run.pid, signal.SIGINT)
        printed, said = run.communicate()
        assert run.returncode == 130 and printed == ""
        assert said.splitlines()[-1] == "medcolor: interrupted; finished volumes are kept, the same command goes on"
        assert "Traceback" not in said and not [n for n in tree(Path("out")) if "-unfinished-" in n or ".part" in n]
        assert json.loads(Path("out/batch.json").read_text())["counts"]["not reached"] > 0
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 1 and "finished before" in done.stdout
        assert_whole(Path("out"), self.as_said())

    def as_said(self) -> Settings:
        """The settings that the summary names."""
        return Settings.from_dict(json.loads(Path("out/batch.json").read_text())["settings"])


def _heed_ctrl_c() -> None:
    """As in the foreground: what a shell starts in the background ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def alive(pid: int) -> bool:
    """Running, not a zombie that nobody has asked for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


class TestCluster:
    def test_no_scheduler_answers(self, monkeypatch):
        pytest.importorskip("distributed")
        monkeypatch.setattr(batch_workers, "CONNECT_SECONDS", 1)
        monkeypatch.setattr(batch_workers, "ANSWER_SECONDS", 0.5)
        for address in ("tcp://127.0.0.1:1", "nonsense://x", "x"):
            with pytest.raises(DeviceError, match=f"scheduler {address}: no Dask scheduler answers there within 1 s"):
                run_on_cluster(work, [], address)

    @pytest.mark.parametrize(
        "says", [None, b"", b"HTTP/1.1 400 Bad Request\r\n\r\n" * 50, bytes(5000), b"\xff" * 64, "echo"]
    )
    def test_a_peer_that_is_silent_or_speaks_garbage(self, says, monkeypatch):
        """In time: `ANSWER_SECONDS` bounds it, and what would wait for ever is never reached."""
        distributed = pytest.importorskip("distributed")
        monkeypatch.setattr(batch_workers, "ANSWER_SECONDS", 1)
        monkeypatch.setattr(distributed, "Client", lambda *_, **__: pytest.fail("would not come back"))
        with socket.create_server(("127.0.0.1", 0)) as server:
            threading.Thread(target=answer, args=(server, says), daemon=True).start()
            address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
            with pytest.raises(DeviceError, match=f"scheduler {address}: no Dask scheduler answers there within 10 s"):
                run_on_cluster(work, [], address)

    def test_stopped_when_the_caller_stops_asking(self, tmp_path):
        distributed = pytest.importorskip("distributed")
        with distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=2,
            processes=False,
            protocol="tcp",
            host="127.0.0.1",
            dashboard_address=None,
            silence_logs=60,
        ) as cluster:
            ended = run_on_cluster(work, tasks_of(tmp_path, "raise", "wait"), cluster.scheduler_address)
            number, error = next(ended)
            assert number == 0 and isinstance(error, ValueError)
            ended.close()
            while "stopped" not in seen_in(tmp_path):
                time.sleep(0.01)
        assert seen_in(tmp_path) == [*["stopped"], *["task0"] * (1 + batch_workers.RETRIES), "task1"]

    def test_no_worker(self, monkeypatch):
        distributed = pytest.importorskip("distributed")
        monkeypatch.setattr(batch_workers, "CONNECT_SECONDS", 1)
        with (
            distributed.LocalCluster(
                n_workers=0, processes=False, host="127.0.0.1", protocol="tcp", dashboard_address=None, silence_logs=60
            ) as cluster,
            pytest.raises(DeviceError, match="has no workers; start one with 'dask worker tcp"),
        ):
            run_on_cluster(work, [], cluster.scheduler_address)

    def test_dask_is_not_installed(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "distributed", None)
        with pytest.raises(MissingPackageError, match=r"run: pip install 'medcolor\[cluster\]'"):
            run_on_cluster(work, [], "tcp://127.0.0.1:1")
