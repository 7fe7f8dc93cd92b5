"""Each kind of file that holds images or numbers as a stream of them."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.camera_logs.formats.bag": "BagImages",
        "replay.camera_logs.formats.lerobot": "LeRobotImages",
        "replay.camera_logs.formats.mcap_log": "McapImages",
        "replay.camera_logs.formats.picture_folder": "FolderImages",
        "replay.camera_logs.formats.table": "TableNumbers",
        "replay.camera_logs.formats.video": "VideoImages",
    },
)
