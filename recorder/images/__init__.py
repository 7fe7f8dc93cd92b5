"""Images in messages and files of others: decoded, made gray and small."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "recorder.images.messages": "image_decoder",
        "recorder.images.pixels": "MalformedImage raw_image shrink",
    },
)
