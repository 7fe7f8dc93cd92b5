"""What each interface promises, as tests for pytest: derive a class, and say what to open."""

import pytest

pytest.register_assert_rewrite("contracts.exports", "contracts.learners", "contracts.sources")
