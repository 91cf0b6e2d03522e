"""Keeps the keys that a person sets on the page."""

from dataclasses import replace
from pathlib import Path

from ..core.keys import with_changes
from ..core.spec import Spec
from ..data import Layout
from ..data.channels import facts_of
from ..worlds.folder import save_keys


class KeyKeeper:
    """Holds the spec with the keys and names that were last set on the page, and saves them in the world's folder.

    spec:   the spec with which the page begins. It may have settings of this run alone, from the command line.
    folder: where keys are saved; None keeps them in the browser alone.
    own:    the world's own spec: only what was changed on the page is changed there.
    """

    def __init__(self, spec: Spec, folder: Path | None = None, own: Spec | None = None):
        self.spec, self.folder = spec, folder
        self._first, self._own = spec, own or spec

    @property
    def place(self) -> str:
        """Where they are kept, for people; "" where only the browser keeps them."""
        return f"in the world's folder, {self.folder}" if self.folder else ""

    def with_keys(self, layout: Layout) -> Layout:
        """The layout of a recording, with the keys of now."""
        return replace(layout, world=facts_of(self.spec))

    def __call__(self, spec: Spec) -> None:
        self.spec = spec
        if self.folder:
            save_keys(self.folder, with_changes(self._own, self._first, spec))
