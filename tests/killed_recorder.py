"""Record a LeRobot dataset as lerobot does, and wait to be killed in an episode.

lerobot 0.4 closes its tables at the end of a session: the first session has three episodes, the
second is killed after two more. In v2.1 the table of an episode is written, its video, its line.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from camera_files import encoded

from replay.logs.formats.lerobot_layout import table_of_tasks

FPS, LENGTHS, TASK = 10, (12, 9, 14, 8, 11), "push the cube"
KEY, PICTURE, STATE = "observation.images.cam", "observation.images.wrist", "observation.state"
SHAPES = {
    KEY: ("video", 48, 64, 3),
    PICTURE: ("image", 48, 64, 3),
    STATE: ("float32", 2),
} | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), ("int64", 1))
NAME = "chunk-{chunk_index:03d}/file-{file_index:03d}"
V21_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
V21_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"


def image(frame: int) -> np.ndarray[Any, Any]:
    """A bar that moves down the image, a row a frame."""
    pixels = np.full((48, 64, 3), 30, np.uint8)
    pixels[frame % 48] = 220
    return pixels


def write_video(file: Path, frames: range) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image(frame))))
        container.mux(stream.encode())


def frames_of(episode: int) -> range:
    return range(sum(LENGTHS[:episode]), sum(LENGTHS[: episode + 1]))


def table_of(episode: int) -> pa.Table:
    index = np.array(frames_of(episode))
    columns = {name: np.zeros(len(index), np.int64) for name in SHAPES if name.endswith("_index")}
    columns |= {"index": index, "episode_index": np.full(len(index), episode)}
    pictures = [{"bytes": encoded(image(number)), "path": f"{number}.png"} for number in index]
    states = [[number, 1.0] for number in index]
    return pa.table({**columns, PICTURE: pictures, STATE: pa.array(states, pa.list_(pa.float32()))})


def write_info(root: Path, version: str, episodes: int) -> None:
    v3 = version == "v3.0"
    info = {
        "codebase_version": version,
        "total_episodes": episodes,
        "total_frames": sum(LENGTHS[:episodes]),
        "total_tasks": 1,
        "chunks_size": 1000,
        "fps": FPS,
        "total_videos": episodes,
        "data_path": f"data/{NAME}.parquet" if v3 else V21_DATA,
        "video_path": f"videos/{{video_key}}/{NAME}.mp4" if v3 else V21_VIDEO,
        "features": {key: {"dtype": k, "shape": shape} for key, (k, *shape) in SHAPES.items()},
    }
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta/info.json").write_text(json.dumps(info, indent=4))


def session(root: Path, number: int, episodes: range, stack: contextlib.ExitStack) -> None:
    """Record episodes into the next files; `stack` lists the episodes and writes the footers."""
    first, rows = frames_of(episodes[0])[0], list[dict[str, Any]]()
    paths = [root / f"{f}/chunk-000/file-{number:03d}.parquet" for f in ("data", "meta/episodes")]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
    data = stack.enter_context(pq.ParquetWriter(paths[0], table_of(0).schema))
    stack.callback(lambda: pq.write_table(pa.Table.from_pylist(rows), paths[1]))
    for episode in episodes:
        frames = frames_of(episode)
        data.write_table(table_of(episode))
        file = root / f"videos/{KEY}/chunk-000/file-{number:03d}.mp4"
        write_video(file, range(first, frames.stop))
        row = {"episode_index": episode, "tasks": [TASK], "length": len(frames)}
        row |= {"dataset_from_index": frames[0], "dataset_to_index": frames.stop}
        for place in ("data", f"videos/{KEY}", "meta/episodes"):
            row |= {f"{place}/chunk_index": 0, f"{place}/file_index": number}
        row[f"videos/{KEY}/from_timestamp"] = (frames[0] - first) / FPS
        row |= {f"stats/{STATE}/{n}": [float(frames[0]), 1.0] for n in ("min", "max", "mean")}
        row |= {f"stats/{STATE}/std": [0.0, 0.0], f"stats/{STATE}/count": [len(frames)]}
        rows.append(row)
        write_info(root, "v3.0", episode + 1)


def record_v3(root: Path) -> None:
    write_info(root, "v3.0", 0)
    pq.write_table(table_of_tasks({TASK: 0}), root / "meta/tasks.parquet")
    with contextlib.ExitStack() as closed:
        session(root, 0, range(3), closed)
    with contextlib.ExitStack() as killed:
        session(root, 1, range(3, 5), killed)
        wait()


def record_v21(root: Path) -> None:
    write_info(root, "v2.1", 0)
    (root / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": TASK}) + "\n")
    for episode in range(4):
        places = {"episode_chunk": 0, "episode_index": episode, "video_key": KEY}
        table, video = (root / name.format(**places) for name in (V21_DATA, V21_VIDEO))
        table.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table_of(episode), table)
        if episode == 3:
            video.write_bytes(bytes(40))
            wait()
        write_video(video, frames_of(episode))
        write_info(root, "v2.1", episode + 1)
        row = {"episode_index": episode, "tasks": [TASK], "length": LENGTHS[episode], "stats": {}}
        for name in ("episodes", "episodes_stats"):
            with (root / f"meta/{name}.jsonl").open("a") as lines:
                lines.write(json.dumps(row) + "\n")


def wait() -> None:
    """Wait for the signal that kills the process while its files are open."""
    print("recording", flush=True)
    time.sleep(600)


if __name__ == "__main__":
    {"v3.0": record_v3, "v2.1": record_v21}[sys.argv[2]](Path(sys.argv[1]))
