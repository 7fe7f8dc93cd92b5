"""What each interface promises, as tests for pytest: derive a class, and say what to open."""

try:
    import pytest
except ImportError:
    raise ImportError(
        "cdmisfa.testing needs pytest, which is missing: pip install 'cdmisfa[testing]'"
    ) from None

from cdmisfa.core.exports import exports

_CONTRACTS = {
    "cdmisfa.testing.exports": "FormContract",
    "cdmisfa.testing.learners": "FeatureContract LearnerContract SinkContract",
    "cdmisfa.testing.sources": "CameraContract ForwardContract SourceContract same",
}

pytest.register_assert_rewrite(*_CONTRACTS)

__getattr__, __dir__, __all__ = exports(__name__, _CONTRACTS)
