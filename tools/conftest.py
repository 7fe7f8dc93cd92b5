"""What holds for all tests, holds for those of the tools."""

from conftest import _signalled_children, oscillatory_recording, oscillatory_run  # noqa: F401
