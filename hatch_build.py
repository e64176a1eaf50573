"""The README as a package index shows it."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


def describe(readme: str) -> str:
    """README without what is relative to the repository: pictures go with their captions, links leave their words."""
    text = re.sub(
        r"^!\[[^\]]*\]\((?!https?:)[^)]*\)\n\n(?:\*[^*].*?\*\n\n)?", "", readme, flags=re.MULTILINE | re.DOTALL
    )
    return re.sub(r"\[([^\]]*)\]\((?!https?:)[^)]*\)", r"\1", text)


class Description(MetadataHookInterface):
    """Sets the long description."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Put it among the metadata."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": describe(text)}
