"""Collect what an import could not take over exactly: one warning of each kind, with the first place and a count."""

from __future__ import annotations

from torchpt.core.errors import ImportedSceneWarning, SceneError, warn_caller
from torchpt.scene.formats.mitsuba.elements import Element

__all__ = ["Notes"]


class Notes:
    """Warnings of an import.

    Args:
        strict: True to raise an error in place of each warning.
    """

    def __init__(self, *, strict: bool) -> None:
        self.strict = strict
        self._found: dict[str, tuple[str, int]] = {}  # text -> first place, count

    def add(self, element: Element, text: str) -> None:
        """Note what was done in place of what an element asks for.

        Args:
            element: the element.
            text: a sentence that begins with the element, such as ``bsdf "coating" becomes plastic: ...``.

        Raises:
            SceneError: the import is strict.
        """
        if self.strict:
            raise SceneError(
                f"line {element.line}", element.label, f"an exact twin, as import.strict is true ({text})", element.file
            )
        place, count = self._found.get(text, (f"{element.file}:{element.line}", 0))
        self._found[text] = place, count + 1

    def warn(self) -> None:
        """Issue the warnings, in the order in which they were found.

        Warns:
            ImportedSceneWarning: one for each kind.
        """
        for text, (place, count) in self._found.items():
            times = f" ({count} times)" if count > 1 else ""
            warn_caller(f"{place}: {text}{times}", ImportedSceneWarning)
