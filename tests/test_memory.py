"""No picture or message, however made, takes 512 MB to decode."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from waiting import python

MOST = 512

PEAK = """
import resource, sys
import numpy as np
from PIL import Image
from cdmisfa.core.errors import CdmisfaError
from recorder.images.pixels import MAX_PIXELS, raw_image
from recorder.images.whole import MalformedImage
from replay.camera_logs.opening import open_images
from replay.runs.modules import load_modules
from pathlib import Path
folder, size = Path(sys.argv[1]), (9000, 4000)
assert size[0] * size[1] == MAX_PIXELS
try:
    {work}
except (CdmisfaError, MalformedImage) as error:
    assert len(str(error)) < 500
line = next(x for x in open("/proc/self/status") if x.startswith("VmHWM"))
print(int(line.split()[1]) // 1024)
"""

MAKE = """
import sys
from PIL import Image
image = Image.new(sys.argv[2], (9000, 4000), 3)
image.save(sys.argv[1])
"""


def peak(folder: Path, work: str) -> int:
    """Megabytes that some work took at most, in a process of its own."""
    ran = python("-c", PEAK.replace("{work}", work), folder)
    assert ran.returncode == 0, ran.stderr
    return int(ran.stdout)


@pytest.mark.parametrize(
    ("mode", "name"),
    [("I;16", "1.png"), ("RGBA", "1.png"), ("CMYK", "1.jpg"), ("P", "1.png"), ("L", "1.png")],
)
def test_pictures(tmp_path: Path, mode: str, name: str) -> None:
    make = [sys.executable, "-c", MAKE, str(tmp_path / name), mode]
    subprocess.run(make, check=True)
    assert peak(tmp_path, "assert open_images(folder, None).image(0).shape == size[::-1]") < MOST


@pytest.mark.parametrize(("encoding", "size"), [("rgba8", 4), ("mono16", 2)])
def test_raw_images(tmp_path: Path, encoding: str, size: int) -> None:
    work = f"raw_image(bytes({size} * MAX_PIXELS), *size, {encoding!r})"
    assert peak(tmp_path, work) < MOST
