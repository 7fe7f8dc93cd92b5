"""A network camera on loopback: RTSP (RFC 2326) with H.264 in RTP (RFC 6184), within its TCP."""

from __future__ import annotations

import contextlib
import re
import socketserver
import struct
import threading
import time
from collections.abc import Iterator
from typing import Any, Final

import av
import numpy as np

RATE: Final = 25
_TICKS: Final = 90_000 // RATE
_SESSION: Final = "Session: 1\r\n"
_OFFER: Final = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nc=IN IP4 127.0.0.1\r\nt=0 0\r\n"
    "m=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\n"
    f"a=framerate:{RATE}\r\na=control:track\r\n"
)


def pictures(count: int) -> Iterator[list[bytes]]:
    """A bar that moves, 64x48: the NAL units of each picture."""
    encoder: Any = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.framerate = 64, 48, "yuv420p", RATE
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency", "g": "10"}
    for k in range(count):
        gray = np.full((72, 64), 128, np.uint8)
        gray[:48] = 40
        gray[:48, k % 56 : k % 56 + 8] = 220
        for packet in encoder.encode(av.VideoFrame.from_ndarray(gray, format="yuv420p")):
            yield [unit for unit in re.split(b"\0\0\0?\1", bytes(packet)) if unit]


class Connection(socketserver.StreamRequestHandler):
    """Answers what a client asks for, and shows `server.shown` pictures once it asks to play."""

    server: RtspCamera

    def handle(self) -> None:
        with contextlib.suppress(OSError):
            while (lines := self._request())[0]:
                method, address = lines[0].split()[:2]
                number = next(line for line in lines if line.startswith("CSeq"))
                self._answer(method, address, f"RTSP/1.0 200 OK\r\n{number}\r\n")
                if method == "PLAY":
                    self._show()
                    return

    def _request(self) -> list[str]:
        lines = [self.rfile.readline().decode().strip()]
        while lines[-1]:
            lines.append(self.rfile.readline().decode().strip())
        return lines

    def _answer(self, method: str, address: str, head: str) -> None:
        headers = {
            "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n\r\n",
            "DESCRIBE": f"Content-Base: {address}/\r\nContent-Type: application/sdp\r\n"
            f"Content-Length: {len(_OFFER)}\r\n\r\n{_OFFER}",
            "SETUP": f"Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n{_SESSION}\r\n",
        }
        self.wfile.write((head + headers.get(method, f"{_SESSION}\r\n")).encode())

    def _show(self) -> None:
        sequence, started = 0, time.monotonic()
        for k, units in enumerate(pictures(self.server.shown)):
            for unit in units:
                marker = 0x80 if unit is units[-1] else 0
                head = struct.pack(">BBHII", 0x80, marker | 96, sequence, k * _TICKS, 7)
                sequence += 1
                self.wfile.write(b"$\0" + struct.pack(">H", len(head + unit)) + head + unit)
            time.sleep(max(started + (k + 1) / RATE - time.monotonic(), 0))


class RtspCamera(socketserver.ThreadingTCPServer):
    """A camera whose every connection ends after so many pictures."""

    daemon_threads = True

    def __init__(self, shown: int) -> None:
        super().__init__(("127.0.0.1", 0), Connection)
        self.shown = shown

    @property
    def address(self) -> str:
        """Its URL."""
        return f"rtsp://127.0.0.1:{self.server_address[1]}/left"


@contextlib.contextmanager
def rtsp_camera(shown: int) -> Iterator[str]:
    """The URL of such a camera while the body runs."""
    with RtspCamera(shown) as camera:
        thread = threading.Thread(target=camera.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield camera.address
        finally:
            camera.shutdown()
            thread.join()
