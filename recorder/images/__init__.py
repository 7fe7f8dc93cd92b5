"""Images in messages and files of others: decoded, made gray and small."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "recorder.images.messages": "image_decoder",
        "recorder.images.pixels": "MalformedImage raw_image shrink",
    },
)
