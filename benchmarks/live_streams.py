"""Live streams of 640x480 at 30 Hz, recorded and learned from at once, and what is lost of them."""

from __future__ import annotations

import contextlib
import http.server
import io
import itertools
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from PIL import Image

from benchmarks import foreign
from benchmarks.report import save
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.experiments.session import run_session
from recorder.cameras.live import LiveSource
from recorder.cameras.words import open_live
from recorder.images.options import InputOptions
from recorder.live import LiveRecorder

STREAMS = 4
FPS = 30.0
_LOST = ("repeated", "dropped", "missing", "late", "disordered", "lost")


class Sender(http.server.BaseHTTPRequestHandler):
    """Shows JPEGs at an even rate, as web cameras do."""

    jpegs: tuple[bytes, ...] = ()

    def do_GET(self) -> None:
        """Send pictures until nobody takes them."""
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        begin = time.monotonic()
        with contextlib.suppress(ConnectionError):
            for k in itertools.count():
                time.sleep(max(begin + k / FPS - time.monotonic(), 0))
                jpeg = self.jpegs[k % len(self.jpegs)]
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")

    def log_message(self, *_: object) -> None:
        """Say nothing."""


def send() -> None:
    """Serve pictures on a port of this machine, which is printed, until the input ends."""
    made = []
    for picture in foreign.pictures(30, *foreign.VGA):
        out = io.BytesIO()
        Image.fromarray(picture).convert("RGB").save(out, "JPEG", quality=80)
        made.append(out.getvalue())
    Sender.jpegs = tuple(made)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Sender)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    print(server.server_address[1], flush=True)
    sys.stdin.read()


def watch(folder: Path, seconds: float, streams: int = STREAMS) -> list[object]:
    """Record and learn for so long: CPU per second of ours and of the sender's, and the counts."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [sys.executable, "-m", "benchmarks.live_streams"]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as sender:
        assert sender.stdout is not None
        port = int(sender.stdout.readline())
        named = [f"http://127.0.0.1:{port}/{i}.mjpg" for i in range(streams)]
        source = open_live(named, InputOptions(rate=FPS, lost="end"))
        assert isinstance(source, LiveSource)
        cpu, wall = time.process_time(), time.perf_counter()
        end = wall + seconds
        with LiveRecorder(source, folder) as live:
            run_session(live, ProgressConfig(), stop=lambda: time.perf_counter() > end)
            counts = source.alignment
        wall = time.perf_counter() - wall
        cpu = time.process_time() - cpu
        assert sender.stdin is not None
        sender.stdin.close()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    theirs = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    row: list[object] = [streams, f"{wall:.0f}", round(cpu / wall, 2), round(theirs / wall, 2)]
    return row + [sum(count[name] for count in counts.values()) for name in _LOST]


def main(*, quick: bool = False) -> None:
    """Measure, and write results/live_streams.json."""
    with tempfile.TemporaryDirectory() as folder:
        watch(Path(folder) / "first", 1)  # imports what it needs
        row = watch(Path(folder) / "recording", 8 if quick else 60)
    header = ["streams", "seconds", "cores busy", "cores of the sender", *_LOST]
    save(
        "live_streams",
        "Live cameras",
        "JPEG streams of 640x480 at 30 Hz over HTTP from a process on the same machine, "
        "recorded and learned from at the same time. Frames dropped or lost are counted over "
        "all streams.",
        [(header, [row])],
    )


if __name__ == "__main__":
    send()
