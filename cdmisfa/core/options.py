"""Settings as the command line takes them: `section.key=value`."""

from __future__ import annotations

from collections.abc import Iterable

from cdmisfa.core.config import shown
from cdmisfa.core.errors import UsageError


def parse_settings(words: Iterable[str]) -> dict[str, dict[str, str]]:
    """Turn `section.key=value` words into sections of texts.

    Raises:
        UsageError: a word of another form.
    """
    sections: dict[str, dict[str, str]] = {}
    for word in words:
        key, equals, value = word.partition("=")
        section, dot, name = key.strip().partition(".")
        if not (equals and section and dot and name):
            raise UsageError(
                f"--set {shown(word)}: write it as section.key=value, as learner.nu=0.02"
            )
        sections.setdefault(section, {})[name] = value.strip()
    return sections
