"""Results on their way into an S3 bucket, and back from there."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {"replay.uploads.objects": "objects_below", "replay.uploads.results": "fetch upload"},
)
