"""How numbers are computed: by compiled code and, where it is asked for, with portable bits."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "cdmisfa.core.arithmetic.choice": "portable_bits",
        "cdmisfa.core.arithmetic.compiled": "compiled",
    },
)
